// renderer/objects/near_field.py: what an object is close to, as a factor on the distant irradiance. Rows of the table of surfaces from
// NEAR_FIELD on: centre and 1 / size; then twelve coefficients for each channel, four numbers a texel; then two neighbours' spheres.
const int NEAR_FIELD = 3;
const float CONTACT = 4.0;

// Of a sphere (centre, radius) in the cosine-weighted view.
float form_factor(vec3 position, vec3 normal, vec4 sphere) {
    vec3 towards = sphere.xyz - position;
    float nearness = inversesqrt(max(dot(towards, towards), 1e-12));
    float cosine = dot(towards, normal) * nearness, sine = min(sphere.w * nearness, 1.0), rising = clamp(cosine + sine, 0.0, 2.0 * sine);
    return sine * (cosine >= sine ? sine * cosine : 0.25 * rising * rising);
}

vec3 near_field(int row, vec3 position, vec3 normal) {
    vec4 origin = texelFetch(surfaces, ivec2(NEAR_FIELD, row), 0);
    vec3 q = (position - origin.xyz) * origin.w;
    float contact = exp(-CONTACT * max(position.y - ground_y, 0.0) * origin.w) * float(has_ground);
    vec4 first = vec4(1.0, normal), second = vec4(q, contact), third = vec4(contact * normal.y, normal.y * normal.y,
        form_factor(position, normal, texelFetch(surfaces, ivec2(NEAR_FIELD + 10, row), 0)),
        form_factor(position, normal, texelFetch(surfaces, ivec2(NEAR_FIELD + 11, row), 0)));
    vec3 ratio;
    for (int channel = 0; channel < 3; ++channel) {
        int at = NEAR_FIELD + 1 + 3 * channel;
        ratio[channel] = dot(texelFetch(surfaces, ivec2(at, row), 0), first) + dot(texelFetch(surfaces, ivec2(at + 1, row), 0), second)
            + dot(texelFetch(surfaces, ivec2(at + 2, row), 0), third);
    }
    return max(ratio, vec3(0.0));
}
