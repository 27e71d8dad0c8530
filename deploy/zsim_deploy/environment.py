"""`zsim rerun --install`: a Python environment with the packages of a bundle, in which the bundle is flown again.

CACHE/environments/KEY    one for each combination of Python, zsim and packages; KEY is a hash of these

zsim itself is the version on this machine; a bundle does not contain it.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import distribution
from pathlib import Path

from zsim import __version__
from zsim.errors import RunError, file_fault
from zsim.output_folder import take_lock
from zsim_analysis.bundle import bundle_file as names
from zsim_analysis.bundle.bundle_file import EXTRAS, open_bundle, pins_of
from zsim_analysis.bundle.bundle_rerun import check_content
from zsim_deploy import SAFE_PATH
from zsim_deploy.hosts.wheelhouse import PROJECT, checkout, default_cache, requirement

KEY_DIGITS = 16  # hexadecimal digits; 64 bits of a SHA-256
READY = "ready"  # file that marks a complete environment
LEFT_OUT = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")


def rerun_in_environment(
    bundle: Path, python: Path | None, commands_only: bool, trust: bool, note: Callable[[str], None]
) -> int:
    """Fly a bundle again in its environment, which is created if missing; return the exit code of the flight.

    Args:
        python: interpreter of the environment; None: this one.
        trust: whether the bundle's own code may be run, and the packages that it needs installed.
        note: called with a line about each step.

    Raises:
        RunError: the bundle is refused, or the environment cannot be created.
    """
    with open_bundle(bundle) as (manifest, folder):
        check_content(bundle, manifest, folder)
        lock = pins_of((folder / names.LOCK).read_text("utf-8"), f"{bundle}: {names.LOCK}")
        needs = pins_of("\n".join(manifest.needs), f"{bundle}: {names.MANIFEST}: needs") if trust else []
    executable = str(python or sys.executable)
    environment = _environment(executable, lock, needs, note)
    options = [*(["--commands-only"] if commands_only else []), *(["--trust"] if trust else [])]
    command = [str(_python_of(environment)), SAFE_PATH, "-m", "zsim_deploy", "rerun", str(bundle.resolve()), *options]
    note(f"flying the bundle again in {environment}")
    return subprocess.run(command, env=_clean(), check=False).returncode


def _environment(python: str, lock: Sequence[str], needs: Sequence[str], note: Callable[[str], None]) -> Path:
    """Return the folder of an environment with zsim and a bundle's packages; create it if missing."""
    version = _output([python, "-c", "import sys; print(sys.version)"], f"{python}: is not a Python interpreter")
    name, origin = str(checkout() or ""), ""
    if not name:
        name, separator, url = requirement(distribution(PROJECT)).partition(" @ ")
        name, origin = (PROJECT, f" @ {url}") if separator else (PROJECT, name.removeprefix(PROJECT))
    requirements = [f"{name}[{','.join(EXTRAS)}]{origin}", *needs]
    key = hashlib.sha256(json.dumps([python, version, __version__, requirements, list(lock)]).encode()).hexdigest()
    folder = default_cache() / "environments" / key[:KEY_DIGITS]
    with file_fault(folder, "cannot be created", "set XDG_CACHE_HOME to a writable folder"):
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "lock").open("a") as lock_file:
            if not take_lock(lock_file):
                raise RunError(f"{folder}: another command is creating this environment; wait for it to end")
            if not (folder / READY).exists():
                note(f"creating an environment with {len(lock)} packages in {folder}")
                shutil.rmtree(folder / "venv", ignore_errors=True)
                _output([python, "-m", "venv", str(folder / "venv")], f"{folder}: no environment can be created")
                (folder / names.LOCK).write_text("".join(f"{line}\n" for line in lock), "utf-8")
                pip = [str(_python_of(folder)), "-m", "pip", "install", "--disable-pip-version-check", "--no-input"]
                fault = "the packages of the bundle cannot be installed with this Python"
                _output([*pip, "-q", "--constraint", str(folder / names.LOCK), *requirements], f"{folder}: {fault}")
                (folder / READY).touch()
    return folder


def _python_of(environment: Path) -> Path:
    return environment / "venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def _clean() -> dict[str, str]:
    """Return the environment variables without those that make one Python import the modules of another."""
    return {name: value for name, value in os.environ.items() if name not in LEFT_OUT}


def _output(command: Sequence[str], fault: str) -> str:
    """Return a program's output; if it fails, raise RunError with its first `ERROR:` line, else its last error line."""
    try:
        done = subprocess.run(command, env=_clean(), capture_output=True, text=True, errors="replace", check=False)
    except OSError as error:
        raise RunError(f"{fault} ({error.strerror})") from error
    if done.returncode:
        lines = [line.strip() for line in done.stderr.splitlines() if line.strip()] or ["it printed nothing"]
        errors = [line for line in lines if line.startswith("ERROR: ")]
        raise RunError(f"{fault} ({(errors or lines[-1:])[0].removeprefix('ERROR: ')})")
    return done.stdout
