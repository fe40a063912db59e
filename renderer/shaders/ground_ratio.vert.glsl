// One rectangle for each shadow map, where it lies on the ground.
const int MAX_MAPS = 64;
uniform vec4 ground_rect;               // x0, z0, 1 / width, 1 / depth in metres
uniform vec4 map_rect[MAX_MAPS];        // x0, z0, x1, z1
uniform vec3 map_cell[MAX_MAPS];        // u0, v0, size in the atlas
uniform vec3 map_weight[MAX_MAPS];

out vec2 uv;
flat out vec3 weight;

void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    vec4 rect = map_rect[gl_InstanceID];
    uv = map_cell[gl_InstanceID].xy + corner * map_cell[gl_InstanceID].z;
    weight = map_weight[gl_InstanceID];
    gl_Position = vec4((mix(rect.xy, rect.zw, corner) - ground_rect.xy) * ground_rect.zw * 2.0 - 1.0, 0.0, 1.0);
}
