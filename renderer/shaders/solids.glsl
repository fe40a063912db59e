// Objects as one simple solid each (renderer/shapes.py), in their own unit space: edge or diameter 1, centred.
const int MAX_SOLIDS = 12;
const int BOX = 0, ELLIPSOID = 1, CYLINDER = 2;

uniform int solid_count;
uniform vec4 solid_sphere[MAX_SOLIDS];  // around each
uniform mat4 unit_from_world[MAX_SOLIDS];

// Whether a ray in unit space meets the solid.
bool solid_hides(int kind, vec3 from, vec3 ray) {
    vec3 inverse = 1.0 / (abs(ray) + 1e-9) * (step(vec3(0.0), ray) * 2.0 - 1.0);
    vec3 one = (-0.5 - from) * inverse, other = (0.5 - from) * inverse, low = min(one, other), high = max(one, other);
    vec3 mask = kind == CYLINDER ? vec3(1.0, 0.0, 1.0) : vec3(1.0);
    float a = max(dot(ray * mask, ray), 1e-12), b = dot(from * mask, ray), c = dot(from * mask, from) - 0.25;
    float root = b * b - a * c, s = sqrt(max(root, 0.0));
    vec2 round = root > 0.0 ? vec2(-b - s, -b + s) / a : vec2(1e9, -1e9);
    vec2 box = vec2(max(low.x, max(low.y, low.z)), min(high.x, min(high.y, high.z)));
    vec2 caps = vec2(max(round.x, low.y), min(round.y, high.y));
    vec2 span = kind == BOX ? box : kind == ELLIPSOID ? round : caps;
    return span.x < span.y && span.y > 0.0;
}
