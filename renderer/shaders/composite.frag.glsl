// Differential rendering straight into the frame (Debevec 1998, as a ratio): out = object + (1 - a) background E_with / E_without
// in linear light. A pixel that nothing touches keeps its codes. ADDITIVE: as a difference.
#include "equirectangular.glsl"
#include "panorama.glsl"

const float MAX_RATIO = 4.0;    // of what an object's own light adds to the ground

#define NO_VIEW 0
#define PERSPECTIVE 1
#define CUBE_FACE 2

uniform float ground_y;
uniform vec3 ground_irradiance; // without the objects
#if MAPS
uniform sampler2D shadow_atlas;     // share of the light that is hidden
flat in vec4 rect[MAPS];            // of the maps that reach the tile: x0, z0, 1 / width, 1 / depth
flat in vec3 cell[MAPS];            // u0, v0, size in the atlas
flat in vec4 irradiance[MAPS];      // of the light on the open ground; alpha: 1 for the last map of its light
#endif
#if AMBIENTS
uniform sampler2D ambient_atlas;    // irradiance of the residual that is missing
flat in vec4 hidden_rect[AMBIENTS];
flat in vec3 hidden_cell[AMBIENTS];
#endif

#if OUTPUT_YUV
uniform mat4x3 yuv_from_rgb;
layout(location = 0) out vec4 luma_block;   // 2 x 2 pixels
layout(location = 1) out vec4 chroma_block; // u, v
#elif OUTPUT_LAYERS
layout(location = 0) out vec4 factor_out;   // of the ground's light (ADDITIVE: what is less of the tone curve's gain); what is not
layout(location = 1) out vec4 addend_out;   // covered by the objects | their radiance; 1 where the pixel differs
#else
out vec4 pixel_out;                         // radiance, touched
#endif

bool inside(vec2 uv) { return all(greaterThanEqual(uv, vec2(0.0))) && all(lessThanEqual(uv, vec2(1.0))); }

#include "tile.glsl"
#include "object_view.glsl"
#if FLOOR
#include "specular_floor.glsl"
#endif
#if CATCHERS
uniform sampler2D catcher_texture;  // of real surfaces: the ratio of their light times the share of a pixel that shows them, and that
uniform mat3 catcher_from_world;    // rows: right, up, forward
uniform vec4 catcher_bounds;        // left, bottom, 1 / width, 1 / height on the tangent plane
uniform vec2 catcher_scale;         // the part of the texture that the view fills
#endif

vec2 ground_point(vec3 direction) { return direction.xz * (ground_y / min(direction.y, -1e-3)); }

vec3 missing_ambient(vec3 direction) {
    vec3 missing = vec3(0.0);
#if AMBIENTS
    vec2 ground = ground_point(direction);
    for (int i = 0; i < AMBIENTS; ++i) {
        vec2 uv = (ground - hidden_rect[i].xy) * hidden_rect[i].zw;
        vec3 found = textureLod(ambient_atlas, hidden_cell[i].xy + clamp(uv, 0.0, 1.0) * hidden_cell[i].z, 0.0).rgb;
        missing += inside(uv) && direction.y < -1e-3 ? found : vec3(0.0);
    }
#endif
    return missing;
}

vec3 missing_light(vec3 direction) {
    vec3 missing = vec3(0.0);
#if MAPS
    vec2 ground = ground_point(direction);
    float hidden = 0.0;
    for (int i = 0; i < MAPS; ++i) {
        vec2 uv = (ground - rect[i].xy) * rect[i].zw;
        float found = textureLod(shadow_atlas, cell[i].xy + clamp(uv, 0.0, 1.0) * cell[i].z, 0.0).r;
        hidden += inside(uv) && direction.y < -1e-3 ? found : 0.0;
        missing += irradiance[i].rgb * (irradiance[i].a * min(hidden, 1.0));
        hidden *= 1.0 - irradiance[i].a;
    }
#endif
    return missing;
}

// The ground's ratio, where no real surface hides the ground.
vec3 with_catchers(vec3 direction, vec3 ratio) {
#if CATCHERS
    vec3 d = catcher_from_world * direction;
    vec2 uv = (d.xy / max(d.z, 1e-6) - catcher_bounds.xy) * catcher_bounds.zw;
    vec4 found = textureLod(catcher_texture, clamp(uv, 0.0, 1.0) * catcher_scale, 0.0);
    return ratio * (1.0 - found.a) + found.rgb;
#else
    return ratio;
#endif
}

