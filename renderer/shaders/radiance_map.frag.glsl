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

// Minimax polynomials in place of pow and without a branch for the toe: five times faster. Error of the decoding at most
// 0.7 % of (value + 0.02), of k 0.1 %.
vec4 fast_radiance(vec3 signal) {
    vec3 s = clamp(signal, 0.0, 1.0);
    vec3 rgb = s * (s * (s * (s * (s * 0.84252675 - 1.90690802) + 1.80608963) + 0.19945037) + 0.06561054);
    float y = dot(rgb, LUMINANCE_WEIGHTS), y2 = y * y;
    float s10 = y2 * y * (y2 * 0.3260031 + (y * 0.77051668 - 0.0954733));
    return vec4(rgb * (10.0 * s10 + 1.8), step(CLIPPED, s.g));
}

// A cell of 4 x 2 pixels.
vec4 cell_radiance(ivec2 cell) {
    vec4 upper = texelFetch(packed_luma, ivec2(cell.x, cell.y * 2), 0) * rgb_from_yuv[0][0];
    vec4 lower = texelFetch(packed_luma, ivec2(cell.x, cell.y * 2 + 1), 0) * rgb_from_yuv[0][0];
    vec2 u = texelFetch(packed_u, cell, 0).rg, v = texelFetch(packed_v, cell, 0).rg;
    vec3 left = rgb_from_yuv[1] * u.x + rgb_from_yuv[2] * v.x + rgb_from_yuv[3];
    vec3 right = rgb_from_yuv[1] * u.y + rgb_from_yuv[2] * v.y + rgb_from_yuv[3];
    return fast_radiance(left + upper.x) + fast_radiance(left + upper.y) + fast_radiance(right + upper.z)
         + fast_radiance(right + upper.w) + fast_radiance(left + lower.x) + fast_radiance(left + lower.y)
         + fast_radiance(right + lower.z) + fast_radiance(right + lower.w);
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
