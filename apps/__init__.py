"""The commands. They know every stage; no stage knows a command."""

import os

# Before anything imports torch: OpenMP threads that spin while they wait made two threads 4-15×
# slower on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
# numpy's own BLAS spins, too: a second thread doubled the cost of a frame's warp, for nothing.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
