// The irradiance that an object takes from the ground: its transfer vectors times the coefficients of what it hides in this frame.
// Fades out before the part that is seen ends.
uniform sampler2D transfer_0;
uniform sampler2D transfer_1;
uniform sampler2D transfer_2;
uniform vec3 hidden_sh[9];      // L_lm
uniform vec3 cell;              // of the object's transfer: u0, v0, size
uniform float extent;           // of the part that is to be seen

in vec2 at;
out vec4 missing;

void main() {
    vec2 uv = cell.xy + at * cell.z;
    vec4 a = textureLod(transfer_0, uv, 0.0), b = textureLod(transfer_1, uv, 0.0);
    float c = textureLod(transfer_2, uv, 0.0).r;
    vec3 sum = a.x * hidden_sh[0] + a.y * hidden_sh[1] + a.z * hidden_sh[2] + a.w * hidden_sh[3]
        + b.x * hidden_sh[4] + b.y * hidden_sh[5] + b.z * hidden_sh[6] + b.w * hidden_sh[7] + c * hidden_sh[8];
    missing = vec4(sum * (1.0 - smoothstep(0.75, 0.98, length(at * 2.0 - 1.0) / extent)), 1.0);
}
