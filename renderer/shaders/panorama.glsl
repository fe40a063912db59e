// The source frame as radiance: from Y'CbCr planes, from 8-bit R'G'B', or already linear (SOURCE_*, see renderer/frame.py).
#include "inverse_tone_mapping.glsl"

#if SOURCE_YUV
uniform sampler2D luma_plane;      // R8
uniform sampler2D u_plane;         // R8, half size
uniform sampler2D v_plane;
uniform mat4x3 rgb_from_yuv;       // codes / 255 to R'G'B'
#else
uniform sampler2D rgb_plane;       // RGBA8 display signal, or RGBA32F radiance
#endif
uniform ivec2 frame_size;

vec3 radiance_from_signal(vec3 signal) {
    return radiance_from_linear(linear_from_srgb(clamp(signal, 0.0, 1.0)));
}

#if SOURCE_YUV
// Luma codes of 2 x 2 pixels by rows; `first` is even.
vec4 block_luma(ivec2 first) {
    return vec4(texelFetch(luma_plane, first, 0).r, texelFetch(luma_plane, first + ivec2(1, 0), 0).r,
                texelFetch(luma_plane, first + ivec2(0, 1), 0).r, texelFetch(luma_plane, first + ivec2(1, 1), 0).r);
}
#endif

// The exact value of one pixel; chroma is that of its 2x2 block, so that writing it back is lossless.
vec3 pixel_radiance(ivec2 pixel) {
#if SOURCE_YUV
    vec4 yuv = vec4(texelFetch(luma_plane, pixel, 0).r, texelFetch(u_plane, pixel >> 1, 0).r,
                    texelFetch(v_plane, pixel >> 1, 0).r, 1.0);
    return radiance_from_signal(rgb_from_yuv * yuv);
#elif SOURCE_RGB8
    return radiance_from_signal(texelFetch(rgb_plane, pixel, 0).rgb);
#else
    return sanitize(texelFetch(rgb_plane, pixel, 0).rgb);
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
