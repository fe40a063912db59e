// renderer/light/irradiance.py: a disc that sets behind the surface's own horizon fades.
float disc_cosine(float cosine, float radius) {
    float s = max(sin(radius), 1e-6), rising = cosine + s;
    return cosine >= s ? cosine : (rising <= 0.0 ? 0.0 : rising * rising / (4.0 * s));
}
