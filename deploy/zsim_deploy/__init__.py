"""The command line, and launching processes here and on other hosts.

Layers from the lowest: arguments, inventory, roles, launch, certificates, hosts and render, cli; each imports lower
ones. cli/ has the commands, roles/ the processes of a run; launch/ and hosts/ start and supervise them.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # threads slow matrices of a dozen rows down; read when numpy loads

INTERRUPTED = 130  # exit code of shells for a program ended by Ctrl-C
SAFE_PATH = "-P"  # option of every interpreter that is started: otherwise `-m` imports from the working folder first
USER_FAULT = 2  # exit code for faults that the user must correct: wrong arguments, a role that cannot run at all
