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

// Depth at a texel's middle of the plane that touches the surface: found there is the surface itself if it is no nearer to the light
// (Isidoro 2006, "Shadow mapping: GPU-based tips and techniques"). Moving the surface off itself instead would move the shadow's edge.
float plane_depth(vec3 at, vec2 slope, vec2 uv) {
    vec2 texels = vec2(textureSize(depth_map, 0));
    return at.z + dot(slope, ((floor(uv * texels) + 0.5) / texels - at.xy) * extent.xy) / extent.z;
}

float visibility(vec3 surface, vec3 normal) {
    float facing = dot(normal, light_direction);
    float texel = max(extent.x, extent.y) / float(textureSize(depth_map, 0).x);
    vec3 at = (clip_from_world * vec4(surface + normal * (0.25 * texel), 1.0)).xyz * 0.5 + 0.5;
    vec2 metre = 1.0 / extent.xy;
    float bias = 0.75 * texel / extent.z;
    vec2 across = 0.5 * extent.xy * (mat3(clip_from_world) * normal).xy;    // of the normal, in the light's axes
    vec2 slope = across / max(facing, 0.02);

    float search = max(spread * at.z * extent.z, texel);
    float blockers = 0.0, depth = 0.0;
    vec2 beside = abs(at.xy - 0.5) - 0.5 - search * metre;
    for (int i = 0; i < (max(beside.x, beside.y) < 0.0 ? SEARCH : 0); ++i) {     // beside the map is nothing
        vec2 uv = at.xy + spiral(i, SEARCH) * search * metre;
        float found = textureLod(depth_map, uv, 0.0).r;
        if (found < plane_depth(at, slope, uv) - bias) { blockers += 1.0; depth += found; }
    }
    if (blockers == 0.0) return 1.0;
    float width = max(spread * (at.z - depth / max(blockers, 1.0)) * extent.z, 0.75 * texel);
    float lit = 0.0;
    for (int i = 0; i < FILTER; ++i) {
        vec2 uv = at.xy + spiral(i, FILTER) * width * metre;
        lit += textureLod(depth_map, uv, 0.0).r < plane_depth(at, slope, uv) - bias ? 0.0 : 1.0;
    }
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
