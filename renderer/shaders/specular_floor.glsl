// What a specular ground shows of objects: renderer/objects/specular_floor.py.
uniform sampler2D floor_texture;    // premultiplied radiance of the objects mirrored in the ground
uniform mat3 floor_from_world;      // rows: right, up, forward
uniform vec4 floor_bounds;          // left, bottom, 1 / width, 1 / height on the tangent plane
uniform vec2 floor_scale;           // the part of the texture that the view fills
uniform float floor_specular;       // reflectance at right angles
uniform sampler2D floor_rough_radiance;     // the frame, for a rough floor
uniform int floor_is_rough;

// `mirrored`: the objects' premultiplied radiance.
struct Floor { vec4 mirrored; float reflectance; };

Floor floor_at(vec3 direction) {
    vec3 d = floor_from_world * direction;
    vec2 uv = (d.xy / max(d.z, 1e-6) - floor_bounds.xy) * floor_bounds.zw;
    bool seen = d.z > 0.0 && direction.y < -1e-3 && all(greaterThanEqual(uv, vec2(0.0))) && all(lessThanEqual(uv, vec2(1.0)));
    float away = clamp(1.0 + direction.y, 0.0, 1.0), away2 = away * away;
    float reflectance = floor_specular + (1.0 - floor_specular) * away2 * away2 * away;
    return Floor(seen ? textureLod(floor_texture, uv * floor_scale, 0.0) : vec4(0.0), reflectance);
}

// Where the floor mirrored the frame: at the same place above the horizon. `pixel`: not a whole number in the middle of some.
vec3 floor_environment(vec3 sharp, vec2 pixel) {
    vec2 uv = pixel / vec2(frame_size);
    return floor_is_rough == 1 ? textureLod(floor_rough_radiance, vec2(uv.x, 1.0 - uv.y), 0.0).rgb : sharp;
}

// `background` with the objects in place of what the floor mirrored there, `opposite`. A floor darker than that is not as
// specular as the scene has it, and the darker the less of what it shows can be a reflection: then less is taken away.
vec3 with_floor(Floor found, vec3 background, vec3 ratio, vec3 opposite) {
    vec3 shown = found.reflectance * opposite;
    float likely = min(dot(background, LUMINANCE_WEIGHTS) / max(dot(shown, LUMINANCE_WEIGHTS), 1e-6), 1.0);
    vec3 hidden = min(shown * likely * likely, background) * found.mirrored.a;
    return source_radiance(source_linear(background - hidden) * ratio) + found.reflectance * found.mirrored.rgb;
}
