// An object's silhouette in the perspective view that covers its part of the panorama.
uniform mat4 world_from_model;
uniform mat4 clip_from_world;
uniform float clip_below_y;     // the ground hides what is under it

in vec3 position;
#if TEXTURED
in vec2 uv;
out vec2 texture_uv;
#endif

void main() {
    vec4 world = world_from_model * vec4(position, 1.0);
    gl_ClipDistance[0] = world.y - clip_below_y;
    gl_Position = clip_from_world * world;
#if TEXTURED
    texture_uv = uv;
#endif
}
