// The reduction of Y'CbCr planes to a radiance map, as renderer/shaders/radiance_map.frag.glsl has it: the tone curve first, then
// the mean by solid angle. The colour of a block of 2 x 2 pixels is decoded once, at its mean luma; its four lumas scale it.
#include "planes.h"
#include "tone.h"

#define CLIPPED 0.985f      // of the display signal's luma

// Decoding without roots, within 1 % of (value + 0.02): enough for a mean of light.
INLINE float decoded(float s) {
    return s * (s * (s * (s * (s * 0.44501405f - 1.16964521f) + 1.38037598f) + 0.28374452f) + 0.06128402f);
}

INLINE float grey_radiance(float signal) {
    float l = decoded(signal);
    return l * tone_gain(l);
}

// Adds one row of blocks, weighted, to `sums`: (4, blocks) red, green, blue, and clipped pixels.
INLINE void add_blocks(const uint8_t *restrict upper, const uint8_t *restrict lower, const uint8_t *restrict u, const uint8_t *restrict v,
                       int64_t blocks, const float *restrict m, float weight, float *restrict sums) {
    float scale = m[0] * (1.0f / 255.0f), r_v = m[2] * (1.0f / 255.0f), g_u = m[5] * (1.0f / 255.0f), g_v = m[6] * (1.0f / 255.0f),
          b_u = m[9] * (1.0f / 255.0f);
    for (int64_t i = 0; i < blocks; ++i) {
        float y0 = upper[2 * i] * scale, y1 = upper[2 * i + 1] * scale, y2 = lower[2 * i] * scale, y3 = lower[2 * i + 1] * scale;
        float cr = v[i] * r_v + m[3], cg = u[i] * g_u + v[i] * g_v + m[7], cb = u[i] * b_u + m[11];
        float mean = 0.25f * (y0 + y1 + y2 + y3), tint = luminance(cr, cg, cb);
        float r = decoded(clamped(cr + mean, 0.0f, 1.0f)), g = decoded(clamped(cg + mean, 0.0f, 1.0f));
        float b = decoded(clamped(cb + mean, 0.0f, 1.0f));
        y0 = clamped(y0 + tint, 0.0f, 1.0f), y1 = clamped(y1 + tint, 0.0f, 1.0f);
        y2 = clamped(y2 + tint, 0.0f, 1.0f), y3 = clamped(y3 + tint, 0.0f, 1.0f);
        float even = grey_radiance(clamped(mean + tint, 0.0f, 1.0f));
        float gain = (grey_radiance(y0) + grey_radiance(y1) + grey_radiance(y2) + grey_radiance(y3)) / (even < 1e-6f ? 1e-6f : even)
                     * tone_gain(clamped(luminance(r, g, b), 0.0f, 1.0f)) * weight;
        sums[i] += r * gain;
        sums[blocks + i] += g * gain;
        sums[2 * blocks + i] += b * gain;
        sums[3 * blocks + i] += weight * ((y0 >= CLIPPED ? 1.0f : 0.0f) + (y1 >= CLIPPED ? 1.0f : 0.0f)
                                          + (y2 >= CLIPPED ? 1.0f : 0.0f) + (y3 >= CLIPPED ? 1.0f : 0.0f));
    }
}

// `texels`: (map_height, map_width, 4), each of `columns` x `rows` blocks; `sums`: room for 2 * width floats; `row_weights`: of rows of
// blocks; one of `every` rows of blocks is looked at.
MULTIVERSION void mr360_reduce(const Picture *picture, const float *rgb_from_yuv, const float *row_weights, int64_t map_width,
                               int64_t map_height, int64_t columns, int64_t rows, int64_t every, float *sums, float *texels) {
    int64_t blocks = map_width * columns;
    for (int64_t row = 0; row < map_height; ++row) {
        float weights = 0.0f;
        memset(sums, 0, sizeof(float) * 4 * (size_t)blocks);
        for (int64_t block = row * rows; block < (row + 1) * rows; block += every) {
            const uint8_t *upper = picture->y + 2 * block * picture->y_stride;
            add_blocks(upper, upper + picture->y_stride, picture->u + block * picture->u_stride,
                       picture->v + block * picture->v_stride, blocks, rgb_from_yuv, row_weights[block], sums);
            weights += row_weights[block];
        }
        float scale = 1.0f / (4.0f * weights * (float)columns);
        for (int64_t texel = 0; texel < map_width; ++texel)
            for (int channel = 0; channel < 4; ++channel) {
                float sum = 0.0f;
                for (int64_t i = texel * columns; i < (texel + 1) * columns; ++i) sum += sums[channel * blocks + i];
                texels[(row * map_width + texel) * 4 + channel] = sum * scale;
            }
    }
}
