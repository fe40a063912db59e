// What mirrors show of the frame: the direction that each pixel looks in, and how much of what is there it gives back, are known from
// shading (shade.frag.glsl); only the frame is another every time.
#include "equirectangular.glsl"
#include "panorama.glsl"

uniform sampler2D shaded;               // without what is mirrored
uniform sampler2D mirror_ray;           // where a mirror's pixel looks in the frame; alpha: 1 for a mirror's
uniform sampler2D mirror_share;
uniform sampler2D radiance_map;         // lights included

out vec4 radiance;

// A mirror's pixel sees a patch of the frame: a few taps over it, and the small map when the patch is larger than that.
vec3 mirror_radiance(vec3 direction, vec3 step_x, vec3 step_y) {
    float footprint = max(length(step_x), length(step_y));
    float pixel = 2.0 * PI / float(frame_size.x);
    float texel = 2.0 * PI / float(textureSize(radiance_map, 0).x);
    float coarse = smoothstep(0.5 * texel, texel, footprint);
    float taps = coarse < 1.0 ? clamp(ceil(footprint / pixel), 1.0, 2.0) : 0.0;
    vec3 sum = vec3(0.0);
    for (float i = 0.5; i < taps; i += 1.0)
        for (float j = 0.5; j < taps; j += 1.0)
            sum += panorama_radiance(uv_from_direction(direction + step_x * (i / taps - 0.5) + step_y * (j / taps - 0.5)));
    return mix(sum / max(taps * taps, 1.0), textureLod(radiance_map, uv_from_direction(direction), 0.0).rgb, coarse);
}

// The step to the next pixel on that side where the two lie in the same mirror, else to the one on the other.
vec3 step_along(ivec2 pixel, ivec2 along, vec3 here) {
    vec4 after = texelFetch(mirror_ray, pixel + along, 0), before = texelFetch(mirror_ray, max(pixel - along, ivec2(0)), 0);
    return after.a > 0.0 ? after.xyz - here : before.a > 0.0 ? here - before.xyz : vec3(0.0);
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec4 ray = texelFetch(mirror_ray, pixel, 0), before = texelFetch(shaded, pixel, 0);
    if (ray.a == 0.0) discard;
#if APART
    vec3 seen = vec3(0.0);      // native/mirror.c adds it
#else
    vec3 seen = mirror_radiance(ray.xyz, step_along(pixel, ivec2(1, 0), ray.xyz), step_along(pixel, ivec2(0, 1), ray.xyz));
#endif
    radiance = vec4(sanitize(before.rgb + texelFetch(mirror_share, pixel, 0).rgb * seen), before.a);
}
