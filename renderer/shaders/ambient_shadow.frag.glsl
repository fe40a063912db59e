// Accumulates what an occluder takes from the ground, as a transfer vector: the hidden directions' spherical harmonics of
// bands 0 to 2, cosine-weighted. Its product with the residual's coefficients is the irradiance that is missing (Sloan 2002).
flat in float counted;
flat in vec3 direction;

layout(location = 0) out vec4 transfer_0;
layout(location = 1) out vec4 transfer_1;
layout(location = 2) out vec4 transfer_2;

void main() {
    float x = direction.x, y = direction.y, z = direction.z;
    transfer_0 = counted * vec4(0.2820947918, 0.4886025119 * y, 0.4886025119 * z, 0.4886025119 * x);
    transfer_1 = counted * vec4(1.0925484306 * x * y, 1.0925484306 * y * z, 0.3153915653 * (3.0 * z * z - 1.0), 1.0925484306 * x * z);
    transfer_2 = counted * vec4(0.5462742153 * (x * x - y * y), 0.0, 0.0, 0.0);
}
