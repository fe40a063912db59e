// What the surface is, not yet how it looks: shading happens once a pixel afterwards, because a software rasteriser runs a
// fragment shader for 4 x 4 pixels of every triangle, however small.
in vec3 world_position;
in vec3 world_normal;
in vec2 open_share;             // in front and behind

uniform float camera_y;                 // 0 but for the camera's mirror image in the ground
uniform float surface_index;            // row of the table of surfaces, from 1; 0 is nothing
layout(location = 0) out vec4 geometry; // normal times distance from the camera; surface, and how much is occluded as a fraction

#if DETAILED
#include "material.glsl"
uniform float metallic;
uniform float roughness;
uniform vec3 emissive;
uniform float normal_scale;
uniform float occlusion_strength;
uniform int is_unlit;
uniform sampler2D metallic_roughness_texture;
uniform sampler2D normal_texture;
uniform sampler2D occlusion_texture;
uniform sampler2D emissive_texture;
in vec4 world_tangent;
layout(location = 1) out vec4 color_metallic;
layout(location = 2) out vec4 emissive_roughness;

// The samples are half as far apart as the pixels that they make up: a level up is as fine as a pixel, and a little soft.
const float BIAS = 0.5;

vec3 mapped_normal(vec3 normal) {
    vec3 t = texture(normal_texture, mapped(NORMAL), BIAS).xyz * 2.0 - 1.0;
    vec3 along = normalize(world_tangent.xyz - normal * dot(normal, world_tangent.xyz) + vec3(1e-9));
    vec3 across = cross(normal, along) * world_tangent.w;
    return normalize(along * (t.x * normal_scale) + across * (t.y * normal_scale) + normal * max(t.z, 1e-3));
}
#endif

void main() {
    vec3 normal = normalize(gl_FrontFacing ? world_normal : -world_normal);
    float occluded = 1.0 - (gl_FrontFacing ? open_share.x : open_share.y);
#if DETAILED
    vec4 color = material_color(BIAS);
    if (is_hole(color.a)) discard;
    color_metallic = vec4(color.rgb, metallic);
    emissive_roughness = vec4(emissive, roughness);
    if (has(METALLIC_ROUGHNESS)) {
        vec4 t = texture(metallic_roughness_texture, mapped(METALLIC_ROUGHNESS), BIAS);
        color_metallic.a *= t.b;
        emissive_roughness.a *= t.g;
    }
    if (has(NORMAL)) normal = mapped_normal(normal);
    // what is in the way gives back what it gets; a texture says what is left in the end
    occluded *= (1.0 - dot(color.rgb, vec3(0.3, 0.59, 0.11))) / (1.0 - dot(color.rgb, vec3(0.3, 0.59, 0.11)) * occluded);
    if (has(OCCLUSION)) occluded = occlusion_strength * (1.0 - texture(occlusion_texture, mapped(OCCLUSION), BIAS).r);
    if (has(EMISSIVE)) emissive_roughness.rgb *= texture(emissive_texture, mapped(EMISSIVE), BIAS).rgb;
    if (is_unlit != 0) {        // gives off its colour and reflects nothing
        color_metallic = vec4(0.0, 0.0, 0.0, 1.0);
        emissive_roughness = vec4(color.rgb, 1.0);
    }
#endif
    geometry = vec4(normal * length(world_position - vec3(0.0, camera_y, 0.0)), surface_index + 0.9 * clamp(occluded, 0.0, 1.0));
}
