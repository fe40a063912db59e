// Fused inverse tone mapping and box reduction of the frame to a small radiance map.
// The mean is over linear radiance after the tone curve (the other order loses highlights), each row by its solid angle.
// Alpha is the share of the texel's solid angle that the camera has clipped.
#include "equirectangular.glsl"
#include "panorama.glsl"

uniform ivec2 map_size;
out vec4 texel;

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

#if COLUMNS
// COLUMNS x ROWS cells make a texel; the usual numbers are written out, because a software renderer keeps in memory what lives
// across a loop, even one of a single turn.
vec4 row_radiance(ivec2 first) {
#if COLUMNS == 1
    return cell_radiance(first);
#elif COLUMNS == 2
    return cell_radiance(first) + cell_radiance(first + ivec2(1, 0));
#else
    vec4 row = vec4(0.0);
    for (int x = 0; x < COLUMNS; ++x)
        row += cell_radiance(first + ivec2(x, 0));
    return row;
#endif
}

vec4 four_rows(ivec2 first, inout float weights) {
    vec4 weight = vec4(row_weight(first.y), row_weight(first.y + 1), row_weight(first.y + 2), row_weight(first.y + 3));
    weights += weight.x + weight.y + weight.z + weight.w;
    return weight.x * row_radiance(first) + weight.y * row_radiance(first + ivec2(0, 1))
        + weight.z * row_radiance(first + ivec2(0, 2)) + weight.w * row_radiance(first + ivec2(0, 3));
}

void main() {
    ivec2 first = ivec2(gl_FragCoord.xy) * ivec2(COLUMNS, ROWS);
    float weights = 0.0;
#if ROWS == 4
    vec4 sum = four_rows(first, weights);
#elif ROWS == 8
    vec4 sum = four_rows(first, weights);
    sum += four_rows(first + ivec2(0, 4), weights);
#else
    vec4 sum = vec4(0.0);
    for (int y = 0; y < ROWS; ++y) {
        float weight = row_weight(first.y + y);
        sum += weight * row_radiance(first + ivec2(0, y));
        weights += weight;
    }
#endif
    texel = sum / (weights * float(COLUMNS * CELL.x * CELL.y));
}
#else
// Texels that are no whole number of cells.
void main() {
    ivec2 cells = frame_size / CELL, index = ivec2(gl_FragCoord.xy);
    ivec2 first = index * cells / map_size, count = max((index + 1) * cells / map_size - first, ivec2(1));
    vec4 sum = vec4(0.0);
    float weights = 0.0;
    for (int y = 0; y < count.y; ++y) {
        float weight = row_weight(first.y + y);
        for (int x = 0; x < count.x; ++x)
            sum += weight * cell_radiance(first + ivec2(x, y));
        weights += weight;
    }
    texel = sum / (weights * float(count.x * CELL.x * CELL.y));
}
#endif
