// IEC 61966-2-1; the twin of renderer/color.py.
vec3 linear_from_srgb(vec3 s) {
    return mix(pow((s + 0.055) / 1.055, vec3(2.4)), s / 12.92, lessThanEqual(s, vec3(0.04045)));
}

vec3 srgb_from_linear(vec3 l) {
    l = clamp(l, 0.0, 1.0);
    return mix(1.055 * pow(l, vec3(1.0 / 2.4)) - 0.055, l * 12.92, lessThanEqual(l, vec3(0.0031308)));
}
