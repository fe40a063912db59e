// renderer/near_field.py: what an object is close to, as a factor on the distant irradiance. Rows of the table of surfaces from
// NEAR_FIELD on: centre and 1 / size; then ten coefficients for each channel, four numbers a texel.
const int NEAR_FIELD = 3;
const float CONTACT = 4.0;

vec3 near_field(int row, vec3 position, vec3 normal) {
    vec4 origin = texelFetch(surfaces, ivec2(NEAR_FIELD, row), 0);
    vec3 q = (position - origin.xyz) * origin.w;
    float contact = exp(-CONTACT * max(position.y - ground_y, 0.0) * origin.w) * float(has_ground);
    vec4 first = vec4(1.0, normal), second = vec4(q, contact);
    vec2 third = vec2(contact * normal.y, normal.y * normal.y);
    vec3 ratio;
    for (int channel = 0; channel < 3; ++channel) {
        int at = NEAR_FIELD + 1 + 3 * channel;
        ratio[channel] = dot(texelFetch(surfaces, ivec2(at, row), 0), first) + dot(texelFetch(surfaces, ivec2(at + 1, row), 0), second)
            + dot(texelFetch(surfaces, ivec2(at + 2, row), 0).xy, third);
    }
    return max(ratio, vec3(0.0));
}
