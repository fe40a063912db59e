// An object in the perspective view that covers its part of the panorama.
uniform mat4 world_from_model;
uniform mat3 normal_from_model;
uniform mat4 clip_from_world;
uniform float clip_below_y;     // the ground hides what is under it

in vec3 position;
in vec3 normal;
in vec2 openness;               // of the vertex to the light around, past the mesh itself, in front and behind
out vec2 open_share;
out vec3 world_position;
out vec3 world_normal;
#if DETAILED
in vec4 tangent;
in vec2 uv;
in vec2 uv2;
in vec4 color;
out vec4 world_tangent;
out vec4 texture_uv;            // both sets
out vec4 vertex_color;
#endif

void main() {
    vec4 world = world_from_model * vec4(position, 1.0);
    world_position = world.xyz;
    open_share = openness;
    world_normal = normal_from_model * normal;
#if DETAILED
    world_tangent = vec4(mat3(world_from_model) * tangent.xyz, tangent.w);
    texture_uv = vec4(uv, uv2);
    vertex_color = color;
#endif
    gl_ClipDistance[0] = world.y - clip_below_y;
    gl_Position = clip_from_world * world;
}
