// The reduction of radiance_map.frag.glsl for a GPU: a group of invocations a texel, a cell of the frame each at a time. In a fragment
// shader one invocation would walk through all cells of its texel alone.
#include "equirectangular.glsl"
#include "frame_cells.glsl"

layout(local_size_x = INVOCATIONS) in;
layout(rgba32f, binding = 0) uniform restrict writeonly image2D texels;
shared vec4 sums[INVOCATIONS];
shared float weights[INVOCATIONS];

void main() {
    int own = int(gl_LocalInvocationIndex);
    ivec2 texel = ivec2(gl_WorkGroupID.xy), first = texel * ivec2(COLUMNS, ROWS);
    vec4 sum = vec4(0.0);
    float weight_sum = 0.0;
    for (int i = own; i < COLUMNS * ROWS; i += INVOCATIONS) {
        ivec2 cell = first + ivec2(i % COLUMNS, i / COLUMNS);
        float weight = row_weight(cell.y);
        sum += weight * cell_radiance(cell);
        weight_sum += weight;
    }
    sums[own] = sum;
    weights[own] = weight_sum;
    for (int other = INVOCATIONS / 2; other > 0; other /= 2) {
        barrier();
        if (own < other) {
            sums[own] += sums[own + other];
            weights[own] += weights[own + other];
        }
    }
    if (own == 0) imageStore(texels, texel, sums[0] / (weights[0] * float(CELL.x * CELL.y)));
}
