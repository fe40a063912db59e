// Accumulates the share of a light that is hidden.
flat in float counted;
out float occlusion;

void main() { occlusion = counted; }
