"""GNU Octave, which runs the MATLAB client's code in tests if it is installed."""

import shutil
import subprocess
from pathlib import Path

import pytest
from wire import PATIENCE_S

ROOT = Path(__file__).parents[2]
CLIENT = ROOT / "clients" / "matlab"
EXAMPLES = ROOT / "examples" / "matlab"
OCTAVE = shutil.which("octave-cli")
needs_octave = pytest.mark.skipif(
    OCTAVE is None, reason="octave-cli is not installed; on Debian: apt-get install octave octave-sockets"
)


def command(code: str) -> list[str]:
    """Return the command that runs code with the client and its tests on the path."""
    assert OCTAVE is not None
    paths = ", ".join(f"'{path}'" for path in (CLIENT, CLIENT / "tests", EXAMPLES))
    return [OCTAVE, "--no-gui", "--no-window-system", "--norc", "-q", "--eval", f"addpath({paths}); {code}"]


def run(code: str, within_s: float = PATIENCE_S) -> str:
    """Run code and return its output; fail if it raises an error or prints a warning."""
    done = subprocess.run(command(code), cwd=ROOT, capture_output=True, text=True, timeout=within_s)
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr, done.stderr
    return done.stdout
