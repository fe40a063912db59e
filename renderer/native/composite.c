// Composites kept layers into Y'CbCr planes; what they are: renderer/compositing/layers.py.
#include "planes.h"
#include "tone.h"

#define TILE 16
#define STRIP (2 * TILE)            // two rows of a tile: one row of chroma
#define PLANE (TILE * TILE)
#define PEAK_GAIN 11.8f
enum { RED, GREEN, BLUE, KEPT, ADDED_RED, ADDED_GREEN, ADDED_BLUE, DIFFERS, PLANES };

typedef struct {
    const float *rgb_from_yuv, *yuv_from_rgb;   // 3 x 4 by rows, of codes / 255
    const float *inverse_gain;                  // 1 / k by sqrt(luminance / peak)
    int32_t inverse_gain_size, is_additive;
} Tone;

// Tiles of two half-float RGBA pictures of `atlas_width` pixels to their places in the store, one plane a component.
MULTIVERSION void mr360_keep_layers(const uint16_t *factors, const uint16_t *addends, int64_t atlas_width, const int32_t *slots,
                                    const int32_t *places, int64_t count, uint16_t *layers) {
    int64_t columns = atlas_width / TILE;
    for (int64_t n = 0; n < count; ++n) {
        int64_t first = (slots[n] / columns * TILE * atlas_width + slots[n] % columns * TILE) * 4;
        uint16_t *tile = layers + (int64_t)places[n] * PLANES * PLANE;
        for (int row = 0; row < TILE; ++row) {
            const uint16_t *f = factors + first + row * atlas_width * 4, *a = addends + first + row * atlas_width * 4;
            for (int plane = 0; plane < 4; ++plane)
                for (int x = 0; x < TILE; ++x) {
                    tile[plane * PLANE + row * TILE + x] = f[4 * x + plane];
                    tile[(4 + plane) * PLANE + row * TILE + x] = a[4 * x + plane];
                }
        }
    }
}

// The pixels of a tile that are worked on, from the first row that differs: whole strips. Each step is a loop of its own, short
// enough for a processor to have many of its turns under way at a time.
typedef struct {
    int count;      // of pixels
    float luma[PLANE], u[PLANE], v[PLANE], red[PLANE], green[PLANE], blue[PLANE], gain[PLANE];
} Pixels;

// A row of chroma codes / 255, each for two pixels of two rows.
INLINE void spread_chroma(const uint8_t *restrict codes, float *restrict values) {
    float once[TILE / 2];
    for (int x = 0; x < TILE / 2; ++x) once[x] = codes[x] * (1.0f / 255.0f);
    for (int x = 0; x < TILE / 2; ++x) values[2 * x] = values[2 * x + 1] = once[x];
    memcpy(values + TILE, values, TILE * sizeof(float));
}

// `columns`, even: as many as the frame has there; what is beyond its edge repeats the last.
INLINE void load_row(const uint8_t *from, int32_t columns, uint8_t *codes, int32_t wanted) {
    memcpy(codes, from, (size_t)columns);
    memset(codes + columns, from[columns - 1], (size_t)(wanted - columns));
}

INLINE void load(Pixels *pixels, const Picture *picture, int32_t x0, int32_t y0, int32_t columns) {
    uint8_t codes[TILE];
    for (int at = 0; at < pixels->count; at += TILE) {
        load_row(picture->y + (y0 + at / TILE) * picture->y_stride + x0, columns, codes, TILE);
        for (int x = 0; x < TILE; ++x) pixels->luma[at + x] = codes[x] * (1.0f / 255.0f);
    }
    for (int at = 0; at < pixels->count; at += STRIP) {
        int64_t row = (y0 + at / TILE) / 2;
        load_row(picture->u + row * picture->u_stride + x0 / 2, columns / 2, codes, TILE / 2);
        spread_chroma(codes, pixels->u + at);
        load_row(picture->v + row * picture->v_stride + x0 / 2, columns / 2, codes, TILE / 2);
        spread_chroma(codes, pixels->v + at);
    }
}

