// One instance a tile: a square of the output atlas, and where it lies in the frame.
uniform ivec2 atlas_size;       // in fragments
uniform int tile_fragments;     // fragments a side
uniform int tile_pixels;        // pixels a side
uniform int atlas_columns;

in ivec3 tile;                  // column, row in the frame's tile grid; slot in the atlas
flat out ivec2 pixel_offset;    // pixel = fragment * (tile_pixels / tile_fragments) + offset

void main() {
    ivec2 corner = ivec2(gl_VertexID & 1, gl_VertexID >> 1);
    ivec2 cell = ivec2(tile.z % atlas_columns, tile.z / atlas_columns);
    pixel_offset = (tile.xy - cell) * tile_pixels;
    vec2 position = vec2((cell + corner) * tile_fragments) / vec2(atlas_size);
    gl_Position = vec4(position * 2.0 - 1.0, 0.0, 1.0);
}
