// 1 where an object is.
#if TEXTURED
uniform vec4 base_color;
uniform float alpha_cutoff;             // negative: opaque
uniform int has_textures;               // bit 0 base colour
uniform sampler2D base_color_texture;
in vec2 texture_uv;
#endif

out float covered;

void main() {
#if TEXTURED
    float alpha = base_color.a * ((has_textures & 1) != 0 ? texture(base_color_texture, texture_uv).a : 1.0);
    if (alpha < alpha_cutoff) discard;
#endif
    covered = 1.0;
}
