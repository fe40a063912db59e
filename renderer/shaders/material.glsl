// A glTF material's colour and transparency, and where its textures are read.
const int BASE_COLOR = 0, METALLIC_ROUGHNESS = 1, NORMAL = 2, OCCLUSION = 3, EMISSIVE = 4;
const int OPAQUE = 0, MASK = 1, BLEND = 2;

uniform int has_textures;               // a bit for each of those
uniform int second_set;                 // the same: read with the second texture coordinates
uniform ivec2 mirrored;                 // the same, in u and v: every second repetition is turned round
uniform mat3x2 uv_mapping[5];
uniform vec4 base_color;
uniform int alpha_mode;
uniform float alpha_cutoff;
uniform sampler2D base_color_texture;
in vec4 texture_uv;
in vec4 vertex_color;

bool has(int slot) { return (has_textures & (1 << slot)) != 0; }

vec2 mapped(int slot) {
    vec2 uv = (second_set & (1 << slot)) != 0 ? texture_uv.zw : texture_uv.xy;
    vec2 at = uv_mapping[slot] * vec3(uv, 1.0), folded = 1.0 - abs(mod(at, 2.0) - 1.0);
    return mix(at, folded, bvec2(mirrored & (1 << slot)));
}

vec4 material_color(float bias) {
    vec4 color = base_color * vertex_color;
    return has(BASE_COLOR) ? color * texture(base_color_texture, mapped(BASE_COLOR), bias) : color;
}

// Of a blended surface as many samples are left out as light goes through, in an ordered pattern of 4 x 4.
float threshold() {
    ivec2 p = ivec2(gl_FragCoord.xy) & 3, q = p >> 1;
    int fine = ((p.x ^ p.y) & 1) * 2 + (p.y & 1), coarse = ((q.x ^ q.y) & 1) * 2 + (q.y & 1);
    return (float(fine * 4 + coarse) + 0.5) / 16.0;
}

bool is_hole(float alpha) { return alpha_mode == MASK ? alpha < alpha_cutoff : alpha_mode == BLEND && alpha < threshold(); }