vec4 object_radiance(vec3 direction, float covered) {
#if VIEW
    vec3 d = view_from_world * direction;
    vec2 uv = view_uv(d);
    vec4 found = in_view(d, uv) ? textureLod(view_texture, uv * view_scale, 0.0) : vec4(0.0);
    // Where only a corner is covered, what is beside it; a loop, because a software renderer leaves one that no pixel enters.
    for (int once = covered > TOUCHED && found.a < TOUCHED ? 1 : 0; once > 0; --once) {
        vec2 beside = 0.6 * 2.0 * PI / float(frame_size.x) * view_bounds.zw * view_scale, at = uv * view_scale;
        found = textureLod(view_texture, at + beside, 0.0) + textureLod(view_texture, at - beside, 0.0)
            + textureLod(view_texture, at + vec2(beside.x, -beside.y), 0.0) + textureLod(view_texture, at + vec2(-beside.x, beside.y), 0.0);
    }
    return found * (covered / max(found.a, TOUCHED));
#else
    return vec4(0.0);
#endif
}

// What the pixel in this direction needs: the objects' radiance, the ground's ratio, and what the ground mirrors.
#if !FLOOR
struct Floor { vec4 mirrored; };
#endif
struct Layers { vec4 object; vec3 ratio; Floor ground; };

Layers layers_at(vec3 direction, vec3 missing_residual, float covered) {
    vec3 missing = missing_residual + missing_light(direction);
    vec3 ratio = clamp(1.0 - missing / max(ground_irradiance, vec3(1e-6)), 0.0, MAX_RATIO);
    ratio = mix(ratio, vec3(1.0), lessThan(ground_irradiance, vec3(1e-6)));
    return Layers(object_radiance(direction, covered), with_catchers(direction, ratio),
#if FLOOR
        floor_at(direction));
#else
        Floor(vec4(0.0)));
#endif
}

bool differs(Layers layers) { return max(layers.object.a, layers.ground.mirrored.a) > TOUCHED || any(greaterThan(abs(layers.ratio - 1.0), vec3(TOUCHED))); }

// `linear`: the pixel as the display shows it; `opposite`: the radiance that the ground mirrored there. The ratio is one of the
// camera's linear light: on its picture of a diffuse surface it is exact. The tone curve, made for light sources, would take nearly
// all of the shadow from a bright ground.
vec3 composite(Layers layers, vec3 linear, vec3 opposite) {
#if ADDITIVE
    // background + (L_with - L_without), L = albedo E / pi, as MR360 has it (6.4): as albedo it takes the video's pixel, in linear
    // display light, right or not. The sum is one of radiances; the paper does not say in which scale its own is.
    vec3 lost = min(linear, vec3(1.0)) * (1.0 - layers.ratio) * ground_irradiance / PI;
    vec3 background = max(source_radiance(linear) - lost, 0.0);
#if FLOOR
    background = with_floor(layers.ground, background, vec3(1.0), opposite);
#endif
#elif FLOOR
    vec3 background = with_floor(layers.ground, source_radiance(linear), layers.ratio, opposite);
#else
    vec3 background = source_radiance(linear * layers.ratio);
#endif
    return background * (1.0 - layers.object.a) + layers.object.rgb;
}

vec4 covered_at(ivec2 fragment) {
#if VIEW
    return texelFetch(coverage, coverage_fragment + fragment, 0);
#else
    return vec4(0.0);
#endif
}

#if OUTPUT_YUV
// `mirrored_yuv`: of the pixel opposite; `middle`: of the block of four.
vec3 opposite_radiance(Layers layers, vec3 mirrored_yuv, vec2 middle) {
    vec3 found = vec3(0.0);
#if FLOOR
    for (int once = layers.ground.mirrored.a > TOUCHED ? 1 : 0; once > 0; --once)  // a loop: see object_radiance
        found = floor_environment(radiance_from_signal(rgb_from_yuv * vec4(mirrored_yuv, 1.0)), middle);
#endif
    return found;
}

