// What the surface is, not yet how it looks: shading happens once a pixel afterwards, because a software rasteriser runs a
// fragment shader for 4 x 4 pixels of every triangle, however small.
in vec3 world_position;
in vec3 world_normal;
in vec2 texture_uv;

uniform float surface_index;            // row of the table of surfaces, from 1; 0 is nothing
layout(location = 0) out vec4 geometry; // normal times distance from the camera; surface

#if TEXTURED
#include "srgb.glsl"
uniform vec4 base_color;
uniform float metallic;
uniform float roughness;
uniform vec3 emissive;
uniform float alpha_cutoff;             // negative: opaque
uniform int has_textures;               // bit 0 base colour, 1 metallic-roughness, 2 emissive
uniform sampler2D base_color_texture;
uniform sampler2D metallic_roughness_texture;
uniform sampler2D emissive_texture;
layout(location = 1) out vec4 color_metallic;
layout(location = 2) out vec4 emissive_roughness;
#endif

void main() {
    geometry = vec4(normalize(world_normal) * length(world_position), surface_index);
#if TEXTURED
    color_metallic = vec4(base_color.rgb, metallic);
    emissive_roughness = vec4(emissive, roughness);
    float alpha = base_color.a;
    if ((has_textures & 1) != 0) {
        vec4 t = texture(base_color_texture, texture_uv);
        color_metallic.rgb *= linear_from_srgb(t.rgb);
        alpha *= t.a;
    }
    if (alpha < alpha_cutoff) discard;
    if ((has_textures & 2) != 0) {
        vec4 t = texture(metallic_roughness_texture, texture_uv);
        color_metallic.a *= t.b;
        emissive_roughness.a *= t.g;
    }
    if ((has_textures & 4) != 0) emissive_roughness.rgb *= linear_from_srgb(texture(emissive_texture, texture_uv).rgb);
#endif
}
