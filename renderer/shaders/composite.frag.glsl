// Differential rendering straight into the frame (Debevec 1998, as a ratio): out = object + (1 - a) background E_with / E_without
// in linear light, then back through the tone curve. A pixel that nothing touches keeps its codes.
#include "equirectangular.glsl"
#include "panorama.glsl"

const int MAX_MAPS = 16;        // shadow maps that may meet in one tile
const float TOUCHED = 1.0 / 1024.0;

uniform int has_view;
uniform sampler2D view_texture; // premultiplied radiance of the objects in one perspective view
uniform mat3 view_from_world;   // rows: right, up, forward
uniform vec4 view_bounds;       // left, bottom, 1 / width, 1 / height on the tangent plane
uniform vec2 view_scale;       // the part of the texture that the view fills
uniform int view_axis;          // cube face that owns a pixel: 2 * axis + negative; -1: the view owns the whole tile

uniform float ground_y;
uniform vec3 ground_irradiance; // without the objects
uniform int map_count;
uniform vec4 map_rect[MAX_MAPS];        // x0, z0, 1 / width, 1 / depth
uniform vec4 map_cell[MAX_MAPS];        // u0, v0, du, dv in the atlas
uniform vec3 map_irradiance[MAX_MAPS];  // of the light on the open ground
uniform int map_ends_light[MAX_MAPS];   // the last map of its light
uniform sampler2D shadow_atlas;
uniform int ambient_count;
uniform vec4 ambient_rect[MAX_MAPS];
uniform vec4 ambient_cell[MAX_MAPS];
uniform sampler2D transfer_0;
uniform sampler2D transfer_1;
uniform sampler2D transfer_2;
uniform vec3 residual_sh[9];            // L_lm

flat in ivec2 pixel_offset;

#if OUTPUT_YUV
uniform mat4x3 yuv_from_rgb;
layout(location = 0) out vec4 luma_block;   // 2 x 2 pixels
layout(location = 1) out vec4 chroma_block; // u, v
#else
out vec4 pixel_out;                         // radiance, touched
#endif

bool inside(vec2 uv) { return all(greaterThanEqual(uv, vec2(0.0))) && all(lessThanEqual(uv, vec2(1.0))); }

vec3 missing_irradiance(vec2 ground) {
    vec3 missing = vec3(0.0);
    float hidden = 0.0;
    for (int i = 0; i < map_count; ++i) {
        vec2 uv = (ground - map_rect[i].xy) * map_rect[i].zw;
        if (inside(uv)) hidden += textureLod(shadow_atlas, map_cell[i].xy + uv * map_cell[i].zw, 0.0).r;
        if (map_ends_light[i] != 0) {
            missing += map_irradiance[i] * min(hidden, 1.0);
            hidden = 0.0;
        }
    }
    for (int i = 0; i < ambient_count; ++i) {
        vec2 uv = (ground - ambient_rect[i].xy) * ambient_rect[i].zw;
        vec2 from_centre = uv * 2.0 - 1.0;
        float reach = 1.0 - smoothstep(0.6, 1.0, length(from_centre)); // no visible end of the map
        if (reach <= 0.0) continue;
        vec2 at = ambient_cell[i].xy + uv * ambient_cell[i].zw;
        vec4 a = textureLod(transfer_0, at, 0.0), b = textureLod(transfer_1, at, 0.0);
        float c = textureLod(transfer_2, at, 0.0).r;
        missing += reach * max(vec3(0.0), a.x * residual_sh[0] + a.y * residual_sh[1] + a.z * residual_sh[2] + a.w * residual_sh[3]
            + b.x * residual_sh[4] + b.y * residual_sh[5] + b.z * residual_sh[6] + b.w * residual_sh[7] + c * residual_sh[8]);
    }
    return missing;
}

vec3 ground_ratio(vec3 direction) {
    if (map_count + ambient_count == 0 || direction.y > -1e-3) return vec3(1.0);
    vec2 ground = direction.xz * (ground_y / direction.y);
    vec3 ratio = clamp(1.0 - missing_irradiance(ground) / max(ground_irradiance, vec3(1e-6)), 0.0, 1.0);
    return mix(ratio, vec3(1.0), lessThan(ground_irradiance, vec3(1e-6)));
}

