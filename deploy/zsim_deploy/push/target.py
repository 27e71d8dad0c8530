"""Which Python of a host zsim is installed for, and what pip is asked for then. Pure."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from zsim.errors import HostsError

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


class Target(NamedTuple):
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


def question() -> str:
    """Return a line of POSIX shell that prints command, version and path of every Python of a host."""
    names = [PLAIN, *(f"python3.{minor}" for minor in range(NEWEST_MINOR, OLDEST[1] - 1, -1))]
    say = 'import sys; print("%d.%d.%d" % sys.version_info[:3], sys.executable)'
    return f"for p in {' '.join(names)}; do said=$($p -c '{say}' 2>/dev/null) && echo $p $said; done; true"


def interpreters(answer: str) -> list[Interpreter]:
    """Return what `question` printed; a greeting of the login shell is passed over."""
    found = filter(None, map(ANSWER.fullmatch, answer.splitlines()))
    return [Interpreter(each[1], (int(each[2]), int(each[3]), int(each[4])), each[5]) for each in found]


def chosen(name: str, found: Sequence[Interpreter], here: tuple[int, int]) -> Interpreter:
    """Return the Python to install for: the launcher's minor version if it is there, else `python3`, else the newest.

    Raises:
        HostsError: none is new enough.
    """
    fit = [each for each in found if each.version[:2] >= OLDEST]
    if fit:
        return max(fit, key=lambda each: (each.version[:2] == here, each.command == PLAIN, each.version))
    least = ".".join(map(str, OLDEST))
    if not found:
        raise HostsError(f"{name}: has no python3; must be >= {least}; install it there")
    version = ".".join(map(str, found[0].version))
    raise HostsError(f"{name}: {found[0].command} is {version}; must be >= {least}; install a newer one beside it")


def target(name: str, said: Mapping[str, Any]) -> Target:
    """Return what wheels for a host must fit.

    Args:
        name: of the host, for errors.
        said: as on_host.py says it.

    Raises:
        HostsError: wheels are not made for such a system.
    """
    major, minor = said["version"]
    if said["implementation"] != "cpython":
        raise HostsError(f"{name}: its Python is {said['implementation']}; must be CPython; install that there")
    platforms = _platforms(said["platform"], said["libc"])
    if not platforms:
        shown = " ".join(filter(None, (said["platform"], *said["libc"])))
        raise HostsError(f"{name}: is {shown}; must be Linux with glibc, or macOS; install zsim by hand there")
    return Target((major, minor), f"cp{major}{minor}{'t' if said['free_threaded'] else ''}", tuple(platforms))


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
