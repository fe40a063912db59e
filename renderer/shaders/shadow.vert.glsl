// Proxies projected onto the ground along one direction that a light's sample comes from (Heckbert & Herf 1997: area light as
// many hard shadows). The instance is the sample; its depth lets each sample count once a texel.
#define MAX_SAMPLES 128

uniform vec4 ground_rect;               // x0, z0, 1 / width, 1 / depth in metres
uniform float ground_y;
uniform vec3 sample_direction[MAX_SAMPLES];
uniform int sample_count;
uniform float weight;

in vec3 position;                       // in the world
in float counts;                        // 0 for what hides samples and casts no shadow
flat out vec3 direction;
flat out float counted;

void main() {
    direction = sample_direction[gl_InstanceID];
    counted = counts * weight;
    float height = position.y - ground_y;
    vec2 hit = position.xz - direction.xz * (height / direction.y);
    gl_ClipDistance[0] = height + 1e-4;
    gl_Position = vec4((hit - ground_rect.xy) * ground_rect.zw * 2.0 - 1.0,
                       1.0 - 2.0 * (float(gl_InstanceID) + 1.0) / (float(sample_count) + 1.0), 1.0);
}