INLINE void decode(const Pixels *pixels, const float *row, float *restrict linear) {
    float y = row[0], u = row[1], v = row[2], offset = row[3];
    for (int i = 0; i < pixels->count; ++i)
        linear[i] = linear_from_srgb(clamped(y * pixels->luma[i] + u * pixels->u[i] + v * pixels->v[i] + offset, 0.0f, 1.0f));
}

// What the ground has left of its light, as the camera shows it.
INLINE void dim(const Pixels *pixels, float *restrict linear, const uint16_t *restrict factor) {
    for (int i = 0; i < pixels->count; ++i) linear[i] *= from_half(factor[i]);
}

// Radiance of the ground, additive: less by what is missing, and of the objects over it.
INLINE void put_layer(const Pixels *pixels, float *restrict linear, const uint16_t *restrict factor, const uint16_t *restrict kept,
                      const uint16_t *restrict added, int is_additive) {
    for (int i = 0; i < pixels->count; ++i) {
        float gain = is_additive ? clamped(pixels->gain[i] - from_half(factor[i]), 0.0f, INFINITY) : pixels->gain[i];
        linear[i] = linear[i] * gain * from_half(kept[i]) + from_half(added[i]);
    }
}

INLINE void tone_map(Pixels *pixels, const Tone *tone) {
    const float *restrict table = tone->inverse_gain;
    const float last = (float)(tone->inverse_gain_size - 1);
    int32_t index[PLANE];
    for (int i = 0; i < pixels->count; ++i) {
        float y = luminance(pixels->red[i], pixels->green[i], pixels->blue[i]) * (1.0f / PEAK_GAIN);
        index[i] = (int32_t)(sqrtf(clamped(y, 0.0f, 1.0f)) * last + 0.5f);
    }
    for (int i = 0; i < pixels->count; ++i) pixels->gain[i] = table[index[i]];
}

INLINE void encode(const Pixels *pixels, float *restrict linear) {
    for (int i = 0; i < pixels->count; ++i) linear[i] = srgb_from_linear(clamped(linear[i] * pixels->gain[i], 0.0f, 1.0f));
}

// One of Y'CbCr, from R'G'B'; what does not differ keeps its value. `differs`: 1 or 0.
INLINE void mix(const Pixels *pixels, const float *row, const uint16_t *restrict differs, float *restrict values) {
    float r = row[0], g = row[1], b = row[2], offset = row[3];
    for (int i = 0; i < pixels->count; ++i) {
        float found = r * pixels->red[i] + g * pixels->green[i] + b * pixels->blue[i] + offset, share = from_half(differs[i]);
        values[i] = share * found + (1.0f - share) * values[i];
    }
}

INLINE void store_chroma(const float *restrict values, uint8_t *restrict to, int32_t columns) {
    float pairs[TILE];
    uint8_t codes[TILE / 2];
    for (int x = 0; x < TILE; ++x) pairs[x] = values[x] + values[TILE + x];
    for (int x = 0; x < TILE / 2; ++x)
        codes[x] = (uint8_t)(int32_t)(0.25f * 255.0f * clamped(pairs[2 * x] + pairs[2 * x + 1], 0.0f, 4.0f) + 0.5f);
    memcpy(to, codes, (size_t)columns);
}

INLINE void store(const Pixels *pixels, const Picture *picture, int32_t x0, int32_t y0, int32_t columns) {
    uint8_t codes[TILE];
    for (int at = 0; at < pixels->count; at += TILE) {
        for (int x = 0; x < TILE; ++x)
            codes[x] = (uint8_t)(int32_t)(255.0f * clamped(pixels->luma[at + x], 0.0f, 1.0f) + 0.5f);
        memcpy(picture->y + (y0 + at / TILE) * picture->y_stride + x0, codes, (size_t)columns);
    }
    for (int at = 0; at < pixels->count; at += STRIP) {
        int64_t row = (y0 + at / TILE) / 2;
        store_chroma(pixels->u + at, picture->u + row * picture->u_stride + x0 / 2, columns / 2);
        store_chroma(pixels->v + at, picture->v + row * picture->v_stride + x0 / 2, columns / 2);
    }
}