vec4 object_radiance(vec3 direction) {
    vec3 d = view_from_world * direction;
    if (has_view == 0 || d.z <= 0.0) return vec4(0.0);
    vec2 uv = (d.xy / d.z - view_bounds.xy) * view_bounds.zw;
    return inside(uv) ? textureLod(view_texture, uv * view_scale, 0.0) : vec4(0.0);
}

// What the pixel in this direction needs: the objects' radiance and the ground's ratio.
struct Layers { vec4 object; vec3 ratio; };

Layers layers_at(vec3 direction) { return Layers(object_radiance(direction), ground_ratio(direction)); }

bool differs(Layers layers) { return layers.object.a > TOUCHED || any(lessThan(layers.ratio, vec3(1.0 - TOUCHED))); }

vec3 composite(Layers layers, vec3 background) {
    return background * layers.ratio * (1.0 - layers.object.a) + layers.object.rgb;
}

bool owned(ivec2 pixel) {
    if (view_axis < 0) return true;
    vec3 d = direction_from_uv((vec2(pixel) + 0.5) / vec2(frame_size)), a = abs(d);
    int axis = a.x >= a.y && a.x >= a.z ? 0 : (a.y >= a.z ? 1 : 2);
    return view_axis == 2 * axis + (d[axis] < 0.0 ? 1 : 0);
}

#if OUTPUT_YUV
void main() {
    ivec2 first = ivec2(gl_FragCoord.xy) * 2 + pixel_offset;
    if (!owned(first)) discard;
    ivec2 chroma_pixel = clamp(first >> 1, ivec2(0), frame_size / 2 - 1);
    vec2 chroma = vec2(texelFetch(u_plane, chroma_pixel, 0).r, texelFetch(v_plane, chroma_pixel, 0).r);
    // the trigonometry of four pixels at the price of one, by the addition theorems
    vec2 pixel_angle = vec2(2.0, 1.0) * PI / vec2(frame_size);
    vec2 angle = (vec2(first) + 0.5) * pixel_angle - vec2(PI, 0.0);
    vec2 sine = sin(angle), cosine = cos(angle), step_sine = sin(pixel_angle), step_cosine = cos(pixel_angle);
    vec4 luma;
    vec2 new_chroma = vec2(0.0);
    for (int i = 0; i < 4; ++i) {
        ivec2 offset = ivec2(i & 1, i >> 1);
        vec2 s = mix(sine, sine * step_cosine + cosine * step_sine, vec2(offset));
        vec2 c = mix(cosine, cosine * step_cosine - sine * step_sine, vec2(offset));
        Layers layers = layers_at(vec3(s.y * s.x, c.y, -s.y * c.x));
        vec3 yuv = vec3(texelFetch(luma_plane, min(first + offset, frame_size - 1), 0).r, chroma);
        // a loop, because a software renderer runs both sides of an if but leaves a loop that no pixel enters
        for (int once = differs(layers) ? 1 : 0; once > 0; --once) {
            vec3 result = composite(layers, radiance_from_signal(rgb_from_yuv * vec4(yuv, 1.0)));
            yuv = yuv_from_rgb * vec4(srgb_from_linear(linear_from_radiance(result)), 1.0);
        }
        luma[i] = yuv.x;
        new_chroma += 0.25 * yuv.yz;
    }
    luma_block = luma;
    chroma_block = vec4(new_chroma, 0.0, 1.0);
}
#else
void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy) + pixel_offset;
    if (!owned(pixel)) discard;
    pixel = min(pixel, frame_size - 1);
    Layers layers = layers_at(direction_from_uv((vec2(pixel) + 0.5) / vec2(frame_size)));
    pixel_out = vec4(composite(layers, pixel_radiance(pixel)), differs(layers) ? 1.0 : 0.0);
}
#endif
