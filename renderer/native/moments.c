// Where inside a texel of the radiance map its light is, as renderer/shaders/moments.frag.glsl has it.
#include "planes.h"
#include "tone.h"

typedef struct {
    float light[4];     // luminances of 2 x 2 pixels by rows
} Block;

INLINE Block block_luminances(const Picture *picture, const float *m, int64_t x, int64_t y) {
    const uint8_t *luma = picture->y + 2 * y * picture->y_stride + 2 * x;
    float u = picture->u[y * picture->u_stride + x] * (1.0f / 255.0f), v = picture->v[y * picture->v_stride + x] * (1.0f / 255.0f);
    float codes[4] = {luma[0], luma[1], luma[picture->y_stride], luma[picture->y_stride + 1]};
    Block block;
    for (int i = 0; i < 4; ++i) {
        float at = codes[i] * (1.0f / 255.0f);
        float r = linear_from_srgb(clamped(m[0] * at + m[1] * u + m[2] * v + m[3], 0.0f, 1.0f));
        float g = linear_from_srgb(clamped(m[4] * at + m[5] * u + m[6] * v + m[7], 0.0f, 1.0f));
        float b = linear_from_srgb(clamped(m[8] * at + m[9] * u + m[10] * v + m[11], 0.0f, 1.0f)), linear = luminance(r, g, b);
        block.light[i] = linear * tone_gain(linear);
    }
    return block;
}

// (count, 4) for texels of a map by flat index: mean luminance; its moments about the texel's centre in radians to the right,
// downwards, and squared. `row_weights`: sine of the polar angle of each pixel row.
void mr360_moments(const Picture *picture, const float *rgb_from_yuv, const float *row_weights, int64_t map_width,
                   int64_t map_height, const int32_t *texels, int64_t count, float *moments) {
    int64_t across = picture->width / 2, down = picture->height / 2;
    float pixel_x = 6.28318530718f / (float)picture->width, pixel_y = 3.14159265359f / (float)picture->height;
    for (int64_t n = 0; n < count; ++n) {
        int64_t column = texels[n] % map_width, row = texels[n] / map_width;
        float centre_x = ((float)column + 0.5f) / (float)map_width * (float)picture->width;
        float centre_y = ((float)row + 0.5f) / (float)map_height * (float)picture->height;
        float sums[4] = {0}, weights = 0.0f;
        for (int64_t y = row * down / map_height; y < (row + 1) * down / map_height; ++y)
            for (int64_t x = column * across / map_width; x < (column + 1) * across / map_width; ++x) {
                Block block = block_luminances(picture, rgb_from_yuv, x, y);
                for (int i = 0; i < 4; ++i) {
                    float weight = row_weights[2 * y + i / 2], light = weight * block.light[i], wide = pixel_x * weight;
                    float right = ((float)(2 * x + i % 2) + 0.5f - centre_x) * wide;
                    float under = ((float)(2 * y + i / 2) + 0.5f - centre_y) * pixel_y;
                    sums[0] += light, sums[1] += light * right, sums[2] += light * under;
                    // a camera's pixel is a mean over its area, which spreads what it shows by that much
                    sums[3] += light * (right * right + under * under - (wide * wide + pixel_y * pixel_y) / 12.0f);
                    weights += weight;
                }
            }
        for (int i = 0; i < 4; ++i) moments[4 * n + i] = sums[i] / (weights > 1e-12f ? weights : 1e-12f);
    }
}
