// An object's silhouette in the perspective view that covers its part of the panorama.
uniform mat4 world_from_model;
uniform mat4 clip_from_world;
uniform float clip_below_y;     // the ground hides what is under it

in vec3 position;
#if DETAILED
in vec2 uv;
in vec2 uv2;
in vec4 color;
out vec4 texture_uv;
out vec4 vertex_color;
#endif

void main() {
    vec4 world = world_from_model * vec4(position, 1.0);
    gl_ClipDistance[0] = world.y - clip_below_y;
    gl_Position = clip_from_world * world;
#if DETAILED
    texture_uv = vec4(uv, uv2);
    vertex_color = color;
#endif
}
