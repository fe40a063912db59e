// glTF metallic-roughness under the light of the frame, once for every pixel of a view: an irradiance map and lights for
// the diffuse part, a prefiltered map (or the frame itself, for mirrors) and lights for the glossy part. Camera at the origin.
#include "equirectangular.glsl"
#include "panorama.glsl"
#if HAS_RINGS
#include "rings.glsl"
#endif

const int MAX_LOBES = 16;

uniform sampler2D geometry;             // 2 x 2 samples a pixel: normal times distance; surface, 0 for none
#if DETAILED
uniform sampler2D color_metallic;       // of the samples
uniform sampler2D emissive_roughness;
#endif
uniform sampler2D surfaces;             // a row a surface: colour + metallic, emissive + roughness, its lobe map, near field
uniform mat3 world_from_view;           // columns: right, up, forward
uniform float camera_y;                 // 0 but for the camera's mirror image in the ground
uniform vec4 view_bounds;               // left, bottom, width, height on the tangent plane
uniform vec2 view_size;
uniform ivec2 surface_range;            // first and last surface of the object that is shaded

uniform vec3 light_direction[LIGHTS];
uniform float light_below[LIGHTS];      // share of its disc that is under the horizon, on the ground
uniform vec3 light_irradiance[LIGHTS];  // 0 for an unused entry
uniform float light_radius[LIGHTS];
uniform sampler2D light_visibility;     // a channel for each of the first four; one texel where all are visible everywhere
uniform int has_light_visibility;
uniform sampler2D lobe_atlas;           // irradiance, and maps prefiltered for each roughness in use; lights taken out
uniform vec3 irradiance_cell;           // u scale, v offset, v scale in the atlas
uniform vec4 lobe[MAX_LOBES];           // roughness; u scale, v offset, v scale in the atlas
uniform float lobe_border;              // u of the first column
uniform int lobe_count;
uniform sampler2D radiance_map;         // lights included
uniform sampler2D dfg_table;
uniform float mirror_below;             // roughness
uniform float ground_y;
uniform int has_ground;

layout(location = 0) out vec4 radiance;
#if HAS_MIRRORS
layout(location = 1) out vec4 mirror_ray_out;   // where the pixel looks in the frame; alpha: 1 for a mirror's
layout(location = 2) out vec4 mirror_share_out; // of what is there
vec3 seen_in_mirror, seen_share;                // of the surface that was shaded last
#endif

#include "near_field.glsl"

// uv_from_direction to 2e-4 radians, a hundredth of a small map's texel, at a fraction of its cost: a minimax polynomial for the
// arctangent, and acos by Hastings (Abramowitz & Stegun 4.4.45).
vec2 coarse_uv(vec3 unit) {
    vec2 size = abs(unit.xz);
    float ratio = min(size.x, size.y) / max(max(size.x, size.y), 1e-12), square = ratio * ratio;
    float azimuth = ratio * (1.0 + square * (-0.327622764 + square * (0.15931422 - square * 0.0464964749)));
    azimuth = size.x > size.y ? 0.5 * PI - azimuth : azimuth;
    azimuth = unit.z > 0.0 ? PI - azimuth : azimuth;
    float y = min(abs(unit.y), 1.0), polar = sqrt(1.0 - y) * (1.5707288 + y * (-0.2121144 + y * (0.0742610 - y * 0.0187293)));
    return vec2(0.5 + (unit.x < 0.0 ? -azimuth : azimuth) / (2.0 * PI), (unit.y < 0.0 ? PI - polar : polar) / PI);
}

// `map`: u scale, v offset, v scale in the atlas; `side`: 0.5 for what is under the horizon.
vec4 atlas_light(vec2 uv, vec3 map, float side) {
    return textureLod(lobe_atlas, vec2(side + lobe_border + uv.x * map.x, map.y + uv.y * map.z), 0.0);
}

vec3 filtered_light(vec3 direction, vec3 map) { return atlas_light(coarse_uv(direction), map, 0.0).rgb; }

// What a lobe sees: over the horizon what is far away, around `ray`; under it the ground, where the camera sees it in direction
// `below`, `ratio` times as bright. `kept`: how much of that part the surface's own horizon leaves, compared with the other. `wide`:
// how far away that is from the surface by how far from the camera, for which a lobe is so much narrower there.
struct Lobe { vec3 ray; vec3 below; vec3 ratio; float kept; float wide; };

