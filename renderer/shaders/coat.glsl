// KHR_materials_clearcoat: a dielectric layer over the base, without colour. What it reflects, by its directional albedo, does not
// reach the base; the base lets it shine through. Its strength and roughness are the surface's own, textures of them are not read.
const int COAT = 15;                    // in the table of surfaces: strength and roughness; its lobe map

vec3 coated(Surface s, vec3 base, vec3 view, float n_dot_v, vec4 visible) {
    vec2 coat = texelFetch(surfaces, ivec2(COAT, s.row), 0).xy;
    float alpha = coat.y * coat.y, rows = float(textureSize(dfg_table, 0).y);
    vec2 ab = textureLod(dfg_table, vec2(n_dot_v, (coat.y * (rows - 1.0) + 0.5) / rows), 0.0).rg;
    float albedo = coat.x * (0.04 * ab.x + ab.y);
    vec3 ray = dominant_direction(reflect(-view, s.normal), s.normal, coat.y);
    Lobe seen = lobe_from(s.position, s.normal, ray, alpha, s.nearby);
    vec3 found = lobe_light(seen, texelFetch(surfaces, ivec2(COAT + 1, s.row), 0).xyz) * s.open * albedo;
    for (int i = 0; i < LIGHTS; ++i) {
        float cosine = dot(s.normal, light_direction[i]), between = 1.0 + dot(view, light_direction[i]);
        float shorten = inversesqrt(max(2.0 * between, 1e-6));
        float n_dot_l = disc_cosine(cosine, light_radius[i]), n_dot_h = clamp((cosine + n_dot_v) * shorten, 0.01, 1.0);
        float v_dot_h = min(between * shorten, 1.0), away = 1.0 - v_dot_h, away2 = away * away;
        float fresnel = coat.x * (0.04 + 0.96 * away2 * away2 * away);
        found += light_irradiance[i] * (n_dot_l * visible.x * fresnel * ggx_disc(n_dot_h, v_dot_h, n_dot_l, n_dot_v, alpha, light_radius[i]));
        visible = vec4(visible.yzw, 1.0);
    }
    return base * (1.0 - albedo) + found;
}
