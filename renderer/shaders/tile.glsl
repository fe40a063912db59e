// A tile of the frame: the vertex shader's part, and where its pixels look.
uniform int tile_pixels;
flat in ivec2 cell_fragment;    // the tile's first fragment in the atlas that is drawn
flat in ivec2 first_pixel;      // and its first pixel in the frame
flat in vec4 centre_trig;       // sine of azimuth and polar angle at the tile's centre, then both cosines

// Trigonometry without sin and cos: the vertex shader's at the tile's centre, and short series for the small rest
// (error below 1e-5 down to frames of 64 pixels, 1e-12 at 2048).
struct Trig { vec2 sine; vec2 cosine; };

Trig trig_at(vec2 pixel_in_tile) {
    vec2 d = (pixel_in_tile - 0.5 * float(tile_pixels)) * vec2(2.0, 1.0) * PI / vec2(frame_size), d2 = d * d;
    vec2 s = d * (1.0 - d2 * (1.0 / 6.0 - d2 * (1.0 / 120.0))), c = 1.0 - d2 * (0.5 - d2 * (1.0 / 24.0 - d2 * (1.0 / 720.0)));
    return Trig(centre_trig.xy * c + centre_trig.zw * s, centre_trig.zw * c - centre_trig.xy * s);
}

vec3 direction_at(vec2 azimuth_trig, vec2 polar_trig) {
    return vec3(polar_trig.x * azimuth_trig.x, polar_trig.y, -polar_trig.x * azimuth_trig.y);
}