vec3 lobe_light(Lobe lobe, vec3 map) {
    vec4 above = atlas_light(coarse_uv(lobe.ray), map, 0.0);
    float share = above.a * lobe.kept;
    vec2 uv = coarse_uv(lobe.below);
    vec3 ground = mix(textureLod(radiance_map, uv, 0.0).rgb, atlas_light(uv, map, 0.5).rgb, lobe.wide);
    return (above.rgb + share * lobe.ratio * ground) / max(1.0 - above.a + share, 1e-3);
}

#if DETAILED
// A textured roughness may have any value: between the maps below and above it.
vec3 mixed_lobes(Lobe seen, float rough) {
    vec4 below = lobe[0], above = lobe[0];      // in rising order
    for (int i = 0; i < lobe_count; ++i) {
        if (lobe[i].x <= rough) below = lobe[i];
        above = above.x < rough ? lobe[i] : above;
    }
    float share = above.x > below.x ? clamp((rough - below.x) / (above.x - below.x), 0.0, 1.0) : 0.0;
    return mix(lobe_light(seen, below.yzw), lobe_light(seen, above.yzw), share);
}
#endif

// The mean of Smith's height-correlated visibility times GGX over a light's disc. In slopes of the half vector GGX is
// a2 / (pi (t^2 + a2)^2), whose integral over a circle of radius R at distance t from the middle is
// (1 - A / B) / 2, A = t^2 + a2 - R^2, B = sqrt(A^2 + 4 a2 R^2); a disc of radius r is such a circle with r^2 / (4 v.h n.h^3) for R^2.
float ggx_disc(float n_dot_h, float v_dot_h, float n_dot_l, float n_dot_v, float alpha, float radius) {
    float a2 = alpha * alpha, n2 = n_dot_h * n_dot_h;
    float r2 = radius * radius / (4.0 * max(v_dot_h, 0.05) * n2 * n_dot_h);
    float a = (1.0 - n2) / n2 + a2 - r2, b = sqrt(a * a + 4.0 * a2 * r2);
    float d = 2.0 * a2 / (PI * max(b * (b + a), 1e-12) * n2 * n2);
    return d * 0.5 / (n_dot_l * sqrt(n_dot_v * n_dot_v * (1.0 - a2) + a2) + n_dot_v * sqrt(n_dot_l * n_dot_l * (1.0 - a2) + a2));
}

#include "disc_cosine.glsl"

// What is far away on the ground fills less of the view than it did from the camera, in proportion to the height over the ground.
float ground_foreshortening(vec3 position) {
    return has_ground == 1 && ground_y < 0.0 ? max(position.y - ground_y, 0.0) / -ground_y : 1.0;
}

// A wide lobe does not point where a mirror would: shadowing and the horizon turn it towards the normal. Lagarde & de Rousiers 2014,
// "Moving Frostbite to physically based rendering", section 4.9.3.
vec3 dominant_direction(vec3 mirrored, vec3 normal, float roughness) {
#if HAS_RINGS
    return mirrored;    // as the papers have it
#else
    float alpha = roughness * roughness, smoothness = 1.0 - alpha;
    return normalize(mix(normal, mirrored, smoothness * (sqrt(smoothness) + alpha)));
#endif
}

struct Surface { int row; int object; vec3 normal; vec3 position; vec3 color; float metallic; vec3 emissive; float roughness; vec3 lobe; vec3 nearby; vec3 open; };

const float ROUGH = 0.6;    // from here on a lobe sees so much at once that what is near dims it as it dims diffuse light

// Of the ground, for a narrower lobe.
vec3 ground_dimming(Surface s) { return s.roughness < ROUGH ? s.nearby : vec3(1.0); }

// What a reflected lobe meets: far away and on the ground; `light` replaces a share of `hidden` of what comes from there.
struct Reflection { Lobe lobe; vec3 light; float hidden; };

#if HAS_REFLECTIONS
#include "reflections.glsl"
#endif

// The middle of what of a lobe is under the horizon: its axis where all is, a lobe's half width down where only its edge is.
vec3 lowered(vec3 ray, float alpha) {
    return normalize(vec3(ray.x, 0.5 * (ray.y - sqrt(ray.y * ray.y + 4.0 * alpha * alpha)) - 1e-3, ray.z));
}

