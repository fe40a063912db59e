// Objects as they are seen in a perspective view, for the pixels of a tile.
const float TOUCHED = 1.0 / 1024.0;

#if VIEW
uniform sampler2D view_texture; // premultiplied radiance of the objects in one perspective view
uniform sampler2D coverage;     // share of each pixel that they cover, tile by tile; four pixels a texel where a fragment is four
flat in ivec2 coverage_fragment;
uniform mat3 view_from_world;   // rows: right, up, forward
uniform vec4 view_bounds;       // left, bottom, 1 / width, 1 / height on the tangent plane
uniform vec2 view_scale;        // the part of the texture that the view fills
uniform vec3 view_axis;         // of the cube face

bool in_view(vec3 d, vec2 uv) { return d.z > 0.0 && all(greaterThanEqual(uv, vec2(0.0))) && all(lessThanEqual(uv, vec2(1.0))); }

// The place in the view of a direction in it.
vec2 view_uv(vec3 d) { return (d.xy / max(d.z, 1e-6) - view_bounds.xy) * view_bounds.zw; }

#endif

// Whether the cube face that the view shows is the one that owns a pixel; on an edge both do, and show the same.
bool owned(vec3 d) {
#if VIEW == CUBE_FACE
    return dot(d, view_axis) >= max(abs(d.x), max(abs(d.y), abs(d.z)));
#else
    return true;
#endif
}
