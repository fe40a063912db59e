// 1 where an object is.
#if DETAILED
#include "material.glsl"
#endif

out float covered;

void main() {
#if DETAILED
    if (is_hole(material_color(0.0).a)) discard;
#endif
    covered = 1.0;
}
