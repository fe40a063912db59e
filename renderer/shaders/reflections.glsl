// What a reflected ray meets before it leaves the scene: the ground, with its shadows, and other objects as simple solids.
const int MAX_SOLIDS = 12;
const int BOX = 0, ELLIPSOID = 1, CYLINDER = 2;

uniform sampler2D ground_missing;       // share of the ground's irradiance that is missing
uniform vec4 ground_missing_rect;       // x0, z0, 1 / width, 1 / depth in metres
uniform int solid_count;
uniform vec4 solid_sphere[MAX_SOLIDS];  // around each
uniform mat4 unit_from_world[MAX_SOLIDS];
uniform vec4 solid_color[MAX_SOLIDS];   // colour; object
uniform vec3 solid_kind[MAX_SOLIDS];    // kind, metallic, 1 for a mirror
uniform vec3 solid_lobe[MAX_SOLIDS];    // its map in the atlas, unless it is a mirror

vec3 ground_ratio(vec3 at, float footprint) {
    vec2 uv = (at.xz - ground_missing_rect.xy) * ground_missing_rect.zw;
    bool known = all(greaterThan(uv, vec2(0.0))) && all(lessThan(uv, vec2(1.0)));
    float texels = footprint * max(ground_missing_rect.z, ground_missing_rect.w) * float(textureSize(ground_missing, 0).x);
    vec3 missing = textureLod(ground_missing, uv, log2(max(texels, 1.0))).rgb;
    return known ? clamp(1.0 - missing, 0.0, 4.0) : vec3(1.0);
}

// Where a ray in unit space enters a solid (x) and leaves it (y), and how near it passes in half sizes (z).
vec3 solid_span(int kind, vec3 from, vec3 ray) {
    vec3 inverse = 1.0 / (abs(ray) + 1e-9) * (step(vec3(0.0), ray) * 2.0 - 1.0);
    vec3 low = min((-0.5 - from) * inverse, (0.5 - from) * inverse), high = max((-0.5 - from) * inverse, (0.5 - from) * inverse);
    vec3 mask = kind == CYLINDER ? vec3(1.0, 0.0, 1.0) : vec3(1.0);
    float a = max(dot(ray * mask, ray), 1e-12), b = dot(from * mask, ray), c = dot(from * mask, from) - 0.25;
    float root = b * b - a * c, s = sqrt(max(root, 0.0));
    vec2 round = root > 0.0 ? vec2((-b - s) / a, (-b + s) / a) : vec2(1e9, -1e9);
    vec2 box = vec2(max(low.x, max(low.y, low.z)), min(high.x, min(high.y, high.z)));
    vec2 caps = vec2(max(round.x, low.y), min(round.y, high.y));
    vec2 span = kind == BOX ? box : kind == ELLIPSOID ? round : caps;
    vec3 closest = from + ray * max(-dot(from, ray) / dot(ray, ray), 0.0);
    return vec3(span, 2.0 * length(closest));
}

vec3 unit_normal(int kind, vec3 at) {
    vec3 away = abs(at);
    if (kind == BOX) return away.x > max(away.y, away.z) ? vec3(sign(at.x), 0.0, 0.0)
        : away.y > away.z ? vec3(0.0, sign(at.y), 0.0) : vec3(0.0, 0.0, sign(at.z));
    if (kind == CYLINDER) return away.y > 0.4999 ? vec3(0.0, sign(at.y), 0.0) : vec3(at.x, 0.0, at.z);
    return at;
}
