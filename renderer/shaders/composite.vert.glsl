// One point a tile: a square of the output atlas, where it lies in the frame, and the shadow maps that reach it. A point, because
// two triangles would have the fragments along their diagonal shaded twice.
#include "equirectangular.glsl"

const int MAX_MAPS = 64;
const int MAX_AMBIENT = 64;

uniform ivec2 frame_size;
uniform ivec2 atlas_size;       // in fragments
uniform int tile_fragments;     // fragments a side
uniform int tile_pixels;        // pixels a side
uniform int atlas_columns;
uniform vec4 map_rect[MAX_MAPS];        // x0, z0, 1 / width, 1 / depth in metres
uniform vec4 map_cell[MAX_MAPS];        // u0, v0, size in the atlas; index of the light
uniform vec3 light_on_ground[8];        // irradiance of each light on the open ground
uniform vec4 ambient_rect[MAX_AMBIENT];
uniform vec4 ambient_cell[MAX_AMBIENT];

in ivec3 tile;                  // column, row in the frame's tile grid; slot in the atlas
in ivec4 maps_low, maps_high;   // indices of the light maps, by light; -1: none
in ivec4 ambients;
in int coverage_slot;           // in the atlas of the silhouettes' coverage

flat out ivec2 cell_fragment;   // the tile's first fragment in the atlas
flat out ivec2 first_pixel;     // and its first pixel in the frame
#if VIEW
flat out ivec2 coverage_fragment;
#endif
flat out vec4 centre_trig;      // sine of azimuth and polar angle at the tile's centre, then both cosines
#if MAPS
flat out vec4 rect[MAPS];
flat out vec3 cell[MAPS];
flat out vec4 irradiance[MAPS]; // in alpha: 1 for the last map of its light
#endif
#if AMBIENTS
flat out vec4 hidden_rect[AMBIENTS];
flat out vec3 hidden_cell[AMBIENTS];
#endif

int map_index(int i) { return i < 4 ? maps_low[i] : maps_high[i - 4]; }

void main() {
#if COVERAGE
    int place = coverage_slot;
#else
    int place = tile.z;
#endif
    ivec2 slot = ivec2(place % atlas_columns, place / atlas_columns);
#if VIEW
    coverage_fragment = ivec2(coverage_slot % atlas_columns, coverage_slot / atlas_columns) * tile_fragments;
#endif
    cell_fragment = slot * tile_fragments;
    first_pixel = tile.xy * tile_pixels;
    vec2 centre = (vec2(first_pixel) + 0.5 * float(tile_pixels)) / vec2(frame_size) * vec2(2.0, 1.0) * PI - vec2(PI, 0.0);
    centre_trig = vec4(sin(centre), cos(centre));
    gl_Position = vec4((vec2(slot) + 0.5) * float(tile_fragments) / vec2(atlas_size) * 2.0 - 1.0, 0.0, 1.0);
    gl_PointSize = float(tile_fragments);
#if MAPS
    for (int i = 0; i < MAPS; ++i) {
        int index = map_index(i), following = i + 1 < MAPS ? map_index(i + 1) : -1;
        bool used = index >= 0;
        vec4 at = map_cell[max(index, 0)];
        bool ends = following < 0 || map_cell[max(following, 0)].w != at.w;
        rect[i] = map_rect[max(index, 0)];
        cell[i] = at.xyz;
        irradiance[i] = used ? vec4(light_on_ground[int(at.w)], ends ? 1.0 : 0.0) : vec4(0.0);
    }
#endif
#if AMBIENTS
    for (int i = 0; i < AMBIENTS; ++i) {
        hidden_rect[i] = ambients[i] < 0 ? vec4(1e9, 1e9, 1.0, 1.0) : ambient_rect[ambients[i]];   // never inside
        hidden_cell[i] = ambient_cell[max(ambients[i], 0)].xyz;
    }
#endif
}
