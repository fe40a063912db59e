"""What runs for every pixel of every frame on the processor, in C: see `kernels.py`."""