vec3 composited_yuv(vec2 azimuth_trig, vec2 polar_trig, vec3 missing_residual, vec3 yuv, float covered, vec3 mirrored_yuv,
                    vec2 middle) {
    Layers layers = layers_at(direction_at(azimuth_trig, polar_trig), missing_residual, covered);
    vec3 result = composite(layers, linear_from_srgb(clamp(rgb_from_yuv * vec4(yuv, 1.0), 0.0, 1.0)),
                            opposite_radiance(layers, mirrored_yuv, middle));
    vec3 new_yuv = yuv_from_rgb * vec4(srgb_from_linear(linear_from_radiance(result)), 1.0);
    return differs(layers) ? new_yuv : yuv;
}

// Four pixels a fragment, written out: a software renderer keeps in memory what lives across a loop.
void main() {
    ivec2 in_tile = (ivec2(gl_FragCoord.xy) - cell_fragment) * 2;
    Trig near = trig_at(vec2(in_tile) + 0.5), far = trig_at(vec2(in_tile) + 1.5), middle = trig_at(vec2(in_tile) + 1.0);
    vec3 centre = direction_at(vec2(middle.sine.x, middle.cosine.x), vec2(middle.sine.y, middle.cosine.y));
    if (!owned(centre)) discard;
    vec3 missing_residual = missing_ambient(centre);    // smooth: once for four pixels
    ivec2 first = min(first_pixel + in_tile, frame_size - 2);
    vec4 luma = block_luma(first);
    vec2 chroma = block_chroma(first);
    vec4 covered = covered_at(ivec2(gl_FragCoord.xy) - cell_fragment);
    vec4 mirrored_luma = vec4(0.0);
    vec2 mirrored_chroma = vec2(0.0), block = vec2(first) + 1.0;
#if FLOOR
    ivec2 opposite = ivec2(first.x, frame_size.y - 2 - first.y);
    mirrored_luma = block_luma(opposite).zwxy;
    mirrored_chroma = block_chroma(opposite);
#endif
    vec2 left = vec2(near.sine.x, near.cosine.x), right = vec2(far.sine.x, far.cosine.x);
    vec2 upper = vec2(near.sine.y, near.cosine.y), lower = vec2(far.sine.y, far.cosine.y);
    vec3 upper_left = composited_yuv(left, upper, missing_residual, vec3(luma.x, chroma), covered.x,
                                      vec3(mirrored_luma.x, mirrored_chroma), block);
    vec3 upper_right = composited_yuv(right, upper, missing_residual, vec3(luma.y, chroma), covered.y,
                                      vec3(mirrored_luma.y, mirrored_chroma), block);
    vec3 lower_left = composited_yuv(left, lower, missing_residual, vec3(luma.z, chroma), covered.z,
                                      vec3(mirrored_luma.z, mirrored_chroma), block);
    vec3 lower_right = composited_yuv(right, lower, missing_residual, vec3(luma.w, chroma), covered.w,
                                      vec3(mirrored_luma.w, mirrored_chroma), block);
    luma_block = vec4(upper_left.x, upper_right.x, lower_left.x, lower_right.x);
    chroma_block = vec4(0.25 * (upper_left.yz + upper_right.yz + lower_left.yz + lower_right.yz), 0.0, 1.0);
}
#else
void main() {
    ivec2 in_tile = ivec2(gl_FragCoord.xy) - cell_fragment;
    Trig t = trig_at(vec2(in_tile) + 0.5);
    vec3 direction = direction_at(vec2(t.sine.x, t.cosine.x), vec2(t.sine.y, t.cosine.y));
    if (!owned(direction)) discard;
    Layers layers = layers_at(direction, missing_ambient(direction), covered_at(in_tile).x);
#if OUTPUT_LAYERS
#if ADDITIVE
    vec3 factor = (1.0 - layers.ratio) * ground_irradiance / PI;
#else
    vec3 factor = layers.ratio;
#endif
    factor_out = vec4(factor, 1.0 - layers.object.a);
    addend_out = vec4(clamp(layers.object.rgb, 0.0, MAX_RADIANCE), differs(layers) ? 1.0 : 0.0);
#else
    vec3 linear = pixel_linear(min(first_pixel + in_tile, frame_size - 1));
    vec3 opposite = vec3(0.0);
#if FLOOR
    ivec2 mirrored = ivec2(first_pixel.x + in_tile.x, frame_size.y - 1 - first_pixel.y - in_tile.y);
    opposite = floor_environment(pixel_radiance(clamp(mirrored, ivec2(0), frame_size - 1)), vec2(first_pixel + in_tile) + 0.5);
#endif
    pixel_out = vec4(composite(layers, linear, opposite), differs(layers) ? 1.0 : 0.0);
#endif
}
#endif
