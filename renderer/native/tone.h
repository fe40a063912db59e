// Transfer function and tone curve, one value at a time, so that loops over them are vectorized.
// The twins of renderer/shaders/srgb.glsl and inverse_tone_mapping.glsl, with the same polynomials.
#pragma once
#include <math.h>
#include <stdint.h>
#include <string.h>

// The loops below are built for processors with AVX-512, with AVX2, and for any; the loader takes the best that there is.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define MULTIVERSION __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define MULTIVERSION
#endif
#define INLINE static inline __attribute__((always_inline))

// NaN becomes `low`. Written like this, each half is one instruction.
INLINE float clamped(float x, float low, float high) {
    x = x > low ? x : low;
    return x < high ? x : high;
}

INLINE float linear_from_srgb(float s) {
    float t = s * (1.0f / 1.055f) + 0.055f / 1.055f, r = sqrtf(t);
    float curve = t * t * (r * (r * (r * 0.10578159f - 0.34983108f) + 1.19129606f) + 0.05302950f);
    return s <= 0.04045f ? s * (1.0f / 12.92f) : curve;
}

INLINE float srgb_from_linear(float l) {
    float q = sqrtf(sqrtf(l));
    float curve = q * (q * (q * (q * 0.08132964f - 0.33550073f) + 1.12268090f) + 0.19613612f) - 0.06461157f;
    return l <= 0.0031308f ? l * 12.92f : curve;
}

INLINE float luminance(float r, float g, float b) { return 0.3f * r + 0.59f * g + 0.11f * b; }

// k of Iorns & Rhee's eq. 2, of linear luminance in [0, 1].
INLINE float tone_gain(float y) {
    float y2 = y * y, y4 = y2 * y2;
    return 1.8f + 10.0f * y4 * y4 * y2;
}

// A half float that is not infinite.
INLINE float from_half(uint16_t half) {
    uint32_t bits = (uint32_t)(half & 0x8000u) << 16 | (uint32_t)(half & 0x7fffu) << 13;
    float value;
    memcpy(&value, &bits, sizeof value);
    return value * 0x1p112f;
}
