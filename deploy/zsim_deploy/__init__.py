"""The command line, and launching processes here and on other hosts."""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # matrices of a dozen rows: threads only cost; read when numpy loads