Lobe lobe_from(vec3 position, vec3 normal, vec3 ray, float alpha, vec3 ratio) {
    if (has_ground == 0 || position.y <= ground_y) return Lobe(ray, ray, ratio, 1.0, 1.0);
    vec3 down = lowered(ray, alpha);
    float kept = clamp(dot(normal, down) / max(dot(normal, ray), 1e-3), 0.0, 1.0), away = (ground_y - position.y) / down.y;
    vec3 at = position + down * away;
    float nearness = inversesqrt(max(dot(at, at), 1e-12));
    return Lobe(ray, at * nearness, ratio, kept, min(away * nearness, 1.0));
}

#if HAS_REFLECTIONS
vec3 solid_radiance(int index, vec3 at, vec3 ray, float blur) {
    mat3 linear = mat3(unit_from_world[index]);
    vec3 normal = normalize(unit_normal(int(solid_kind[index].x), (unit_from_world[index] * vec4(at, 1.0)).xyz) * linear);
    vec3 e = filtered_light(normal, irradiance_cell);
    float flatter = ground_foreshortening(at);
    for (int i = 0; i < LIGHTS; ++i)
        e += light_irradiance[i] * (max(dot(normal, light_direction[i]), 0.0) * mix(1.0, flatter, light_below[i]));
    vec3 reflected = lobe_light(lobe_from(at, normal, reflect(ray, normal), blur, vec3(1.0)), solid_lobe[index]);
    float metallic = solid_kind[index].y;
    vec3 color = solid_color[index].rgb, f0 = mix(vec3(0.04), color, metallic);
    return color * (1.0 - metallic) * e / PI + f0 * mix(reflected, e / PI, solid_kind[index].z * smoothstep(0.05, 0.5, blur));
}

Reflection reflection(Surface s, vec3 ray) {
    bool sharp = s.roughness < ROUGH && s.metallic > 0.5;   // of others not enough is seen
    float nearest = 1e9, spread = s.roughness * s.roughness;
    Reflection found = Reflection(lobe_from(s.position, s.normal, ray, spread, sharp ? vec3(1.0) : ground_dimming(s)), vec3(0.0), 0.0);
    if (has_ground == 1 && s.position.y > ground_y) {
        float from_camera = ground_y / found.lobe.below.y;
        if (ray.y < -1e-4) nearest = (ground_y - s.position.y) / ray.y;
        if (sharp) found.lobe.ratio = ground_ratio(found.lobe.below * from_camera, 2.0 * spread * found.lobe.wide * from_camera);
    }
    int met = -1;
    float met_blur = 0.0;
    for (int i = 0; i < (sharp ? solid_count : 0); ++i) {
        vec3 towards = solid_sphere[i].xyz - s.position;
        float ahead = dot(towards, ray), reach = solid_sphere[i].w * (1.0 + 2.0 * spread) + 2.0 * spread * max(ahead, 0.0);
        bool passes = int(solid_color[i].a) == s.object || ahead < -reach || dot(towards, towards) - ahead * ahead > reach * reach;
        for (int once = passes ? 0 : 1; once > 0; --once) {     // a loop that few pixels enter
            vec3 from = (unit_from_world[i] * vec4(s.position, 1.0)).xyz, along = mat3(unit_from_world[i]) * ray;
            vec3 span = solid_span(int(solid_kind[i].x), from, along);
            float at = span.x < span.y ? span.x : max(-dot(from, along) / dot(along, along), 0.0);
            float blur = 2.0 * spread * at * length(along), soft = 1.0 - smoothstep(1.0 - blur, 1.0 + blur, span.z);
            float hidden = mix(span.x < span.y && span.y > 0.0 ? 1.0 : 0.0, at > 0.0 ? soft : 0.0, clamp(8.0 * spread, 0.0, 1.0));
            if (hidden > found.hidden && at > 0.0 && at < nearest) {
                found.hidden = hidden;
                if (hidden > 0.99) nearest = at;
                met = i;
                met_blur = spread * (1.0 + 4.0 * at * length(along));   // its own curve spreads the lobe
                found.light = s.position + ray * at;    // the place, for now
            }
        }
    }
    for (int once = met >= 0 ? 1 : 0; once > 0; --once) found.light = solid_radiance(met, found.light, ray, met_blur);
    return found;
}
#elif HAS_RINGS
// the frame is all that the papers see
Reflection reflection(Surface s, vec3 ray) { return Reflection(Lobe(ray, ray, vec3(1.0), 1.0, 1.0), vec3(0.0), 0.0); }
#else
Reflection reflection(Surface s, vec3 ray) {
    return Reflection(lobe_from(s.position, s.normal, ray, s.roughness * s.roughness, ground_dimming(s)), vec3(0.0), 0.0);
}
#endif

