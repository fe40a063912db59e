// An object in the perspective view that covers its part of the panorama.
uniform mat4 world_from_model;
uniform mat3 normal_from_model;
uniform mat4 clip_from_world;
uniform float clip_below_y;     // the ground hides what is under it

in vec3 position;
in vec3 normal;
in vec2 uv;

out vec3 world_position;
out vec3 world_normal;
out vec2 texture_uv;

void main() {
    vec4 world = world_from_model * vec4(position, 1.0);
    world_position = world.xyz;
    world_normal = normal_from_model * normal;
    texture_uv = uv;
    gl_ClipDistance[0] = world.y - clip_below_y;
    gl_Position = clip_from_world * world;
}
