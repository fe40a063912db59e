// The whole frame as radiance without its lights, at full resolution: what the papers' ring sampling takes its mip levels from.
#include "panorama.glsl"

uniform sampler2D kept;             // share of each texel's radiance that is not a light's
uniform float clamp_luminance;      // the papers' way to take lights out; 0: by `kept`

out vec4 radiance;

void main() {
    vec3 found = pixel_radiance(ivec2(gl_FragCoord.xy));
    float share = clamp_luminance > 0.0 ? min(1.0, clamp_luminance / max(dot(found, LUMINANCE_WEIGHTS), 1e-6))
        : textureLod(kept, gl_FragCoord.xy / vec2(frame_size), 0.0).r;
    radiance = vec4(found * share, 1.0);
}
