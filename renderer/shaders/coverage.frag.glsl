// Share of each pixel of a tile that the objects of a view cover; once for as long as nothing moves.
#include "equirectangular.glsl"
uniform ivec2 frame_size;
#include "tile.glsl"

uniform sampler2D silhouette;           // of the view's objects, finer than the frame and turned
uniform mat3x2 silhouette_from_tangent;
uniform mat3 view_from_world;           // rows: right, up, forward

out vec4 covered;

// By eight places of the silhouette's second level; none share a column or a row.
float coverage(vec2 azimuth_trig, vec2 polar_trig) {
    vec3 seen = view_from_world * direction_at(azimuth_trig, polar_trig);
    vec2 tangent = seen.xy / max(seen.z, 1e-6);
    vec3 east = view_from_world * vec3(polar_trig.x * azimuth_trig.y, 0.0, polar_trig.x * azimuth_trig.x);
    vec3 south = view_from_world * vec3(polar_trig.y * azimuth_trig.x, -polar_trig.x, -polar_trig.y * azimuth_trig.y);
    mat2 step = mat2(silhouette_from_tangent[0], silhouette_from_tangent[1])
        * mat2((east.xy - tangent * east.z) * 2.0 / float(frame_size.x), (south.xy - tangent * south.z) / float(frame_size.y))
        * (PI / (16.0 * seen.z));
    vec2 uv = silhouette_from_tangent * vec3(tangent, 1.0);
    float sum = textureLod(silhouette, uv + step * vec2(1.0, -3.0), 1.0).r + textureLod(silhouette, uv + step * vec2(-1.0, 3.0), 1.0).r
        + textureLod(silhouette, uv + step * vec2(5.0, 1.0), 1.0).r + textureLod(silhouette, uv + step * vec2(-3.0, -5.0), 1.0).r
        + textureLod(silhouette, uv + step * vec2(-5.0, 5.0), 1.0).r + textureLod(silhouette, uv + step * vec2(-7.0, -1.0), 1.0).r
        + textureLod(silhouette, uv + step * vec2(3.0, 7.0), 1.0).r + textureLod(silhouette, uv + step * vec2(7.0, -7.0), 1.0).r;
    return 0.125 * sum;
}

void main() {
    ivec2 in_tile = ivec2(gl_FragCoord.xy) - cell_fragment;
#if OUTPUT_YUV
    Trig near = trig_at(vec2(2 * in_tile) + 0.5), far = trig_at(vec2(2 * in_tile) + 1.5);
    vec2 left = vec2(near.sine.x, near.cosine.x), right = vec2(far.sine.x, far.cosine.x);
    vec2 upper = vec2(near.sine.y, near.cosine.y), lower = vec2(far.sine.y, far.cosine.y);
    covered = vec4(coverage(left, upper), coverage(right, upper), coverage(left, lower), coverage(right, lower));
#else
    Trig t = trig_at(vec2(in_tile) + 0.5);
    covered = vec4(coverage(vec2(t.sine.x, t.cosine.x), vec2(t.sine.y, t.cosine.y)));
#endif
}
