// What the objects take from a real surface, as in ambient_shadow.frag.glsl: the hidden directions' spherical harmonics of bands 0
// to 2, cosine-weighted. Objects are solids, each looked for in the cone of directions around it.
#include "solids.glsl"
#include "catcher.glsl"

const float PI = 3.14159265358979, GOLDEN = 2.39996323;
const int SAMPLES = 40;
uniform float solid_kind[MAX_SOLIDS];
uniform float reach;                    // in radii of a solid's sphere, from its middle; and where what it takes begins to fade

layout(location = 0) out vec4 transfer_0;
layout(location = 1) out vec4 transfer_1;
layout(location = 2) out vec4 transfer_2;   // the last one, then what each of the first three solids takes alone

mat3 basis_along(vec3 axis) {       // Duff et al. 2017
    float s = axis.z >= 0.0 ? 1.0 : -1.0, a = -1.0 / (s + axis.z), b = axis.x * axis.y * a;
    return mat3(vec3(1.0 + s * axis.x * axis.x * a, s * b, -s * axis.x), vec3(b, s + axis.y * axis.y * a, -axis.y), axis);
}

void main() {
    Place place = place_at(ivec2(gl_FragCoord.xy));
    vec4 first = vec4(0.0), second = vec4(0.0);
    float last = 0.0, all = 0.0;
    vec3 alone = vec3(0.0);
    for (int i = 0; i < (place.caught > 0.0 ? solid_count : 0); ++i) {
        vec3 towards = solid_sphere[i].xyz - place.position;
        float away = length(towards), radius = solid_sphere[i].w, taken = 0.0;
        bool inside = away < 1.05 * radius;
        float cosine = inside ? 0.0 : sqrt(1.0 - radius * radius / (away * away));      // of the cone's half-angle
        mat3 axes = basis_along(inside ? place.normal : towards / away);
        float fade = 1.0 - smoothstep(0.6 * reach, reach, away / radius);
        vec3 from = (unit_from_world[i] * vec4(place.position + place.normal * (1e-3 * radius), 1.0)).xyz;
        bool matters = fade > 0.0 && dot(towards, place.normal) > -radius;
        for (int k = 0; k < (matters ? SAMPLES : 0); ++k) {
            float share = (float(k) + 0.5) / float(SAMPLES), angle = float(k) * GOLDEN;
            float climb = inside ? sqrt(1.0 - share) : 1.0 - share * (1.0 - cosine);    // by cosine, or evenly over the cone
            vec3 d = axes * vec3(sqrt(max(1.0 - climb * climb, 0.0)) * vec2(cos(angle), sin(angle)), climb);
            float weight = inside ? PI : 2.0 * PI * (1.0 - cosine) * max(dot(d, place.normal), 0.0);
            if (!solid_hides(int(solid_kind[i]), from, mat3(unit_from_world[i]) * d)) weight = 0.0;
            weight *= fade / float(SAMPLES);
            taken += weight;
            first += weight * vec4(0.2820947918, 0.4886025119 * d.y, 0.4886025119 * d.z, 0.4886025119 * d.x);
            second += weight * vec4(1.0925484306 * d.x * d.y, 1.0925484306 * d.y * d.z, 0.3153915653 * (3.0 * d.z * d.z - 1.0), 1.0925484306 * d.x * d.z);
            last += weight * 0.5462742153 * (d.x * d.x - d.y * d.y);
        }
        alone += taken * vec3(i == 0, i == 1, i == 2);
        all += taken;
    }
    float overlap = min(1.0, PI / max(all, 1e-6));      // solids that hide each other are not taken twice from everything
    transfer_0 = first * overlap;
    transfer_1 = second * overlap;
    transfer_2 = vec4(last, alone) * overlap;
}
