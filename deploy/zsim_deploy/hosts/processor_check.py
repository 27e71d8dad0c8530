"""`zsim doctor SCENARIO`: check whether a flight depends on the processor, by flying it twice on this one.

The scenario is flown normally; its record is then rerun with the code of the C library, BLAS and numpy for a processor
of 2008 without fused operations. zsim's own code gives the same results with both. A difference comes from a user's
class that calls functions whose results depend on the processor: np.linalg or `@`, np.exp on arrays, math.sin.
"""

import importlib
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from zsim.errors import RunError
from zsim_deploy import SAFE_PATH

ADVICE = "see docs/extending.md, The same bits on every processor"


def older_processor() -> dict[str, str]:
    """Return the environment variables that make libraries compute as on an older processor of this architecture."""
    numpy_core = importlib.import_module("numpy._core._multiarray_umath")  # lists the CPU features it dispatches on
    settings = {"NPY_DISABLE_CPU_FEATURES": " ".join(getattr(numpy_core, "__cpu_dispatch__", ()))}
    if platform.machine() in ("x86_64", "AMD64"):
        settings["OPENBLAS_CORETYPE"] = "Nehalem"  # SSE4.2 at most
        settings["GLIBC_TUNABLES"] = "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F,-AVX2_Usable,-FMA_Usable"  # glibc of any age
    else:
        settings["OPENBLAS_CORETYPE"] = "ARMV8"
    return {name: value for name, value in settings.items() if value}


def check_processor(scenario: Path, duration_s: float, say: Callable[[str], None]) -> str:
    """Fly the first seconds of a scenario twice; return where the flights first differ, empty if they do not.

    Raises:
        RunError: it cannot be flown in one process.
    """
    with tempfile.TemporaryDirectory(prefix="zsim-doctor-") as folder:
        out = str(Path(folder, "run"))
        flight = ("run", str(scenario), "--in-process", "--no-report", "--out", out, "--duration", f"{duration_s:g}")
        _finished(flight, {}, (0,))
        say(f"{scenario.name}: {duration_s:g} s flown on this processor")
        code, text = _finished(("rerun", out, "--trust"), older_processor(), (0, 1))  # the same code has just flown
    if code:
        named = [line for line in text.splitlines() if "differs" in line]
        found = "; ".join(dict.fromkeys(named)) or (text.strip() or "it printed nothing").splitlines()[-1]
        return f"{scenario}: on another processor, {found}; {ADVICE}"
    say("flown again as on an older processor: the same to the bit")
    return ""


def _finished(words: tuple[str, ...], settings: dict[str, str], allowed: tuple[int, ...]) -> tuple[int, str]:
    command = [sys.executable, SAFE_PATH, "-m", "zsim_deploy", *words]
    done = subprocess.run(command, env={**os.environ, **settings}, capture_output=True, text=True, errors="replace")
    if done.returncode not in allowed:
        last = (done.stderr or done.stdout).strip().splitlines() or ["it printed nothing"]
        raise RunError(f"zsim {words[0]} ended with exit code {done.returncode}: {last[-1]}")
    return done.returncode, done.stdout or done.stderr
