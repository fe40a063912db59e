// An object's part of a map of the ground.
uniform vec4 map_rect;          // x0, z0, 1 / width, 1 / depth in metres
uniform vec4 rect;              // x0, z0, x1, z1

out vec2 at;                    // 0..1 in the object's part

void main() {
    at = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    gl_Position = vec4((mix(rect.xy, rect.zw, at) - map_rect.xy) * map_rect.zw * 2.0 - 1.0, 0.0, 1.0);
}
