"""The command line, and launching processes here and on other hosts.

Floors from the ground: arguments, inventory, roles, launch, certificates, hosts and render, cli; each imports those
below it. cli/ has the commands, roles/ what each process of a run does, launch/ and hosts/ start and supervise them.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # matrices of a dozen rows: threads only cost; read when numpy loads

INTERRUPTED = 130  # exit code of a shell for a program that Ctrl-C ended
SAFE_PATH = "-P"  # of every interpreter that is started: else `-m` imports what lies in the working folder first
USER_FAULT = 2  # exit code for what a person has to put right: wrong arguments, a role that cannot run at all
