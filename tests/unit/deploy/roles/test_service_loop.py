"""Who gives way, where Linux shares processors between sessions too."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from zsim_deploy.roles.stop_channel import NICE

AUTOGROUP = Path("/proc/self/autogroup")
NICEST = 19  # of what Linux knows
PROGRAM = """
import os
from pathlib import Path
from zsim_deploy.roles.stop_channel import lower_priority
lower_priority()
print(os.nice(0), Path("/proc/self/autogroup").read_text().split()[-1])
"""


@pytest.mark.skipif(not AUTOGROUP.exists(), reason="sessions are not scheduled as groups by this kernel")
@pytest.mark.parametrize("leads", [True, False])
def test_a_process_that_leads_its_session_lowers_all_of_it(leads: bool) -> None:
    """As a role of a run does; in a terminal, where the session is the shell's, the shell keeps its place."""
    start = [sys.executable, "-c", PROGRAM]
    shell = [] if leads else ["sh", "-c", '"$@"; exit $?', "sh"]
    done = subprocess.run([*shell, *start], capture_output=True, text=True, check=True, start_new_session=True)
    own = min(NICEST, os.nice(0) + NICE)
    assert done.stdout.split() == [str(own), str(NICE if leads else 0)]
