// Where in the frame a pixel looks that shows a mirror, and how much of what is there it gives back: what `native/mirror.c` needs.
#define PERSPECTIVE 1
#define CUBE_FACE 2
#include "equirectangular.glsl"

uniform ivec2 frame_size;
uniform sampler2D mirror_ray;   // of the view's pixels: where they look; alpha: 1 for a mirror's
uniform sampler2D mirror_share; // premultiplied

layout(location = 0) out vec4 place_out;    // u, v; how wide the pixel looks, in radians; 1 for a mirror's
layout(location = 1) out vec4 share_out;

#include "tile.glsl"
#include "object_view.glsl"

struct Mirrored { vec3 ray; vec3 share; float alpha; };

void add(inout Mirrored sum, ivec2 texel, float weight) {
    texel = clamp(texel, ivec2(0), textureSize(mirror_ray, 0) - 1);
    vec4 ray = texelFetch(mirror_ray, texel, 0);
    sum.ray += weight * ray.a * ray.xyz;
    sum.share += weight * texelFetch(mirror_share, texel, 0).rgb;
    sum.alpha += weight * texelFetch(view_texture, texel, 0).a;
}

// The step to the next pixel on that side where the two lie in the same mirror, else to the one on the other.
vec3 step_along(ivec2 pixel, ivec2 along, vec3 here) {
    vec4 after = texelFetch(mirror_ray, pixel + along, 0), before = texelFetch(mirror_ray, max(pixel - along, ivec2(0)), 0);
    return after.a > 0.0 ? after.xyz - here : before.a > 0.0 ? here - before.xyz : vec3(0.0);
}

void main() {
    ivec2 in_tile = ivec2(gl_FragCoord.xy) - cell_fragment;
    Trig t = trig_at(vec2(in_tile) + 0.5);
    vec3 direction = direction_at(vec2(t.sine.x, t.cosine.x), vec2(t.sine.y, t.cosine.y)), d = view_from_world * direction;
    if (!owned(direction)) discard;
    float covered = texelFetch(coverage, coverage_fragment + in_tile, 0).x;
    vec2 uv = view_uv(d), at = uv * view_scale * vec2(textureSize(mirror_ray, 0)) - 0.5, f = fract(at);
    ivec2 corner = ivec2(floor(at)), nearest = ivec2(floor(at + 0.5));
    Mirrored sum = Mirrored(vec3(0.0), vec3(0.0), 0.0);
    add(sum, corner, (1.0 - f.x) * (1.0 - f.y));
    add(sum, corner + ivec2(1, 0), f.x * (1.0 - f.y));
    add(sum, corner + ivec2(0, 1), (1.0 - f.x) * f.y);
    add(sum, corner + 1, f.x * f.y);
    for (int once = sum.alpha < TOUCHED ? 1 : 0; once > 0; --once)    // where only a corner is covered, what is beside it
        for (int i = 0; i < 16; ++i)
            add(sum, corner + ivec2(i % 4, i / 4) - 1, 1.0 / 16.0);
    bool mirrors = in_view(d, uv) && covered > TOUCHED && dot(sum.ray, sum.ray) > 0.0;
    vec3 ray = normalize(mirrors ? sum.ray : vec3(0.0, 1.0, 0.0)), here = texelFetch(mirror_ray, nearest, 0).xyz;
    float width = max(length(step_along(nearest, ivec2(1, 0), here)), length(step_along(nearest, ivec2(0, 1), here)));
    place_out = mirrors ? vec4(uv_from_direction(ray), width, 1.0) : vec4(0.0);
    share_out = vec4(mirrors ? sum.share * (covered / max(sum.alpha, TOUCHED)) : vec3(0.0), 0.0);
}
