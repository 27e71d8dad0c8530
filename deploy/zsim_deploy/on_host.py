"""What `zsim push` runs on a host, with the Python that is there and nothing else; it is sent as text.

python - look FOLDER             print as JSON: Python, platform, what is installed, wheels that are there
python - install FOLDER ORDER    make FOLDER/venv what the order (JSON) says
"""

import contextlib
import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

NOTE = "zsim-installed.json"  # in the environment: what was installed; missing while something is being changed


def look(folder: Path) -> dict:
    """Return what decides which wheels fit, and which are still needed."""
    return {
        "folder": str(folder),
        "version": list(sys.version_info[:2]),
        "implementation": sys.implementation.name,
        "free_threaded": bool(sysconfig.get_config_var("Py_GIL_DISABLED")),
        "platform": sysconfig.get_platform(),
        "libc": list(platform.libc_ver()),
        "installed": _installed(folder / "venv"),
        "wheels": {path.name: _sha256(path) for path in sorted((folder / "wheels").glob("*.whl"))},
    }


def _installed(environment: Path) -> dict | None:
    """Return what an earlier push noted, if its environment still has the Python that runs this."""
    if not os.access(environment / "bin" / "python", os.X_OK):
        return None
    with contextlib.suppress(OSError, ValueError):
        note = json.loads((environment / NOTE).read_text())
        return note if note["python"] == list(sys.version_info[:2]) else None
    return None


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def install(folder: Path, order: dict) -> None:
    """Install wheels that lie in FOLDER/wheels, and nothing from anywhere else.

    Args:
        folder: of zsim on this host.
        order: project and pip (names of their wheels), wheels (names of the others that are new), extras, modules (to
            import for proof), note (to keep).
    """
    environment, wheels = folder / "venv", folder / "wheels"
    fresh = _installed(environment) is None
    (environment / NOTE).unlink(missing_ok=True)
    if fresh:
        venv.EnvBuilder(clear=True, symlinks=True).create(environment)
    python = str(environment / "bin" / "python")
    pip = [python, str(wheels / order["pip"] / "pip"), "--isolated", "--disable-pip-version-check", "-q"]
    if not fresh:
        _run([*pip, "uninstall", "-y", "zsim"])  # another build may have the same version
    project = str(wheels / order["project"]) + (f"[{','.join(order['extras'])}]" if order["extras"] else "")
    files = [str(wheels / name) for name in order["wheels"]]
    _run([*pip, "install", "--no-index", "--no-compile", "--find-links", str(wheels), project, *files])
    # What the roles import is compiled by this proof; all the rest of the packages would take longer than to install.
    _run([python, "-P", "-c", f"import {', '.join(order['modules'])}"])
    (environment / NOTE).write_text(json.dumps({**order["note"], "python": list(sys.version_info[:2])}))
    shutil.rmtree(wheels)


def _run(command: list) -> None:
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = (done.stderr.strip() or done.stdout.strip() or f"it ended with {done.returncode}").splitlines()
        errors = [line for line in lines if line.startswith("ERROR")] or lines
        sys.exit(f"{' '.join(command[-2:])[-80:]}: {errors[-1]}")


if __name__ == "__main__":
    act, where = sys.argv[1], Path(sys.argv[2]).expanduser().absolute()
    if act == "look":
        print(json.dumps(look(where)))
    else:
        install(where, json.loads(sys.argv[3]))
