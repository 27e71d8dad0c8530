"""Wheels for a host from a package index: which Python and platform they must fit, and pip run to download them.

pip runs on the launcher's machine, as the user has configured it there.
"""

import asyncio
import os
import re
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from zsim.errors import HostsError

RETRIES = "1"  # of pip, for each page of an index; with its own 5 it takes minutes where there is no network
LINE_BYTES = 1 << 20  # of the longest line that pip prints
NO_INDEX = re.compile(r"connection broken by '\w+\((.*)\)': ")  # pip, before it tries again, with the reason

Progress = Callable[[str], None]
OLDEST = (3, 11)  # pyproject.toml, requires-python
NEWEST_MINOR = 14  # the last Python whose name is tried
PLAIN = "python3"
ANSWER = re.compile(r"(python3(?:\.\d+)?) (\d+)\.(\d+)\.(\d+) (/.*)")  # command, version, path
MANYLINUX_OLDEST = 5  # glibc 2.5; PEP 600
LEGACY = {
    17: "manylinux2014",
    12: "manylinux2010",
    5: "manylinux1",
}  # glibc 2.x that the older names stand for; PEP 600


class Interpreter(NamedTuple):
    """A Python that was found on a host."""

    command: str
    version: tuple[int, int, int]
    path: str


class WheelTarget(NamedTuple):
    """What wheels must fit."""

    version: tuple[int, int]
    abi: str
    """Such as cp311; PEP 425."""
    platforms: tuple[str, ...]
    """Platform tags that run there, the best first."""

    def options(self) -> list[str]:
        """Return the options by which pip takes wheels for this target."""
        platforms = [word for name in self.platforms for word in ("--platform", name)]
        version = ".".join(map(str, self.version))
        return ["--implementation", "cp", "--python-version", version, "--abi", self.abi, *platforms]

    def __str__(self) -> str:
        return f"Python {'.'.join(map(str, self.version))} on {self.platforms[0]}"


class PipError(Exception):
    """pip failed; with its error line."""


class UnreachableError(PipError):
    """The package index does not answer."""


def _no_progress(_text: str) -> None:
    """Show no progress."""


async def download_wheels(
    wanted: Sequence[str], target: WheelTarget, into: Path, held: Sequence[str], progress: Progress = _no_progress
) -> bool:
    """Download wheels for a target; where a project has only sources, build them here.

    The versions are those of this machine where there are such wheels for the target, because equal versions are a
    condition for equal bits.

    Args:
        wanted: requirements, as for pip.
        into: folder, for the wheels only.
        held: constraints, as for pip.
        progress: called with what is being done.

    Returns:
        Whether the versions had to differ from the held ones.

    Raises:
        PipError: there are no wheels for the target.
        UnreachableError: nobody knows whether there are.
    """
    fit = ("download", "--only-binary=:all:", *target.options(), "--dest", str(into))
    with tempfile.TemporaryDirectory() as aside:
        limits = Path(aside, "constraints.txt")
        limits.write_text("\n".join(held))
        try:
            await _fetch(fit, (*wanted, "--constraint", str(limits)), f"{aside}/same", progress)
            return False
        except UnreachableError:
            raise
        except PipError:
            progress("looking for other versions than those here")
            await _fetch(fit, wanted, f"{aside}/other", progress)
            return True


async def _fetch(fit: Sequence[str], wanted: Sequence[str], built: str, progress: Progress) -> None:
    """Download wheels; if that fails, build what has only sources into a folder, and take it from there."""
    try:
        await pip(*fit, *wanted, progress=progress)
    except UnreachableError:
        raise
    except PipError:
        progress("building here what has only sources")
        await pip("wheel", "--wheel-dir", built, *wanted, progress=progress)
        await pip(*fit, "--find-links", built, *wanted, progress=progress)


