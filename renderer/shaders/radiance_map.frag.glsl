// Fused inverse tone mapping and box reduction of the frame to a small radiance map.
// The mean is over linear radiance after the tone curve (the other order loses highlights), each row by its solid angle.
// Alpha is the share of the texel's solid angle that the camera has clipped.
#include "equirectangular.glsl"
#include "frame_cells.glsl"

uniform ivec2 map_size;
out vec4 texel;

#if COLUMNS
// COLUMNS x ROWS cells make a texel; the usual numbers are written out, because a software renderer keeps in memory what lives
// across a loop, even one of a single turn.
vec4 row_radiance(ivec2 first) {
#if COLUMNS == 1
    return cell_radiance(first);
#elif COLUMNS == 2
    return cell_radiance(first) + cell_radiance(first + ivec2(1, 0));
#else
    vec4 row = vec4(0.0);
    for (int x = 0; x < COLUMNS; ++x)
        row += cell_radiance(first + ivec2(x, 0));
    return row;
#endif
}

vec4 four_rows(ivec2 first, inout float weights) {
    vec4 weight = vec4(row_weight(first.y), row_weight(first.y + 1), row_weight(first.y + 2), row_weight(first.y + 3));
    weights += weight.x + weight.y + weight.z + weight.w;
    return weight.x * row_radiance(first) + weight.y * row_radiance(first + ivec2(0, 1))
        + weight.z * row_radiance(first + ivec2(0, 2)) + weight.w * row_radiance(first + ivec2(0, 3));
}

void main() {
    ivec2 first = ivec2(gl_FragCoord.xy) * ivec2(COLUMNS, ROWS);
    float weights = 0.0;
#if ROWS == 4
    vec4 sum = four_rows(first, weights);
#elif ROWS == 8
    vec4 sum = four_rows(first, weights);
    sum += four_rows(first + ivec2(0, 4), weights);
#else
    vec4 sum = vec4(0.0);
    for (int y = 0; y < ROWS; ++y) {
        float weight = row_weight(first.y + y);
        sum += weight * row_radiance(first + ivec2(0, y));
        weights += weight;
    }
#endif
    texel = sum / (weights * float(COLUMNS * CELL.x * CELL.y));
}
#else
// Texels that are no whole number of cells.
void main() {
    ivec2 cells = frame_size / CELL, index = ivec2(gl_FragCoord.xy);
    ivec2 first = index * cells / map_size, count = max((index + 1) * cells / map_size - first, ivec2(1));
    vec4 sum = vec4(0.0);
    float weights = 0.0;
    for (int y = 0; y < count.y; ++y) {
        float weight = row_weight(first.y + y);
        for (int x = 0; x < count.x; ++x)
            sum += weight * cell_radiance(first + ivec2(x, y));
        weights += weight;
    }
    texel = sum / (weights * float(count.x * CELL.x * CELL.y));
}
#endif
