// IEC 61966-2-1; the twin of renderer/color.py. Minimax polynomials in roots of the argument in place of pow, which costs a
// software renderer three times as much: decoding within 2.8e-4 relative, encoding within 3.5e-5 absolute (0.01 of a code).
vec3 linear_from_srgb(vec3 s) {
    vec3 t = s * (1.0 / 1.055) + 0.055 / 1.055, r = sqrt(t);
    vec3 curve = t * t * (r * (r * (r * 0.10578159 - 0.34983108) + 1.19129606) + 0.05302950);
    return mix(curve, s * (1.0 / 12.92), lessThanEqual(s, vec3(0.04045)));
}

vec3 srgb_from_linear(vec3 l) {
    l = clamp(l, 0.0, 1.0);
    vec3 q = sqrt(sqrt(l));
    vec3 curve = q * (q * (q * (q * 0.08132964 - 0.33550073) + 1.12268090) + 0.19613612) - 0.06461157;
    return mix(curve, l * 12.92, lessThanEqual(l, vec3(0.0031308)));
}
