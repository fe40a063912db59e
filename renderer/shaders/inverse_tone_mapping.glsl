// Iorns & Rhee's operator and its inverse; the twin of renderer/light/inverse_tone_mapping.py.
#include "srgb.glsl"
const vec3 LUMINANCE_WEIGHTS = vec3(0.3, 0.59, 0.11);
const float MAX_RADIANCE = 6.0e4;   // below the largest half float
const float PEAK_GAIN = 11.8;

uniform sampler2D inverse_gain_table;   // R32F, 1 / k by sqrt(luminance / peak)

// Comparisons with NaN are false, so it becomes 0; min and max are undefined for it.
float sanitize(float x) { return x >= 0.0 ? (x < MAX_RADIANCE ? x : MAX_RADIANCE) : 0.0; }
vec3 sanitize(vec3 c) { return vec3(sanitize(c.r), sanitize(c.g), sanitize(c.b)); }

// k of the papers' eq. 2, of linear luminance.
float tone_gain(float luminance) {
    float y = clamp(luminance, 0.0, 1.0), y2 = y * y, y4 = y2 * y2;
    return 1.8 + 10.0 * y4 * y4 * y2;
}

vec3 radiance_from_linear(vec3 rgb) { return rgb * tone_gain(dot(rgb, LUMINANCE_WEIGHTS)); }

vec3 linear_from_radiance(vec3 radiance) {
    float position = sqrt(clamp(dot(radiance, LUMINANCE_WEIGHTS) / PEAK_GAIN, 0.0, 1.0));
    int last = textureSize(inverse_gain_table, 0).x - 1;    // fine enough to need no interpolation
    return radiance * texelFetch(inverse_gain_table, ivec2(int(position * float(last) + 0.5), 0), 0).r;
}
