// A proxy projected onto the ground along one direction a light's sample comes from (Heckbert & Herf 1997: area light as
// many hard shadows). The instance is the sample; its depth lets each sample count once a texel.
#define MAX_SAMPLES 128

uniform mat4 world_from_model;
uniform vec4 ground_rect;               // x0, z0, 1 / width, 1 / depth in metres
uniform float ground_y;
uniform vec3 sample_direction[MAX_SAMPLES];
uniform int sample_count;
uniform int first_sample;

in vec3 position;
flat out vec3 direction;

void main() {
    vec3 world = (world_from_model * vec4(position, 1.0)).xyz;
    int index = first_sample + gl_InstanceID;
    direction = sample_direction[index];
    float height = world.y - ground_y;
    vec2 hit = world.xz - direction.xz * (height / direction.y);
    gl_ClipDistance[0] = height + 1e-4;
    gl_Position = vec4((hit - ground_rect.xy) * ground_rect.zw * 2.0 - 1.0,
                       1.0 - 2.0 * (float(index) + 1.0) / (float(sample_count) + 1.0), 1.0);
}