async def pip(*arguments: str, progress: Progress = _no_progress) -> None:
    """Run pip of this Python, as the user has configured it but for how often it tries again.

    Args:
        progress: takes a line when an index does not answer.

    Raises:
        PipError: with its last word.
        UnreachableError: with the reason why an index did not answer.
    """
    options = ("--disable-pip-version-check", "--no-input", "-q")
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "pip", *arguments, *options, stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT, limit=LINE_BYTES,
        env={**os.environ, "PIP_RETRIES": RETRIES},
    )  # fmt: skip
    assert process.stdout is not None
    lines: list[str] = []
    unanswered = ""
    try:
        async for line in process.stdout:
            lines.append(line.decode(errors="replace").strip())
            if (match := NO_INDEX.search(lines[-1])) and not unanswered:
                unanswered = _reason(match[1])
                progress(f"the package index does not answer ({unanswered}); asking once more")
        await process.wait()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode and unanswered:
        raise UnreachableError(unanswered)
    if process.returncode:
        lines = [line for line in lines if line] or ["it printed nothing"]
        raise PipError(next((line for line in lines if line.startswith("ERROR: ")), lines[-1]).removeprefix("ERROR: "))


def _reason(error: str) -> str:
    """Return what the arguments of an error that pip shows say, without what surrounds it."""
    last = re.split(r"[:,] ", error)[-1].strip("\"')")
    return re.sub(r"\[Errno -?\d+\] ", "", last) + (")" if "(" in last else "")


def interpreter_query() -> str:
    """Return a line of POSIX shell that prints command, version and path of every Python of a host."""
    names = [PLAIN, *(f"python3.{minor}" for minor in range(NEWEST_MINOR, OLDEST[1] - 1, -1))]
    say = 'import sys; print("%d.%d.%d" % sys.version_info[:3], sys.executable)'
    return f"for p in {' '.join(names)}; do found=$($p -c '{say}' 2>/dev/null) && echo $p $found; done; true"


def parse_interpreters(answer: str) -> list[Interpreter]:
    """Return what `question` printed; a greeting of the login shell is passed over."""
    matches = filter(None, map(ANSWER.fullmatch, answer.splitlines()))
    return [Interpreter(each[1], (int(each[2]), int(each[3]), int(each[4])), each[5]) for each in matches]


def choose_interpreter(name: str, interpreters: Sequence[Interpreter], here: tuple[int, int]) -> Interpreter:
    """Return the Python to install for: the launcher's minor version if it is there, else `python3`, else the newest.

    Raises:
        HostsError: none is new enough.
    """
    fit = [each for each in interpreters if each.version[:2] >= OLDEST]
    if fit:
        return max(fit, key=lambda each: (each.version[:2] == here, each.command == PLAIN, each.version))
    least = ".".join(map(str, OLDEST))
    if not interpreters:
        raise HostsError(f"{name}: has no python3; must be >= {least}; install it there")
    version = ".".join(map(str, interpreters[0].version))
    raise HostsError(
        f"{name}: {interpreters[0].command} is {version}; must be >= {least}; install a newer one beside it"
    )


def wheel_target(name: str, facts: Mapping[str, Any]) -> WheelTarget:
    """Return what wheels for a host must fit.

    Args:
        name: of the host, for errors.
        facts: of the host, by on_host.py.

    Raises:
        HostsError: wheels are not made for such a system.
    """
    major, minor = facts["version"]
    if facts["implementation"] != "cpython":
        raise HostsError(f"{name}: its Python is {facts['implementation']}; must be CPython; install that there")
    platforms = _platforms(facts["platform"], facts["libc"])
    if not platforms:
        shown = " ".join(filter(None, (facts["platform"], *facts["libc"])))
        raise HostsError(f"{name}: is {shown}; must be Linux with glibc, or macOS; install zsim by hand there")
    return WheelTarget((major, minor), f"cp{major}{minor}{'t' if facts['free_threaded'] else ''}", tuple(platforms))


def _platforms(system: str, libc: Sequence[str]) -> list[str]:
    """Return the platform tags of PEP 600 (Linux) or of PEP 425 (macOS), the best first."""
    kind, _, rest = system.partition("-")
    if kind == "macosx":
        return [f"macosx_{rest}".replace(".", "_").replace("-", "_")]
    if kind != "linux" or libc[0] != "glibc":
        return []
    machine = rest.replace("-", "_")
    tags = []
    for minor in range(int(libc[1].split(".")[1]), MANYLINUX_OLDEST - 1, -1):
        tags.append(f"manylinux_2_{minor}_{machine}")
        tags += [f"{LEGACY[minor]}_{machine}"] if minor in LEGACY else []
    return [*tags, f"linux_{machine}"]
