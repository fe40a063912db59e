// One point a texel of the radiance map, side by side in the target.
in int texel;
flat out int texel_index;
uniform int capacity;

void main() {
    texel_index = texel;
    gl_Position = vec4((float(gl_VertexID) + 0.5) / float(capacity) * 2.0 - 1.0, 0.0, 0.0, 1.0);
    gl_PointSize = 1.0;
}
