// Percentage-closer filtering (Reeves 1987) as in UE4: FILTER x FILTER comparisons, each bilinear, so that the shares of the outer
// texels follow the place. For every texel of a map of the ground.
uniform sampler2D depth_map;
uniform mat4 clip_from_world;           // orthographic, along the light
uniform ivec2 map_size;                 // texels in use
uniform float bias;
uniform vec4 ground_rect;               // x0, z0, width, depth in metres
uniform float ground_y;
uniform ivec4 cell;                     // of the atlas: first texel, size

out float occlusion;

const int FILTER = 5;

void main() {
    vec2 at_ground = ground_rect.xy + (gl_FragCoord.xy - vec2(cell.xy)) / vec2(cell.zw) * ground_rect.zw;
    vec3 at = (clip_from_world * vec4(at_ground.x, ground_y, at_ground.y, 1.0)).xyz * 0.5 + 0.5;
    vec2 place = at.xy * vec2(map_size) - 0.5, share = fract(place);
    ivec2 first = ivec2(floor(place)) - FILTER / 2, last = map_size - 1;
    float nearer = min(at.z, 1.0) - bias;   // where nothing was drawn depth is 1
    float sum = 0.0;
    for (int j = 0; j <= FILTER; ++j) {
        float row = 0.0;
        for (int i = 0; i <= FILTER; ++i) {
            float found = texelFetch(depth_map, clamp(first + ivec2(i, j), ivec2(0), last), 0).r;
            row += (found < nearer ? 1.0 : 0.0) * (i == 0 ? 1.0 - share.x : i == FILTER ? share.x : 1.0);
        }
        sum += row * (j == 0 ? 1.0 - share.y : j == FILTER ? share.y : 1.0);
    }
    occlusion = sum / float(FILTER * FILTER);
}
