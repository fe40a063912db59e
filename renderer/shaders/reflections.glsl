// What a reflected ray meets before it leaves the scene: the ground, with its shadows, and other objects as simple solids.
#include "solids.glsl"

uniform sampler2D ground_missing;       // share of the ground's irradiance that is missing
uniform vec4 ground_missing_rect;       // x0, z0, 1 / width, 1 / depth in metres
uniform vec4 solid_color[MAX_SOLIDS];   // colour; object
uniform vec3 solid_kind[MAX_SOLIDS];    // kind, metallic, 1 for a mirror
uniform vec3 solid_lobe[MAX_SOLIDS];    // its map in the atlas; a mirror's is the sharpest that there is

vec3 ground_ratio(vec3 at, float footprint) {
    vec2 uv = (at.xz - ground_missing_rect.xy) * ground_missing_rect.zw;
    bool known = all(greaterThan(uv, vec2(0.0))) && all(lessThan(uv, vec2(1.0)));
    float texels = footprint * max(ground_missing_rect.z, ground_missing_rect.w) * float(textureSize(ground_missing, 0).x);
    vec3 missing = textureLod(ground_missing, uv, log2(max(texels, 1.0))).rgb;
    return known ? clamp(1.0 - missing, 0.0, 4.0) : vec3(1.0);
}

vec3 unit_normal(int kind, vec3 at) {
    vec3 away = abs(at);
    if (kind == BOX) return away.x > max(away.y, away.z) ? vec3(sign(at.x), 0.0, 0.0)
        : away.y > away.z ? vec3(0.0, sign(at.y), 0.0) : vec3(0.0, 0.0, sign(at.z));
    if (kind == CYLINDER) return away.y > 0.4999 ? vec3(0.0, sign(at.y), 0.0) : vec3(at.x, 0.0, at.z);
    return at;
}
