// A mirrored view as a rough floor shows it: renderer/objects/specular_floor.py.
uniform sampler2D picture;      // premultiplied radiance, with mip levels
uniform sampler2D distances;    // share that is covered; mean distance times that; with mip levels
uniform mat3 world_from_view;   // columns: right, up, forward
uniform vec4 view_bounds;       // left, bottom, width, height on the tangent plane
uniform vec2 view_size;
uniform float spread;           // standard deviation of reflected directions in radians
uniform float ground_y;

out vec4 blurred;

const int PAIRS = 8;            // of taps, opposite to each other so that the image stays in its place
const float GOLDEN = 2.39996323;
const float REDUCTION = 4.0;    // of the distances
const float SPACING = 1.2;      // between taps, in standard deviations; a texel of the level that they read
const float OWN = 0.8;          // of the width is the taps', the rest is the texels'

void main() {
    vec2 tangent = view_bounds.xy + gl_FragCoord.xy / view_size * view_bounds.zw;
    vec3 forward = normalize(world_from_view * vec3(tangent, 1.0)), up = vec3(0.0, 1.0, 0.0) * world_from_view;
    vec2 upright = normalize(up.xy - tangent * up.z + vec2(0.0, 1e-6));
    vec2 texel = 1.0 / vec2(textureSize(picture, 0)), uv = gl_FragCoord.xy * texel;
    vec2 radian = view_size / view_bounds.zw;       // in pixels
    float widest = log2(max(2.0 * spread * radian.y / REDUCTION, 1.0));
    vec2 at = gl_FragCoord.xy / (REDUCTION * vec2(textureSize(distances, 0)));
    // of what is nearby, or else of all in the view: there must be a distance wherever the image reaches
    vec2 mirrored = textureLod(distances, at, widest).rg + 1e-3 * textureLod(distances, at, 99.0).rg;
    blurred = vec4(0.0);
    for (int once = mirrored.x > 0.0 ? 1 : 0; once > 0; --once) {
        float behind = clamp(1.0 - ground_y / min(forward.y, -1e-3) * mirrored.x / mirrored.y, 0.0, 1.0);
        vec2 width = spread * behind * vec2(-min(forward.y, 0.0), 1.0);     // across the plane of incidence, and in it
        float level = log2(max(SPACING * sqrt(width.x * width.y * radian.x * radian.y), 1.0));
        for (int i = 0; i < PAIRS; ++i) {
            float radius = OWN * sqrt(-2.0 * log(1.0 - (float(i) + 0.5) / float(PAIRS))), angle = float(i) * GOLDEN;
            vec2 turned = radius * width * vec2(cos(angle), sin(angle));
            vec2 away = (turned.x * vec2(upright.y, -upright.x) + turned.y * upright) * radian * texel;
            blurred += textureLod(picture, uv + away, level) + textureLod(picture, uv - away, level);
        }
        blurred *= 0.5 / float(PAIRS);
    }
}
