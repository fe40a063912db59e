// Where inside a texel of the radiance map its light is: mean luminance, and its moments about the texel's centre in radians to the
// right, downwards, and squared. Weighted by solid angle; the frame's own pixels, exactly decoded.
#include "equirectangular.glsl"
#include "panorama.glsl"

uniform ivec2 map_size;
flat in int texel_index;
out vec4 moments;

#if SOURCE_YUV
const int SIDE = 2;
vec4 luminances(ivec2 cell) {
    vec4 luma = block_luma(cell * 2);
    vec2 chroma = block_chroma(cell * 2);
    vec3 offset = rgb_from_yuv[1] * chroma.x + rgb_from_yuv[2] * chroma.y + rgb_from_yuv[3];
    return vec4(dot(radiance_from_signal(rgb_from_yuv[0] * luma.x + offset), LUMINANCE_WEIGHTS),
                dot(radiance_from_signal(rgb_from_yuv[0] * luma.y + offset), LUMINANCE_WEIGHTS),
                dot(radiance_from_signal(rgb_from_yuv[0] * luma.z + offset), LUMINANCE_WEIGHTS),
                dot(radiance_from_signal(rgb_from_yuv[0] * luma.w + offset), LUMINANCE_WEIGHTS));
}
#else
const int SIDE = 1;
vec4 luminances(ivec2 cell) { return vec4(dot(pixel_radiance(cell), LUMINANCE_WEIGHTS)); }
#endif

void main() {
    ivec2 cells = frame_size / SIDE, texel = ivec2(texel_index % map_size.x, texel_index / map_size.x);
    ivec2 first = texel * cells / map_size, end = (texel + 1) * cells / map_size;
    vec2 pixel = vec2(2.0 * PI, PI) / vec2(frame_size), centre = (vec2(texel) + 0.5) / vec2(map_size) * vec2(frame_size);
    vec4 sum = vec4(0.0);
    float weights = 0.0;
    for (int y = first.y; y < end.y; ++y)
        for (int x = first.x; x < end.x; ++x) {
            vec4 light = luminances(ivec2(x, y));
            for (int i = 0; i < SIDE * SIDE; ++i) {
                vec2 at = vec2(x, y) * float(SIDE) + vec2(i % SIDE, i / SIDE) + 0.5;
                float weight = sin(at.y * pixel.y);
                vec2 across = pixel * vec2(weight, 1.0), away = (at - centre) * across;
                // a camera's pixel is a mean over its area, which spreads what it shows by that much
                sum += weight * light[i] * vec4(1.0, away, dot(away, away) - dot(across, across) / 12.0);
                weights += weight;
            }
        }
    moments = sum / max(weights, 1e-12);
}
