"""The command line, and the launchers that start processes on this host and on others.

Layers, lowest first: arguments, inventory, roles, launch, certificates, hosts and render, cli; each imports only lower
ones. cli/ contains the commands, roles/ the processes of a run; launch/ and hosts/ start and supervise the processes.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # threads slow down matrices of a dozen rows; numpy reads the variables on import

INTERRUPTED = 130  # exit code of shells for a program ended by Ctrl-C
SAFE_PATH = "-P"  # option of every interpreter that zsim starts; without it, `-m` imports from the working folder first
USER_FAULT = 2  # exit code for faults that the user must correct, such as wrong arguments or a role that cannot run
