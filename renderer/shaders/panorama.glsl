// The source frame as radiance: from Y'CbCr planes, from 8-bit R'G'B', or already linear (SOURCE_*, see renderer/frame.py).
#include "inverse_tone_mapping.glsl"

#if SOURCE_YUV
uniform sampler2D luma_plane;      // R8
uniform sampler2D u_plane;         // R8, half size
uniform sampler2D v_plane;
uniform mat4x3 rgb_from_yuv;       // codes / 255 to R'G'B'
#if PACKED
// The same planes with PACKED pixels of luma (8 or 4) and half as many of chroma a texel: a fetch costs about as much as one
// of a single sample.
uniform usampler2D packed_luma;
uniform usampler2D packed_u;
uniform usampler2D packed_v;

vec4 codes(uint four) { return vec4(four & 255u, (four >> 8) & 255u, (four >> 16) & 255u, four >> 24) * (1.0 / 255.0); }
#endif
#else
uniform sampler2D rgb_plane;       // RGBA8 display signal, or RGBA32F radiance
#endif
uniform ivec2 frame_size;

vec3 radiance_from_signal(vec3 signal) {
    return radiance_from_linear(linear_from_srgb(clamp(signal, 0.0, 1.0)));
}

#if SOURCE_YUV
// Luma codes / 255 of 2 x 2 pixels by rows, and their chroma; `first` is even.
#if PACKED
vec4 block_luma(ivec2 first) {
    ivec2 texel = ivec2(first.x / PACKED, first.y);
    uvec2 upper = texelFetch(packed_luma, texel, 0).rg, lower = texelFetch(packed_luma, texel + ivec2(0, 1), 0).rg;
    uvec2 rows = PACKED == 8 && (first.x & 4) != 0 ? uvec2(upper.y, lower.y) : uvec2(upper.x, lower.x);
    rows >>= uint(first.x & 2) * 8u;
    return vec4(rows.x & 255u, (rows.x >> 8) & 255u, rows.y & 255u, (rows.y >> 8) & 255u) * (1.0 / 255.0);
}

vec2 block_chroma(ivec2 first) {
    ivec2 texel = ivec2(first.x / PACKED, first.y >> 1);
    uint shift = uint((first.x >> 1) & (PACKED / 2 - 1)) * 8u;
    uvec2 chroma = uvec2(texelFetch(packed_u, texel, 0).r, texelFetch(packed_v, texel, 0).r);
    return vec2((chroma >> shift) & 255u) * (1.0 / 255.0);
}
#else
vec4 block_luma(ivec2 first) {
    return vec4(texelFetch(luma_plane, first, 0).r, texelFetch(luma_plane, first + ivec2(1, 0), 0).r,
                texelFetch(luma_plane, first + ivec2(0, 1), 0).r, texelFetch(luma_plane, first + ivec2(1, 1), 0).r);
}

vec2 block_chroma(ivec2 first) { return vec2(texelFetch(u_plane, first >> 1, 0).r, texelFetch(v_plane, first >> 1, 0).r); }
#endif
#endif

// The exact value of one pixel as linear light, of the display where the source is for one; chroma is that of its 2x2 block, so that
// writing it back is lossless.
vec3 pixel_linear(ivec2 pixel) {
#if SOURCE_YUV
    vec4 yuv = vec4(texelFetch(luma_plane, pixel, 0).r, texelFetch(u_plane, pixel >> 1, 0).r,
                    texelFetch(v_plane, pixel >> 1, 0).r, 1.0);
    return linear_from_srgb(clamp(rgb_from_yuv * yuv, 0.0, 1.0));
#elif SOURCE_RGB8
    return linear_from_srgb(texelFetch(rgb_plane, pixel, 0).rgb);
#else
    return sanitize(texelFetch(rgb_plane, pixel, 0).rgb);
#endif
}

// Radiance by the tone curve, if there is one between the source and the display, and back.
#if SOURCE_YUV || SOURCE_RGB8
vec3 source_radiance(vec3 linear) { return radiance_from_linear(linear); }
vec3 source_linear(vec3 radiance) { return linear_from_radiance(radiance); }
#else
vec3 source_radiance(vec3 linear) { return linear; }
vec3 source_linear(vec3 radiance) { return radiance; }
#endif

vec3 pixel_radiance(ivec2 pixel) { return source_radiance(pixel_linear(pixel)); }

// 1 where the camera could show no more; a radiance map has no such limit.
const float CLIPPED = 0.985;   // of the display signal's luma
float pixel_clipped(ivec2 pixel) {
#if SOURCE_YUV
    vec4 yuv = vec4(texelFetch(luma_plane, pixel, 0).r, texelFetch(u_plane, pixel >> 1, 0).r,
                    texelFetch(v_plane, pixel >> 1, 0).r, 1.0);
    return step(CLIPPED, dot(rgb_from_yuv * yuv, LUMINANCE_WEIGHTS));
#elif SOURCE_RGB8
    return step(CLIPPED, dot(texelFetch(rgb_plane, pixel, 0).rgb, LUMINANCE_WEIGHTS));
#else
    return 0.0;
#endif
}

// Bilinear look-up, seamless in u because the planes wrap.
vec3 panorama_radiance(vec2 uv) {
#if SOURCE_YUV
    vec4 yuv = vec4(textureLod(luma_plane, uv, 0.0).r, textureLod(u_plane, uv, 0.0).r, textureLod(v_plane, uv, 0.0).r, 1.0);
    return radiance_from_signal(rgb_from_yuv * yuv);
#elif SOURCE_RGB8
    return radiance_from_signal(textureLod(rgb_plane, uv, 0.0).rgb);
#else
    return sanitize(textureLod(rgb_plane, uv, 0.0).rgb);
#endif
}