#if HAS_COAT
#include "coat.glsl"
#endif

vec3 shade(Surface s, vec3 view, vec3 mirror_ray, vec4 visible) {
    float n_dot_v = clamp(dot(s.normal, view), 1e-3, 1.0);
    float alpha = max(s.roughness * s.roughness, 2e-3);
    bool mirror = HAS_MIRRORS == 1 && s.roughness < mirror_below;
    vec3 f0 = mix(vec3(0.04), s.color, s.metallic);
    float rows = float(textureSize(dfg_table, 0).y);
    vec2 ab = textureLod(dfg_table, vec2(n_dot_v, (s.roughness * (rows - 1.0) + 0.5) / rows), 0.0).rg;
    float whole = ab.x + ab.y;
    vec3 compensation = 1.0 + f0 * (1.0 / max(whole, 1e-3) - 1.0);
    // what reflects nothing at the normal does not at the rim either
    vec3 reflectance = (f0 * ab.x + ab.y * clamp(50.0 * max(f0.r, max(f0.g, f0.b)), 0.0, 1.0)) * compensation;

    Reflection met = reflection(s, mirror_ray);
    vec3 mirrored = vec3(0.0);
#if HAS_RINGS
    for (int once = mirror ? 0 : 1; once > 0; --once) mirrored = ring_light(mirror_ray, s.roughness);
#elif HAS_LOBES
#if DETAILED
    mirrored = mixed_lobes(met.lobe, s.roughness);
#else
    mirrored = lobe_light(met.lobe, s.lobe);
#endif
#endif
#if HAS_MIRRORS
    bool down = mirror_ray.y < 0.0;
    mirrored *= mirror ? 0.0 : 1.0;     // mirror.frag.glsl adds the frame
    seen_in_mirror = down ? met.lobe.below : mirror_ray;
    seen_share = mirror ? reflectance * s.open * (down ? met.lobe.ratio : vec3(1.0)) * (1.0 - met.hidden) : vec3(0.0);
#endif
    vec3 dimming = s.roughness < ROUGH ? vec3(1.0) : s.nearby;
    vec3 glossy = (reflectance * s.open) * mix(mirrored * dimming, met.light, met.hidden);
    vec3 e = filtered_light(s.normal, irradiance_cell) * (s.nearby * s.open);
    float flatter = ground_foreshortening(s.position);
#if HAS_COAT
    vec4 lit = visible;
#endif
    for (int i = 0; i < LIGHTS; ++i) {
        float cosine = dot(s.normal, light_direction[i]), between = 1.0 + dot(view, light_direction[i]);
        float shorten = inversesqrt(max(2.0 * between, 1e-6));      // of light and view added up, which is the half vector
        float n_dot_l = disc_cosine(cosine, light_radius[i]), n_dot_h = clamp((cosine + n_dot_v) * shorten, 0.01, 1.0);
        float v_dot_h = min(between * shorten, 1.0), away = 1.0 - v_dot_h, away2 = away * away;
        float spread = ggx_disc(n_dot_h, v_dot_h, n_dot_l, n_dot_v, alpha, light_radius[i]);
        vec3 fresnel = f0 + (1.0 - f0) * (away2 * away2 * away);
        vec3 arriving = light_irradiance[i] * (n_dot_l * visible.x * mix(1.0, flatter, light_below[i]));
        visible = vec4(visible.yzw, 1.0);
        e += arriving;
        // what a mirror shows of the light is in the frame already
        glossy += mirror ? vec3(0.0) : arriving * fresnel * compensation * spread;
    }
    vec3 base = s.color * (1.0 - s.metallic) * (1.0 - reflectance) * e / PI + glossy + s.emissive;
#if HAS_COAT
    return coated(s, base, view, n_dot_v, lit);
#else
    return base;
#endif
}

