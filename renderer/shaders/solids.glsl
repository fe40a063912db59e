// Objects as one simple solid each (renderer/models/shapes.py), in their own unit space: edge or diameter 1, centred.
const int MAX_SOLIDS = 12;
const int BOX = 0, ELLIPSOID = 1, CYLINDER = 2;

uniform int solid_count;
uniform vec4 solid_sphere[MAX_SOLIDS];  // around each
uniform mat4 unit_from_world[MAX_SOLIDS];

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

// Whether a ray in unit space meets it.
bool solid_hides(int kind, vec3 from, vec3 ray) {
    vec3 span = solid_span(kind, from, ray);
    return span.x < span.y && span.y > 0.0;
}