INLINE int differs_somewhere(const uint16_t *differs) {
    uint32_t any = 0;
    for (int i = 0; i < STRIP; ++i) any |= differs[i];
    return any != 0;
}

INLINE void composite_tile(Pixels *pixels, const Picture *picture, int32_t x0, int32_t y0, const uint16_t *layer, const Tone *tone,
                           int is_additive) {
    int32_t columns = picture->width - x0 < TILE ? picture->width - x0 : TILE;
    int32_t rows = picture->height - y0 < TILE ? picture->height - y0 : TILE, first = 0, end = rows * TILE;
    while (first < end && !differs_somewhere(layer + DIFFERS * PLANE + first)) first += STRIP;
    while (first < end && !differs_somewhere(layer + DIFFERS * PLANE + end - STRIP)) end -= STRIP;
    if (first >= end) return;
    pixels->count = end - first;
    layer += first, y0 += first / TILE;
    load(pixels, picture, x0, y0, columns);
    decode(pixels, tone->rgb_from_yuv, pixels->red);
    decode(pixels, tone->rgb_from_yuv + 4, pixels->green);
    decode(pixels, tone->rgb_from_yuv + 8, pixels->blue);
    if (!is_additive) {
        dim(pixels, pixels->red, layer + RED * PLANE);
        dim(pixels, pixels->green, layer + GREEN * PLANE);
        dim(pixels, pixels->blue, layer + BLUE * PLANE);
    }
    for (int i = 0; i < pixels->count; ++i)
        pixels->gain[i] = tone_gain(clamped(luminance(pixels->red[i], pixels->green[i], pixels->blue[i]), 0.0f, 1.0f));
    const uint16_t *kept = layer + KEPT * PLANE;
    put_layer(pixels, pixels->red, layer + RED * PLANE, kept, layer + ADDED_RED * PLANE, is_additive);
    put_layer(pixels, pixels->green, layer + GREEN * PLANE, kept, layer + ADDED_GREEN * PLANE, is_additive);
    put_layer(pixels, pixels->blue, layer + BLUE * PLANE, kept, layer + ADDED_BLUE * PLANE, is_additive);
    tone_map(pixels, tone);
    encode(pixels, pixels->red);
    encode(pixels, pixels->green);
    encode(pixels, pixels->blue);
    mix(pixels, tone->yuv_from_rgb, layer + DIFFERS * PLANE, pixels->luma);
    mix(pixels, tone->yuv_from_rgb + 4, layer + DIFFERS * PLANE, pixels->u);
    mix(pixels, tone->yuv_from_rgb + 8, layer + DIFFERS * PLANE, pixels->v);
    store(pixels, picture, x0, y0, columns);
}

// `places`: indices into `layers`, row by row of the grid of tiles, `tiles_across` a row.
MULTIVERSION void mr360_composite(const Picture *picture, const Tone *tone, const uint16_t *layers,
                                  const int32_t *places, int64_t count, int32_t tiles_across) {
    Pixels pixels;
    for (int64_t n = 0; n < count; ++n) {
        int32_t x0 = places[n] % tiles_across * TILE, y0 = places[n] / tiles_across * TILE;
        const uint16_t *tile = layers + (int64_t)places[n] * PLANES * PLANE;
        if (tone->is_additive)
            composite_tile(&pixels, picture, x0, y0, tile, tone, 1);
        else
            composite_tile(&pixels, picture, x0, y0, tile, tone, 0);
    }
}
