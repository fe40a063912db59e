// How much of its light a real surface still has among the objects. Premultiplied by the share of the pixel that shows it; what only
// hides keeps all of its light.
#include "equirectangular.glsl"
#include "catcher.glsl"

uniform sampler2D transfer_0;
uniform sampler2D transfer_1;
uniform sampler2D transfer_2;
uniform sampler2D light_visibility;     // a channel for each of the first four lights
uniform int has_light_visibility;
uniform sampler2D ambient_map;          // irradiance by normal, of the residual
uniform vec3 ambient_sh[9];             // radiance of the residual
uniform vec3 light_direction[8];
uniform vec3 light_irradiance[8];
uniform float light_radius[8];
uniform int light_count;
uniform int solid_count;
uniform vec3 solid_centre[3];
uniform vec3 given_back[27];            // of the first three solids: coefficients of the radiance that they give back
uniform vec3 reference;                 // 0: the ratio; else what is missing is a share of this

out vec4 ratio_out;

const float MAX_RATIO = 4.0;

#include "disc_cosine.glsl"

vec3 radiance_given_back(int solid, vec3 position) {
    vec3 towards = solid_centre[solid] - position;
    vec3 d = normalize(vec3(towards.x, max(towards.y, 0.0), towards.z) + vec3(0.0, 1e-6, 0.0));   // known for the upper half
    int at = 9 * solid;
    return max(vec3(0.0), 0.2820947918 * given_back[at] + 0.4886025119 * (d.y * given_back[at + 1] + d.z * given_back[at + 2] + d.x * given_back[at + 3])
        + 1.0925484306 * (d.x * d.y * given_back[at + 4] + d.y * d.z * given_back[at + 5] + d.x * d.z * given_back[at + 7])
        + 0.3153915653 * (3.0 * d.z * d.z - 1.0) * given_back[at + 6] + 0.5462742153 * (d.x * d.x - d.y * d.y) * given_back[at + 8]);
}

vec3 missing_ambient(ivec2 pixel, vec3 position) {
    vec4 first = texelFetch(transfer_0, pixel, 0), second = texelFetch(transfer_1, pixel, 0), third = texelFetch(transfer_2, pixel, 0);
    vec3 missing = first.x * ambient_sh[0] + first.y * ambient_sh[1] + first.z * ambient_sh[2] + first.w * ambient_sh[3]
        + second.x * ambient_sh[4] + second.y * ambient_sh[5] + second.z * ambient_sh[6] + second.w * ambient_sh[7] + third.x * ambient_sh[8];
    // loops of unknown length, because a software renderer fetches what it can foresee for every pixel
    for (int i = 0; i < solid_count; ++i) missing -= third[i + 1] * radiance_given_back(i, position);
    return missing;
}

vec3 ratio_at(ivec2 pixel, Place place, vec4 visible) {
    vec3 whole = max(textureLod(ambient_map, uv_from_direction(place.normal), 0.0).rgb, vec3(0.0));
    vec3 missing = missing_ambient(pixel, place.position);
    for (int i = 0; i < light_count; ++i) {
        vec3 arriving = light_irradiance[i] * disc_cosine(dot(place.normal, light_direction[i]), light_radius[i]);
        whole += arriving;
        missing += arriving * (i < 4 ? 1.0 - visible[i] : 0.0);
    }
    if (reference.x + reference.y + reference.z > 0.0) return 1.0 - missing / max(reference, vec3(1e-6));
    return mix(clamp(1.0 - missing / max(whole, vec3(1e-6)), 0.0, MAX_RATIO), vec3(1.0), lessThan(whole, vec3(1e-6)));
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    Place place = place_at(pixel);
    vec4 visible = texelFetch(light_visibility, has_light_visibility * pixel, 0);
    bool differs = texelFetch(transfer_0, pixel, 0).x > 0.0 || min(min(visible.x, visible.y), min(visible.z, visible.w)) < 1.0;
    vec3 ratio = vec3(1.0);
    // a loop, because a software renderer leaves one that no pixel enters
    for (int once = place.caught > 0.0 && differs ? 1 : 0; once > 0; --once) ratio = ratio_at(pixel, place, visible);
    ratio_out = vec4(ratio * place.caught + place.hidden, place.caught + place.hidden);
}
