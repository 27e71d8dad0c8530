"""The one decorator of all compiled functions: no fast-math, so that the same input gives the same bits.

Division by zero gives inf as in numpy: a diverged state is found at the end of a gate, not by an exception inside.
Only the kernel of gate.py is cached on disk; what it calls is compiled into it.
"""

from numba import njit

compiled = njit(error_model="numpy", fastmath=False)
