// Percentage-closer soft shadows (Fernando 2005): how much of a light's disc is seen from a surface, from one depth map along its
// middle. First the mean distance of what is in the way, then a filter as wide as the disc is from there.
uniform sampler2D depth_map;
uniform sampler2D geometry;             // 2 x 2 samples a pixel: normal times distance; surface, 0 for none
uniform mat3 world_from_view;           // columns: right, up, forward
uniform float camera_y;                 // 0 but for the camera's mirror image in the ground
uniform vec4 view_bounds;               // left, bottom, width, height on the tangent plane
uniform vec2 view_size;
uniform mat4 clip_from_world;           // orthographic, along the light
uniform vec3 light_direction;
uniform vec3 extent;                    // metres that the map covers: across, up, deep
uniform float spread;                   // tangent of the light's angular radius

out vec4 visible;

const int SEARCH = FINE == 1 ? 12 : 6, FILTER = FINE == 1 ? 24 : 10;
const float GOLDEN = 2.39996323;

vec2 spiral(int index, int count) {
    float radius = sqrt((float(index) + 0.5) / float(count)), angle = float(index) * GOLDEN;
    return radius * vec2(cos(angle), sin(angle));
}

float visibility(vec3 surface, vec3 normal) {
    float facing = dot(normal, light_direction);
    float texel = max(extent.x, extent.y) / float(textureSize(depth_map, 0).x);
    // off the surface by as much as it climbs within a texel, so that it does not hide itself
    vec3 position = surface + normal * (1.5 * texel * sqrt(max(1.0 - facing * facing, 0.0)) + 0.5 * texel);
    vec3 at = (clip_from_world * vec4(position, 1.0)).xyz * 0.5 + 0.5;
    vec2 metre = 1.0 / extent.xy;
    float bias = 0.75 * texel / extent.z;

    float search = max(spread * at.z * extent.z, texel);
    float blockers = 0.0, depth = 0.0;
    vec2 beside = abs(at.xy - 0.5) - 0.5 - search * metre;
    for (int i = 0; i < (max(beside.x, beside.y) < 0.0 ? SEARCH : 0); ++i) {     // beside the map is nothing
        float found = textureLod(depth_map, at.xy + spiral(i, SEARCH) * search * metre, 0.0).r;
        if (found < at.z - bias) { blockers += 1.0; depth += found; }
    }
    if (blockers == 0.0) return 1.0;
    float width = max(spread * (at.z - depth / max(blockers, 1.0)) * extent.z, 0.75 * texel);
    float lit = 0.0;
    for (int i = 0; i < FILTER; ++i)
        lit += textureLod(depth_map, at.xy + spiral(i, FILTER) * width * metre, 0.0).r < at.z - bias ? 0.0 : 1.0;
    return lit / float(FILTER);
}

void main() {
    ivec2 corner = ivec2(gl_FragCoord.xy) * 2;
    vec4 sum = vec4(0.0);
    for (int i = 0; i < 4; ++i) {
        vec4 found = texelFetch(geometry, corner + ivec2(i & 1, i >> 1), 0);
        if (found.a > 0.0 && (sum.a == 0.0 || dot(sum.rgb, found.rgb) > 0.9 * length(sum.rgb) * length(found.rgb))) sum += vec4(found.rgb, 1.0);
    }
    vec3 scaled = sum.rgb / max(sum.a, 1.0);
    float away = length(scaled);
    vec3 normal = scaled / max(away, 1e-9);
    vec3 direction = normalize(world_from_view * vec3(view_bounds.xy + gl_FragCoord.xy / view_size * view_bounds.zw, 1.0));
    visible = vec4(1.0);
    // loops, because a software renderer leaves those that no pixel enters
    for (int once = sum.a > 0.0 && dot(normal, light_direction) > -0.1 ? 1 : 0; once > 0; --once)
        visible = vec4(visibility(vec3(0.0, camera_y, 0.0) + direction * away, normal));
}
