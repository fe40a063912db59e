// Directions and the equirectangular frame; the twin of renderer/equirectangular.py.
const float PI = 3.14159265358979;

vec2 uv_from_direction(vec3 d) {
    return vec2(0.5 + atan(d.x, -d.z) / (2.0 * PI), atan(length(d.xz), d.y) / PI);
}

vec3 direction_from_uv(vec2 uv) {
    float azimuth = (uv.x - 0.5) * 2.0 * PI;
    float polar = uv.y * PI;
    float s = sin(polar);
    return vec3(s * sin(azimuth), cos(polar), -s * cos(azimuth));
}
