// What mirrors show of the frame: the look-ups of renderer/shaders/mirror.frag.glsl, for pixels of the frame whose place there is known.
#include "planes.h"
#include "tone.h"

#define PI 3.14159265359f

typedef struct {
    const float *texels;    // (height, width, 4) radiance
    int64_t width, height;
} Map;

typedef struct {
    int64_t at;             // index of its added red in the layers; green and blue are a plane further each
    float u, v, width;      // where it looks, and how wide in radians
    float share[3], base[3];    // of what is there; without it
} Mirrored;

typedef struct {
    int64_t left, right, upper, lower;
    float x, y;
} Corners;

// Of a bilinear look-up that wraps around in u.
INLINE Corners corners_of(float u, float v, int64_t width, int64_t height) {
    float x = u * (float)width - 0.5f, y = clamped(v * (float)height - 0.5f, 0.0f, (float)(height - 1));
    int64_t column = (int64_t)floorf(x), row = (int64_t)y;
    Corners found = {.x = x - floorf(x), .y = y - (float)row, .upper = row, .lower = row + 1 < height ? row + 1 : row};
    found.left = ((column % width) + width) % width;
    found.right = found.left + 1 == width ? 0 : found.left + 1;
    return found;
}

INLINE float mixed(const Corners *c, float upper_left, float upper_right, float lower_left, float lower_right) {
    float upper = upper_left + c->x * (upper_right - upper_left), lower = lower_left + c->x * (lower_right - lower_left);
    return upper + c->y * (lower - upper);
}

INLINE float code(const uint8_t *plane, int64_t stride, const Corners *c) {
    const uint8_t *upper = plane + c->upper * stride, *lower = plane + c->lower * stride;
    return mixed(c, upper[c->left], upper[c->right], lower[c->left], lower[c->right]) * (1.0f / 255.0f);
}

INLINE void add_frame(const Picture *picture, const float *m, float u, float v, float weight, float *sum) {
    Corners luma = corners_of(u, v, picture->width, picture->height), chroma = corners_of(u, v, picture->width / 2, picture->height / 2);
    float y = code(picture->y, picture->y_stride, &luma), cb = code(picture->u, picture->u_stride, &chroma);
    float cr = code(picture->v, picture->v_stride, &chroma), linear[3];
    for (int i = 0; i < 3; ++i)
        linear[i] = linear_from_srgb(clamped(m[4 * i] * y + m[4 * i + 1] * cb + m[4 * i + 2] * cr + m[4 * i + 3], 0.0f, 1.0f));
    float gain = weight * tone_gain(luminance(linear[0], linear[1], linear[2]));
    for (int i = 0; i < 3; ++i) sum[i] += gain * linear[i];
}

INLINE void add_map(const Map *map, float u, float v, float weight, float *sum) {
    Corners c = corners_of(u, v, map->width, map->height);
    const float *upper = map->texels + 4 * c.upper * map->width, *lower = map->texels + 4 * c.lower * map->width;
    for (int i = 0; i < 3; ++i)
        sum[i] += weight * mixed(&c, upper[4 * c.left + i], upper[4 * c.right + i], lower[4 * c.left + i], lower[4 * c.right + i]);
}

// A mirror's pixel sees a patch of the frame: a few taps over it, and the small map when the patch is larger than that.
INLINE void look(const Picture *picture, const Map *map, const float *m, const Mirrored *pixel, float *seen) {
    float texel = 2.0f * PI / (float)map->width, step = clamped((pixel->width - 0.5f * texel) / (0.5f * texel), 0.0f, 1.0f);
    float coarse = step * step * (3.0f - 2.0f * step);
    seen[0] = seen[1] = seen[2] = 0.0f;
    if (coarse > 0.0f) add_map(map, pixel->u, pixel->v, coarse, seen);
    if (coarse >= 1.0f) return;
    if (pixel->width * (float)picture->width <= 2.0f * PI) {
        add_frame(picture, m, pixel->u, pixel->v, 1.0f - coarse, seen);
        return;
    }
    float sine = sinf(clamped(pixel->v, 0.0f, 1.0f) * PI), du = 0.25f * pixel->width / (2.0f * PI * (sine > 0.05f ? sine : 0.05f));
    float dv = 0.25f * pixel->width / PI;
    for (int i = 0; i < 4; ++i)
        add_frame(picture, m, pixel->u + (i % 2 ? du : -du), pixel->v + (i / 2 ? dv : -dv), 0.25f * (1.0f - coarse), seen);
}

INLINE uint16_t half_from(float value) {
    uint32_t bits;
    value = clamped(value, 0.0f, 6.0e4f) * 0x1p-112f;
    memcpy(&bits, &value, sizeof bits);
    return (uint16_t)((bits + 0x1000u) >> 13);
}

// Puts what each pixel sees, and its base, into the layers, whose planes are `plane` values apart.
void mr360_mirror(const Picture *picture, const Map *map, const float *rgb_from_yuv, const Mirrored *pixels, int64_t count,
                  int64_t plane, uint16_t *layers) {
    for (int64_t n = 0; n < count; ++n) {
        float seen[3];
        look(picture, map, rgb_from_yuv, &pixels[n], seen);
        for (int i = 0; i < 3; ++i)
            layers[pixels[n].at + i * plane] = half_from(pixels[n].base[i] + pixels[n].share[i] * seen[i]);
    }
}
