// Radiance of small cells of the frame, for reducing it: of PACKED x 2 pixels where the planes are packed, else of one.
#include "panorama.glsl"

#if PACKED
// Decoding without roots and without the branch for the toe, within 1 % of (value + 0.02) and, after the tone curve, within 0.8 % of
// (radiance + 0.05): enough for a mean of light.
#define DECODED(s) ((s) * ((s) * ((s) * ((s) * ((s) * 0.44501405 - 1.16964521) + 1.38037598) + 0.28374452) + 0.06128402))

// Radiance of a grey with that display signal.
vec4 grey_radiance(vec4 v) {
    vec4 l = DECODED(v), l2 = l * l, l4 = l2 * l2;
    return l * (10.0 * l4 * l4 * l2 + 1.8);
}

// Sum over a chroma sample's 2 x 2 pixels: the colour is decoded once, at the mean luma; the four lumas scale it. Exact for
// greys and for even blocks, and half the arithmetic.
vec4 block_radiance(vec3 chroma, vec4 luma) {
    float mean = 0.25 * (luma.x + luma.y + luma.z + luma.w);
    float tint = dot(chroma, LUMINANCE_WEIGHTS);
    vec3 even = clamp(chroma + mean, 0.0, 1.0);
    vec3 color = radiance_from_linear(DECODED(even));
    vec4 signal = clamp(luma + tint, 0.0, 1.0), grey = grey_radiance(signal);
    float scale = (grey.x + grey.y + grey.z + grey.w) / max(grey_radiance(vec4(clamp(mean + tint, 0.0, 1.0))).x, 1e-6);
    vec4 clipped = step(CLIPPED, signal);
    return vec4(color * scale, clipped.x + clipped.y + clipped.z + clipped.w);
}

vec3 chroma_offset(float u, float v) { return rgb_from_yuv[1] * u + rgb_from_yuv[2] * v + rgb_from_yuv[3]; }

// Two blocks of 2 x 2 pixels.
vec4 blocks_radiance(uint upper_codes, uint lower_codes, vec2 u, vec2 v) {
    vec4 upper = codes(upper_codes) * rgb_from_yuv[0][0], lower = codes(lower_codes) * rgb_from_yuv[0][0];
    return block_radiance(chroma_offset(u.x, v.x), vec4(upper.xy, lower.xy))
        + block_radiance(chroma_offset(u.y, v.y), vec4(upper.zw, lower.zw));
}

// Sum over a cell of PACKED x 2 pixels.
vec4 cell_radiance(ivec2 cell) {
    uvec2 upper = texelFetch(packed_luma, ivec2(cell.x, cell.y * 2), 0).rg;
    uvec2 lower = texelFetch(packed_luma, ivec2(cell.x, cell.y * 2 + 1), 0).rg;
    vec4 u = codes(texelFetch(packed_u, cell, 0).r), v = codes(texelFetch(packed_v, cell, 0).r);
#if PACKED == 8
    return blocks_radiance(upper.x, lower.x, u.xy, v.xy) + blocks_radiance(upper.y, lower.y, u.zw, v.zw);
#else
    return blocks_radiance(upper.x, lower.x, u.xy, v.xy);
#endif
}
const ivec2 CELL = ivec2(PACKED, 2);
#else
vec4 cell_radiance(ivec2 pixel) { return vec4(pixel_radiance(pixel), pixel_clipped(pixel)); }
const ivec2 CELL = ivec2(1, 1);
#endif

float row_weight(int y) { return sin((float(y) + 0.5) / float(frame_size.y / CELL.y) * PI); }
