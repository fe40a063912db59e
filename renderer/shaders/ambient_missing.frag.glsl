// The irradiance of the residual that an object takes from the ground: its transfer vectors times the frame's coefficients,
// once a frame for a map's texels, so that the composite looks up one colour. Fades out before the map ends.
uniform sampler2D transfer_0;
uniform sampler2D transfer_1;
uniform sampler2D transfer_2;
uniform vec3 residual_sh[9];    // L_lm
uniform ivec4 cell;             // first texel, size

out vec4 missing;

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec4 a = texelFetch(transfer_0, texel, 0), b = texelFetch(transfer_1, texel, 0);
    float c = texelFetch(transfer_2, texel, 0).r;
    vec3 sum = a.x * residual_sh[0] + a.y * residual_sh[1] + a.z * residual_sh[2] + a.w * residual_sh[3]
        + b.x * residual_sh[4] + b.y * residual_sh[5] + b.z * residual_sh[6] + b.w * residual_sh[7] + c * residual_sh[8];
    float radius = length((vec2(texel - cell.xy) + 0.5) / vec2(cell.zw) * 2.0 - 1.0);
    missing = vec4(max(sum, 0.0) * (1.0 - smoothstep(0.6, 0.98, radius)), 1.0);
}
