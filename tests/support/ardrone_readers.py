"""Decoding of what zsim sends as an AR.Drone: by unmodified pyardrone, in its own process, and by a plain parser."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parent / "pyardrone_reads.py"


def pyardrone_reads(what: str, data: bytes) -> dict[str, Any]:
    """Return what pyardrone reads of `navdata` (numbers by option) or of `video` (numbers by field of the header)."""
    if importlib.util.find_spec("pyardrone") is None:
        pytest.skip("pyardrone is not installed")
    done = subprocess.run([sys.executable, str(SCRIPT), what], input=data, capture_output=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr.decode()
    return json.loads(done.stdout)


def configuration_entries(data: bytes) -> dict[str, str]:
    """Return the entries of a configuration sent on the control port."""
    lines = (line.partition(" = ") for line in data.removesuffix(b"\0").decode("ascii").splitlines())
    return {key: value for key, _, value in lines}
