// How far away what a mirrored view shows is, coarsely: for the blur of a rough floor.
uniform sampler2D geometry;     // 2 x 2 samples a pixel: normal times distance; surface, 0 for none
uniform vec2 view_size;

out vec2 found;                 // share that is covered; mean distance times that

const int REDUCTION = 4;        // view pixels a side of a texel

void main() {
    ivec2 first = ivec2(gl_FragCoord.xy) * (2 * REDUCTION);
    vec2 sum = vec2(0.0);
    for (int j = 0; j < REDUCTION; ++j)
        for (int i = 0; i < REDUCTION; ++i) {
            ivec2 at = first + 2 * ivec2(i, j);
            vec4 surface = texelFetch(geometry, at, 0);
            bool covered = surface.a > 0.0 && all(lessThan(vec2(at), 2.0 * view_size));
            sum += covered ? vec2(1.0, length(surface.rgb)) : vec2(0.0);
        }
    found = sum / float(REDUCTION * REDUCTION);
}
