// Glossy light as Iorns & Rhee publish it (section 5): six samples on each of six rings around the mirror direction, three rings
// inside the lobe and three outside it, Phong weights, the mip level whose texels are as far apart as a ring's samples. The lobe's
// edge is where the weight is 0.5. The paper gives no exponent for a roughness: here it is that of the equally wide GGX lobe.
uniform sampler2D ring_map;         // the whole frame, with mip levels

vec3 one_ring(vec3 direction, vec3 across, vec3 up, float angle, float turn, float exponent, inout float weights) {
    float weight = angle < 0.5 * PI ? pow(max(cos(angle), 0.0), exponent) : 0.0;
    float level = log2(max(sin(angle) * float(textureSize(ring_map, 0).x) / (2.0 * PI), 1.0));
    vec3 centre = direction * cos(angle), x = across * sin(angle), y = up * sin(angle);
    float c = cos(turn), s = sin(turn), h = 0.8660254;
    vec3 a = x * c + y * s, b = y * c - x * s;      // six directions, 60 degrees apart
    vec3 sum = textureLod(ring_map, uv_from_direction(centre + a), level).rgb
        + textureLod(ring_map, uv_from_direction(centre - a), level).rgb
        + textureLod(ring_map, uv_from_direction(centre + 0.5 * a + h * b), level).rgb
        + textureLod(ring_map, uv_from_direction(centre - 0.5 * a - h * b), level).rgb
        + textureLod(ring_map, uv_from_direction(centre + 0.5 * a - h * b), level).rgb
        + textureLod(ring_map, uv_from_direction(centre - 0.5 * a + h * b), level).rgb;
    weights += 6.0 * weight;
    return weight * sum;
}

vec3 ring_light(vec3 direction, float roughness) {
    float alpha = max(roughness * roughness, 2e-3);
    float exponent = max(0.5 / (alpha * alpha) - 0.5, 1.0);
    float third = acos(pow(0.5, 1.0 / exponent)) / 3.0;
    float sign_z = direction.z >= 0.0 ? 1.0 : -1.0, a = -1.0 / (sign_z + direction.z), b = direction.x * direction.y * a;
    vec3 across = vec3(1.0 + sign_z * direction.x * direction.x * a, sign_z * b, -sign_z * direction.x);
    vec3 up = vec3(b, sign_z + direction.y * direction.y * a, -direction.y);
    float weights = 0.0;
    vec3 sum = one_ring(direction, across, up, third, 0.0, exponent, weights);
    sum += one_ring(direction, across, up, 2.0 * third, 0.5236, exponent, weights);
    sum += one_ring(direction, across, up, 3.0 * third, 0.0, exponent, weights);
    sum += one_ring(direction, across, up, 4.0 * third, 0.5236, exponent, weights);
    sum += one_ring(direction, across, up, 5.0 * third, 0.0, exponent, weights);
    sum += one_ring(direction, across, up, 6.0 * third, 0.5236, exponent, weights);
    return sum / weights;
}
