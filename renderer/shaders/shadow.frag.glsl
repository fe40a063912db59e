// Accumulates the share of a light that is hidden.
uniform float weight;
out float occlusion;

void main() { occlusion = weight; }
