// What a shadow map takes from the ground's irradiance.
uniform sampler2D atlas;
uniform int is_share;                   // of a light, in red; else irradiance
in vec2 uv;
flat in vec3 weight;
out vec4 missing;

void main() {
    vec3 found = textureLod(atlas, uv, 0.0).rgb;
    missing = vec4((is_share == 1 ? found.rrr : found) * weight, 1.0);
}
