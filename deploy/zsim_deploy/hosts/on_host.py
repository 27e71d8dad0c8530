"""The program that `zsim push` runs on a host; it is sent as text, and needs nothing there but Python.

Standard input is this text, followed by orders, one JSON line each; each is answered by a JSON line on standard output.
When standard input ends, or has been silent for a while, the push is over or its launcher is lost; the current command
is then killed.

{"act": "look"}                      report the Python, the platform, what is installed, and the wheels in FOLDER
{"act": "install", ...}              install wheels into FOLDER/venv
{"act": "warm_up", ...}              run an installed module, with the extras as its arguments

Only one instance works in a folder at a time; any other one reports whose push it is waiting for.
"""

import contextlib
import fcntl
import hashlib
import json
import os
import platform
import queue
import shutil
import signal
import subprocess
import sys
import sysconfig
import threading
import venv
from collections.abc import Iterator
from pathlib import Path

LOCK = "push.lock"  # file in the folder, locked by the instance that works there; names the user who pushes
NOTE = "zsim-installed.json"  # file in the environment with what was installed; missing during an installation


def inspect_folder(folder: Path) -> dict:
    return {
        "folder": str(folder),
        "version": list(sys.version_info[:2]),
        "implementation": sys.implementation.name,
        "free_threaded": bool(sysconfig.get_config_var("Py_GIL_DISABLED")),
        "platform": sysconfig.get_platform(),
        "libc": list(platform.libc_ver()),
        "installed": _installed(folder / "venv"),
        "wheels": {
            path.name: hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted((folder / "wheels").glob("*.whl"))
        },
    }


def _installed(environment: Path) -> dict | None:
    """Return the note of an earlier push; None if there is none, or the environment has a Python unlike this one."""
    if not os.access(environment / "bin" / "python", os.X_OK):
        return None
    with contextlib.suppress(OSError, ValueError):
        note = json.loads((environment / NOTE).read_text())
        return note if note["python"] == list(sys.version_info[:2]) else None
    return None


class CommandError(Exception):
    """A command failed; the text is its error line."""


class CommandRunner:
    """Runs one command after another, until `end` is called."""

    def __init__(self) -> None:
        self._gate = threading.Lock()
        self._child: subprocess.Popen | None = None

    def run(self, command: list) -> None:
        """Run a command to its end; raise CommandError if it fails."""
        with self._gate:
            self._child = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                start_new_session=True,
            )  # fmt: skip
        out, err = self._child.communicate()
        if code := self._child.returncode:
            lines = (err.strip() or out.strip() or f"it ended with {code}").splitlines()
            errors = [line for line in lines if line.startswith("ERROR")] or lines
            raise CommandError(f"{' '.join(command[-2:])[-80:]}: {errors[-1]}")

    def end(self) -> None:
        """Kill the running command with its children, and start no more."""
        self._gate.acquire()
        if self._child and self._child.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._child.pid, signal.SIGKILL)
            self._child.wait()


def install(folder: Path, order: dict, children: CommandRunner) -> None:
    """Install wheels, only from FOLDER/wheels.

    `order`: project and pip (names of their wheels), wheels (names of other new ones), extras, modules (to import as a
    check), and note (to store). Raise CommandError if pip or the check fails, OSError if the disk is full.
    """
    environment, wheels = folder / "venv", folder / "wheels"
    fresh = _installed(environment) is None
    (environment / NOTE).unlink(missing_ok=True)
    if fresh:
        venv.EnvBuilder(clear=True, symlinks=True).create(environment)
    python = str(environment / "bin" / "python")
    pip = [python, str(wheels / order["pip"] / "pip"), "--isolated", "--disable-pip-version-check", "-q"]
    if not fresh:
        children.run([*pip, "uninstall", "-y", "zsim"])  # another build may have the same version
    project = str(wheels / order["project"]) + (f"[{','.join(order['extras'])}]" if order["extras"] else "")
    files = [str(wheels / name) for name in order["wheels"]]
    children.run([*pip, "install", "--no-index", "--no-compile", "--find-links", str(wheels), project, *files])
    # This check also compiles the modules that the roles import; compiling whole packages would take longer.
    children.run([python, "-P", "-c", f"import {', '.join(order['modules'])}"])
    (environment / NOTE).write_text(json.dumps({**order["note"], "python": list(sys.version_info[:2])}))
    shutil.rmtree(wheels)


@contextlib.contextmanager
def locked(folder: Path, who: str) -> Iterator[str]:
    """Lock a folder; while another instance holds the lock, report whose push that is, and wait.

    Yield why the folder cannot be locked; empty if it is locked. `who`: user and machine that push.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / LOCK, "a+") as file:
        fault = ""
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            say({"waits": file.read() or "another"})
            fcntl.flock(file, fcntl.LOCK_EX)
        except OSError as error:  # a file system without locks
            fault = str(error.strerror)
        file.truncate(0)
        file.write(f"{who} (process {os.getpid()} there)")
        file.flush()
        yield fault


def say(answer: dict) -> None:
    print(json.dumps(answer), flush=True)


def execute(folder: Path, order: dict, children: CommandRunner) -> dict:
    try:
        if order["act"] == "look":
            return inspect_folder(folder)
        if order["act"] == "install":
            install(folder, order, children)
        else:
            children.run([str(folder / "venv" / "bin" / "python"), "-P", "-m", order["module"], *order["extras"]])
        return {"done": True}
    except Exception as error:
        return {"error": str(error) if isinstance(error, (CommandError, OSError)) else repr(error)}


def main(folder: Path, who: str, silent_s: float) -> None:
    """Carry out orders until standard input ends, or is silent for `silent_s` (wall time)."""
    orders, children, received = queue.SimpleQueue(), CommandRunner(), threading.Event()

    def exit_now() -> None:
        """End at once; sys.exit would wait for the thread that reads standard input."""
        children.end()
        os._exit(0)

    def follow() -> None:
        """Queue the orders, and note that lines arrive."""
        try:
            for line in sys.stdin.buffer:
                received.set()
                if line.strip():
                    orders.put(json.loads(line))
        finally:
            exit_now()

    def watch() -> None:
        while received.wait(silent_s):
            received.clear()
        exit_now()

    for each in (follow, watch):
        threading.Thread(target=each, daemon=True).start()
    with contextlib.ExitStack() as stack:
        try:
            fault = stack.enter_context(locked(folder, who))
        except OSError as error:
            say({"unwritable": f"{error.filename or folder}: {error.strerror}"})
            exit_now()
            return
        say({"locked": not fault, "unlocked": fault})
        while True:
            say(execute(folder, orders.get(), children))


if __name__ == "__main__":
    main(Path(sys.argv[1]).expanduser().absolute(), sys.argv[2], float(sys.argv[3]))