// The surface under one sample, or under the mean of samples that agree.
Surface surface_at(vec3 normal_times_distance, float surface, ivec2 sample_pixel, vec3 direction) {
    Surface s;
    float distance_from_camera = length(normal_times_distance);
    s.normal = normal_times_distance / max(distance_from_camera, 1e-12) + vec3(0.0, 1e-12, 0.0);
    float facing = dot(s.normal, direction);
    if (facing > 0.0) s.normal -= direction * (facing + 1e-3); // an interpolated normal may look away
    s.normal = normalize(s.normal);
    s.position = direction * distance_from_camera + vec3(0.0, camera_y, 0.0);
#if DETAILED
    vec4 color = texelFetch(color_metallic, sample_pixel, 0), emissive = texelFetch(emissive_roughness, sample_pixel, 0);
#else
    vec4 color = texelFetch(surfaces, ivec2(0, int(surface)), 0), emissive = texelFetch(surfaces, ivec2(1, int(surface)), 0);
    s.lobe = texelFetch(surfaces, ivec2(2, int(surface)), 0).xyz;
#endif
    s.color = color.rgb;
    s.metallic = color.a;
    s.emissive = emissive.rgb;
    s.roughness = emissive.a;
    s.row = int(surface);
    s.object = int(texelFetch(surfaces, ivec2(2, int(surface)), 0).w);
    float open_share = 1.0 - fract(surface) / 0.9;
#if DETAILED
    s.open = vec3(open_share);
#else
    s.open = open_share / (1.0 - s.color * (1.0 - open_share));     // what is in the way gives back what it gets
#endif
    s.nearby = near_field(int(surface), s.position, s.normal);
    return s;
}

// The samples of a pixel that are shaded as one: one surface, and normals that agree with the first one's.
struct Group { vec4 sample_sum; vec4 first; int first_index; float members; float weight; };

bool joins(Group group, vec4 found) {
    return group.weight == 0.0 || (floor(found.a) == floor(group.first.a)
        && dot(found.rgb, group.first.rgb) > 0.96 * length(found.rgb) * length(group.first.rgb));
}

Group with_sample(Group group, vec4 found, int index) {
    bool is_first = group.weight == 0.0;
    return Group(group.sample_sum + found, is_first ? found : group.first, is_first ? index : group.first_index,
                 group.members + 1.0, group.weight + 0.25);
}

void main() {
    ivec2 corner = ivec2(gl_FragCoord.xy) * 2;
    // Two groups at most, for the mean of two normals is no normal of either side; a third one takes the second's colour.
    Group near = Group(vec4(0.0), vec4(0.0), 0, 0.0, 0.0), far = near;
    for (int i = 0; i < 4; ++i) {
        vec4 found = texelFetch(geometry, corner + ivec2(i & 1, i >> 1), 0);
        bool covered = found.a > 0.0, in_near = joins(near, found), in_far = joins(far, found);
        if (covered && in_near) near = with_sample(near, found, i);
        if (covered && !in_near && in_far) far = with_sample(far, found, i);
        if (covered && !in_near && !in_far) far.weight += 0.25;
    }
    vec3 direction = normalize(world_from_view * vec3(view_bounds.xy + gl_FragCoord.xy / view_size * view_bounds.zw, 1.0));
    vec4 visible = texelFetch(light_visibility, has_light_visibility * ivec2(gl_FragCoord.xy), 0);
    vec3 total = vec3(0.0);
#if HAS_MIRRORS
    mirror_ray_out = mirror_share_out = vec4(0.0);
#endif
    bool own = near.weight > 0.0 && int(near.first.a) >= surface_range.x && int(near.first.a) <= surface_range.y;
    int count = own ? (far.weight > 0.0 ? 2 : 1) : 0;     // pixels without the object cost nothing
    if (!own) discard;
    for (int i = 0; i < count; ++i) {
        Group group = i == 0 ? near : far;
        Surface s = surface_at(group.sample_sum.rgb / group.members, group.first.a,
                               corner + ivec2(group.first_index & 1, group.first_index >> 1), direction);
        vec3 mirror_ray = dominant_direction(reflect(direction, s.normal), s.normal, s.roughness);
        total += group.weight * sanitize(shade(s, -direction, mirror_ray, visible));
#if HAS_MIRRORS
        if (i == 0) mirror_ray_out = vec4(seen_in_mirror, 1.0);
        mirror_share_out.rgb += group.weight * seen_share;
#endif
    }
    radiance = vec4(total, near.weight + far.weight);
}
