"""`zsim doctor SCENARIO`: whether a flight depends on the processor, by flying it twice on this one.

It is flown as this machine computes, and its record is flown again by the C library's, BLAS's and numpy's code for a
processor of 2008 without fused operations. zsim's own code computes the same with both. What differs is a class of the
user's own that calls what is free to differ: np.linalg or `@`, np.exp on arrays, math.sin.
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
    """Return the variables by which libraries compute as for an older processor of this machine's kind."""
    numpy_core = importlib.import_module("numpy._core._multiarray_umath")  # names what numpy has code for
    settings = {"NPY_DISABLE_CPU_FEATURES": " ".join(getattr(numpy_core, "__cpu_dispatch__", ()))}
    if platform.machine() in ("x86_64", "AMD64"):
        settings["OPENBLAS_CORETYPE"] = "Nehalem"  # SSE4.2 at most
        settings["GLIBC_TUNABLES"] = "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F,-AVX2_Usable,-FMA_Usable"  # glibc of any age
    else:
        settings["OPENBLAS_CORETYPE"] = "ARMV8"
    return {name: value for name, value in settings.items() if value}


def check_processor(scenario: Path, duration_s: float, say: Callable[[str], None]) -> str:
    """Fly the first seconds of a scenario twice; return how the flights differ first, empty if they do not.

    Raises:
        RunError: it cannot be flown in one process.
    """
    with tempfile.TemporaryDirectory(prefix="zsim-doctor-") as folder:
        out = str(Path(folder, "run"))
        flight = ("run", str(scenario), "--in-process", "--no-report", "--out", out, "--duration", f"{duration_s:g}")
        _finished(flight, {}, (0,))
        say(f"{scenario.name}: {duration_s:g} s flown as this processor computes")
        code, text = _finished(("rerun", out, "--trust"), older_processor(), (0, 1))  # whose code has just flown
    if code:
        named = [line for line in text.splitlines() if "differs" in line]
        found = "; ".join(dict.fromkeys(named)) or (text.strip() or "it printed nothing").splitlines()[-1]
        return f"{scenario}: on another processor, {found}; {ADVICE}"
    say("flown again as an older processor computes: the same to the bit")
    return ""


def _finished(words: tuple[str, ...], settings: dict[str, str], allowed: tuple[int, ...]) -> tuple[int, str]:
    command = [sys.executable, SAFE_PATH, "-m", "zsim_deploy", *words]
    done = subprocess.run(command, env={**os.environ, **settings}, capture_output=True, text=True, errors="replace")
    if done.returncode not in allowed:
        last = (done.stderr or done.stdout).strip().splitlines() or ["it printed nothing"]
        raise RunError(f"zsim {words[0]} ended with exit code {done.returncode}: {last[-1]}")
    return done.returncode, done.stdout or done.stderr
