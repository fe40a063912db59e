// Fused inverse tone mapping and box reduction of the frame to a small radiance map.
// The mean is over linear radiance after the tone curve (the other order loses highlights), each row by its solid angle.
// Alpha is the share of the texel's solid angle that the camera has clipped.
#include "equirectangular.glsl"
#include "panorama.glsl"

uniform ivec2 map_size;
out vec4 texel;

const float CLIPPED = 0.985;   // of the display signal

#if PACKED
// Four pixels of luma, two of chroma a texel: a fetch costs the same as one of a single sample.
uniform sampler2D packed_luma;     // RGBA8, width / 4
uniform sampler2D packed_u;        // RG8, width / 4
uniform sampler2D packed_v;

// Decoding without roots and without the branch for the toe, within 0.7 % of (value + 0.02): enough for a mean of light.
#define DECODED(s) ((s) * ((s) * ((s) * ((s) * ((s) * 0.84252675 - 1.90690802) + 1.80608963) + 0.19945037) + 0.06561054))

// Radiance of a grey with that display signal.
vec4 grey_radiance(vec4 v) {
    vec4 v2 = v * v, v5 = v2 * v2 * v;
    return DECODED(v) * (10.0 * v5 * v5 + 1.8);
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

// A cell of 4 x 2 pixels.
vec4 cell_radiance(ivec2 cell) {
    vec4 upper = texelFetch(packed_luma, ivec2(cell.x, cell.y * 2), 0) * rgb_from_yuv[0][0];
    vec4 lower = texelFetch(packed_luma, ivec2(cell.x, cell.y * 2 + 1), 0) * rgb_from_yuv[0][0];
    vec2 u = texelFetch(packed_u, cell, 0).rg, v = texelFetch(packed_v, cell, 0).rg;
    vec3 left = rgb_from_yuv[1] * u.x + rgb_from_yuv[2] * v.x + rgb_from_yuv[3];
    vec3 right = rgb_from_yuv[1] * u.y + rgb_from_yuv[2] * v.y + rgb_from_yuv[3];
    return block_radiance(left, vec4(upper.xy, lower.xy)) + block_radiance(right, vec4(upper.zw, lower.zw));
}
#endif

#if PACKED
const ivec2 CELL = ivec2(4, 2);
#else
const ivec2 CELL = ivec2(1, 1);
vec4 cell_radiance(ivec2 pixel) { return vec4(pixel_radiance(pixel), 0.0); }
#endif

void main() {
    ivec2 cells = frame_size / CELL;
    ivec2 index = ivec2(gl_FragCoord.xy);
#if BLOCK_WIDTH
    // constant bounds let the compiler unroll: a third of the time
    const ivec2 count = ivec2(BLOCK_WIDTH, BLOCK_HEIGHT) / CELL;
    ivec2 first = index * count;
#else
    ivec2 first = index * cells / map_size;
    ivec2 count = max((index + 1) * cells / map_size - first, ivec2(1));
#endif
    vec4 sum = vec4(0.0);
    float weights = 0.0;
    for (int y = 0; y < count.y; ++y) {
        float weight = sin((float(first.y + y) + 0.5) / float(cells.y) * PI);
        vec4 row = vec4(0.0);
        for (int x = 0; x < count.x; ++x)
            row += cell_radiance(first + ivec2(x, y));
        sum += weight * row;
        weights += weight;
    }
    texel = sum / (weights * float(count.x * CELL.x * CELL.y));
}
