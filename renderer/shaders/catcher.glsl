// What of the real scene a pixel of a view shows: a surface that receives shadows, or one that only hides.
uniform sampler2D geometry;             // 2 x 2 samples a pixel: normal times distance; surface, 0 for none
uniform mat3 world_from_view;           // columns: right, up, forward
uniform vec4 view_bounds;               // left, bottom, width, height on the tangent plane
uniform vec2 view_size;
uniform int catcher_surfaces;           // the first of all surfaces; those that follow only hide

// `caught`, `hidden`: shares of the pixel.
struct Place { vec3 position; vec3 normal; float caught; float hidden; };

Place place_at(ivec2 pixel) {
    vec4 sum = vec4(0.0);
    float caught = 0.0, hidden = 0.0;
    for (int i = 0; i < 4; ++i) {
        vec4 found = texelFetch(geometry, pixel * 2 + ivec2(i & 1, i >> 1), 0);
        bool catches = found.a > 0.0 && int(found.a) <= catcher_surfaces;
        caught += catches ? 0.25 : 0.0;
        hidden += found.a > 0.0 && !catches ? 0.25 : 0.0;
        // the mean of two normals is no normal of either side
        if (catches && (sum.a == 0.0 || dot(sum.rgb, found.rgb) > 0.9 * length(sum.rgb) * length(found.rgb))) sum += vec4(found.rgb, 1.0);
    }
    vec3 direction = normalize(world_from_view * vec3(view_bounds.xy + (vec2(pixel) + 0.5) / view_size * view_bounds.zw, 1.0));
    vec3 scaled = sum.rgb / max(sum.a, 1.0);
    float away = length(scaled);
    vec3 normal = scaled / max(away, 1e-9);
    return Place(direction * away, dot(normal, direction) > 0.0 ? -normal : normal, caught, hidden);
}
