"""The service, its worker processes, the demo and the command line."""

import os

# Before numpy is loaded: our matrices are too small for a second thread, which would only spin against the rasteriser's.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
