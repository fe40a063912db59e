// The irradiance that an object takes from the ground: its transfer vectors times the coefficients of what it hides in this frame,
// once a frame for a map's texels, so that the composite looks up one colour. Fades out before the map ends.
uniform sampler2D transfer_0;
uniform sampler2D transfer_1;
uniform sampler2D transfer_2;
uniform vec3 hidden_sh[9];    // L_lm
uniform ivec4 cell;             // first texel, size

out vec4 missing;

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec4 a = texelFetch(transfer_0, texel, 0), b = texelFetch(transfer_1, texel, 0);
    float c = texelFetch(transfer_2, texel, 0).r;
    vec3 sum = a.x * hidden_sh[0] + a.y * hidden_sh[1] + a.z * hidden_sh[2] + a.w * hidden_sh[3]
        + b.x * hidden_sh[4] + b.y * hidden_sh[5] + b.z * hidden_sh[6] + b.w * hidden_sh[7] + c * hidden_sh[8];
    float radius = length((vec2(texel - cell.xy) + 0.5) / vec2(cell.zw) * 2.0 - 1.0);
    missing = vec4(sum * (1.0 - smoothstep(0.6, 0.98, radius)), 1.0);
}
