"""Pythons for another processor, C library or version, unpacked from Debian packages and wheels without installing.

CACHE/NAME-DIGEST/root, site, compiled      unpacked packages, wheels, and compiled kernels

This machine's apt and pip fetch them once, with state of their own: the system is not changed, and no privileges are
needed. Each Python runs this checkout.
"""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import requires
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
CACHE = Path(os.environ.get("ZSIM_OTHER_PYTHONS") or Path.home() / ".cache" / "zsim-other-pythons")
EXTRAS = ("agents", "world", "record")
APT = """
Dir::State "{folder}/apt";
Dir::State::status "{folder}/apt/status";
Dir::Cache "{folder}/apt/cache";
Dir::Etc::sourcelist "{folder}/apt/sources.list";
Dir::Etc::sourceparts "/nonexistent";
APT::Architecture "{architecture}";
APT::Architectures {{ "{architecture}"; }};
APT::Sandbox::User "";
"""


class LackingError(Exception):
    """This machine lacks something that is needed to fetch or run such a Python."""


class OtherPython(NamedTuple):
    command: tuple[str, ...]
    environment: Mapping[str, str]

    def start(self, arguments: Sequence[str], output: Path) -> "subprocess.Popen[str]":
        """Start it with arguments; redirect its output to a file."""
        with output.open("w") as log:
            words, environment = [*self.command, *arguments], {**os.environ, **self.environment}
            return subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT, text=True, env=environment, cwd=ROOT)


class Kind(NamedTuple):
    """The components of a Python.

    Attributes:
        package: Debian package of the interpreter.
        suite: Debian suite that contains `package`; None for this machine's.
        architecture: Debian architecture.
        platforms: platform tags of the wheels.
        emulator: program that runs the interpreter; None for the dynamic loader from the packages.
    """

    package: str
    suite: str | None
    architecture: str
    platforms: tuple[str, ...]
    emulator: str | None


_MANYLINUX = ("manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014")
AARCH64 = Kind("python3.11", None, "arm64", tuple(f"{each}_aarch64" for each in _MANYLINUX), "qemu-aarch64-static")
NEWEST = Kind("python3.14", "sid", "amd64", tuple(f"{each}_x86_64" for each in _MANYLINUX), None)


def other_python(kind: Kind) -> OtherPython:
    """Return a Python, after fetching it unless it is in the cache.

    Raises:
        LackingError: this machine has no apt or no emulator, is not an x86-64, or cannot reach the packages.
    """
    for tool in ("apt-get", "dpkg-deb", *([kind.emulator] if kind.emulator else [])):
        if shutil.which(tool) is None:
            raise LackingError(f"{tool} is not installed")
    if platform.machine() != "x86_64":
        raise LackingError("it is fetched for x86-64")
    wheels = _requirements()
    constraints = _constraints(kind)
    digest = hashlib.sha256(repr((kind, wheels, constraints)).encode()).hexdigest()[:12]
    folder = CACHE / f"{kind.package}-{kind.architecture}-{digest}"
    if not (folder / "ready").exists():
        shutil.rmtree(folder, ignore_errors=True)
        _fetch_packages(kind, folder)
        (folder / "constraints.txt").write_text("\n".join(constraints))
        _fetch_wheels(kind, wheels, folder)
        (folder / "ready").touch()
    root = folder / "root"
    interpreter = str(root / "usr" / "bin" / kind.package)
    if kind.emulator:
        command = (kind.emulator, "-L", str(root), interpreter)
    else:
        loader = next(root.rglob("ld-linux-x86-64.so.2"))
        command = (str(loader), "--library-path", str(root / "usr" / "lib" / "x86_64-linux-gnu"), interpreter)
    paths = [ROOT, ROOT / "agents", ROOT / "world", ROOT / "deploy", folder / "site"]
    environment = {
        "PYTHONHOME": str(root / "usr"),
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
        "PYTHONDONTWRITEBYTECODE": "1",
        "NUMBA_CACHE_DIR": str(folder / "compiled"),
    }
    return OtherPython((*command, "-P"), environment)


def _requirements() -> list[str]:
    """Return the packages that a flight requires, as zsim declares them."""
    declared = [Requirement(line) for line in requires("zsim") or ()]
    needed = {
        f"{each.name}{each.specifier}"
        for each in declared
        if each.name != "zsim" and any(not each.marker or each.marker.evaluate({"extra": extra}) for extra in EXTRAS)
    }
    return sorted(needed)


def _constraints(kind: Kind) -> list[str]:
    """Return the constraints for this version of Python; pip would apply those for the Python that runs pip."""
    version = kind.package.removeprefix("python")
    of_version = {"python_version": version, "python_full_version": f"{version}.0"}
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    listed = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return [f"{each.name}{each.specifier}" for each in listed if not each.marker or each.marker.evaluate(of_version)]


def _fetch_packages(kind: Kind, folder: Path) -> None:
    """Unpack the package and its dependencies into `root`."""
    apt = folder / "apt"
    (apt / "cache").mkdir(parents=True)
    (apt / "status").touch()
    listed = _output("apt-get", "indextargets", "--format", "$(REPO_URI) $(CODENAME) $(ORIGIN)", "Created-By: Packages")
    lines = [line.split() for line in listed.splitlines() if line.endswith(" Debian")]
    if not lines:
        raise LackingError("apt lists no package of Debian; run apt-get update")
    uri, release, _ = lines[0]
    keys = "/usr/share/keyrings/debian-archive-keyring.gpg"
    (apt / "sources.list").write_text(f"deb [signed-by={keys}] {uri} {kind.suite or release} main\n")
    (apt / "apt.conf").write_text(APT.format(folder=folder, architecture=kind.architecture))
    own = ("apt-get", "-q", "-c", str(apt / "apt.conf"))
    try:
        _output(*own, "update")
    except RuntimeError as error:
        raise LackingError(f"apt reaches no package of {kind.suite or release}: {error}") from error
    _output(*own, "install", "--download-only", "--no-install-recommends", "-y", kind.package, "libstdc++6")
    for package in sorted((apt / "cache" / "archives").glob("*.deb")):
        _output("dpkg-deb", "-x", str(package), str(folder / "root"))
    shutil.rmtree(apt)


def _fetch_wheels(kind: Kind, wheels: Sequence[str], folder: Path) -> None:
    platforms = [word for each in kind.platforms for word in ("--platform", each)]
    version = ["--python-version", kind.package.removeprefix("python"), "--only-binary=:all:", *platforms]
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--disable-pip-version-check",
        "-q",
        "--no-compile",
        "--ignore-requires-python",
    ]
    _output(*pip, *version, "--target", str(folder / "site"), "-c", str(folder / "constraints.txt"), *wheels)


def _output(*words: str) -> str:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}: {done.stderr or done.stdout}")
    return done.stdout
