"""The wheels that hosts need, collected by pip on the launcher's machine, and cached.

CACHE/wheels/*.whl           wheels of other projects, for all hosts
CACHE/build/*.whl            wheels of this project's build requirements, for this machine
CACHE/houses/KEY.json        names of the wheels for a kind of host; KEY is a hash of its target, extras and versions
CACHE/zsim/KEY/zsim-*.whl    wheel of this project; KEY is a hash of its sources
"""

import asyncio
import hashlib
import importlib.metadata
import json
import os
import re
import shutil
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urldefrag

import zsim
from zsim.errors import HostsError
from zsim_deploy import SAFE_PATH

PROJECT = "zsim"
KEY_DIGITS = 16  # hexadecimal digits; 64 bits of a SHA-256
LOCK = "constraints.txt"  # file in a checkout that pins the versions of packages
PIP = "pip"  # for hosts without pip; unconstrained, since this machine's may be too old for a newer Python
RETRIES = "1"  # pip's retries for each page of an index; its default of 5 takes minutes without a network
LINE_BYTES = 1 << 20  # maximum length of a line that pip prints
NO_INDEX = re.compile(r"connection broken by '\w+\((.*)\)': ")  # pip prints this, with the reason, before a retry
MANYLINUX_OLDEST = 5  # minor version of the oldest glibc with a tag, 2.5; PEP 600
MANYLINUX2014 = 17  # minor version of its glibc, 2.17; PEP 599. Given manylinux2014, pip also accepts the older aliases

Progress = Callable[[str], None]


class PipError(Exception):
    """pip failed; the text is its error line."""


class UnreachableError(Exception):
    """The package index does not answer."""


class WheelTarget(NamedTuple):
    """The Python and platform that wheels are for."""

    version: tuple[int, int]
    abi: str  # such as cp311; PEP 425
    platforms: tuple[str, ...]  # compatible platform tags, the best first

    def options(self) -> list[str]:
        """Return the pip options that select this target."""
        platforms = [word for name in self.platforms for word in ("--platform", name)]
        version = ".".join(map(str, self.version))
        return ["--implementation", "cp", "--python-version", version, "--abi", self.abi, *platforms]

    def __str__(self) -> str:
        return f"Python {'.'.join(map(str, self.version))} on {self.platforms[0]}"


def wheel_target(name: str, facts: Mapping[str, Any]) -> WheelTarget:
    """Return a host's target for wheels, from the facts of on_host.py; raise HostsError if no wheels exist for it."""
    major, minor = facts["version"]
    if facts["implementation"] != "cpython":
        raise HostsError(f"{name}: its Python is {facts['implementation']}; must be CPython; install CPython there")
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
    machine, newest = rest.replace("-", "_"), int(libc[1].split(".")[1])
    tags = [f"manylinux_2_{minor}_{machine}" for minor in range(newest, MANYLINUX_OLDEST - 1, -1)]
    if newest >= MANYLINUX2014:
        tags.insert(newest - MANYLINUX2014 + 1, f"manylinux2014_{machine}")
    return [*tags, f"linux_{machine}"]


class Wheel(NamedTuple):
    path: Path
    sha256: str
    size_bytes: int


class WheelSet(NamedTuple):
    """The wheels that one host needs."""

    project: Wheel
    pip: Wheel
    others: tuple[Wheel, ...]
    extras: tuple[str, ...]

    def manifest(self) -> dict[str, Any]:
        wheels = {wheel.path.name: wheel.sha256 for wheel in self.others}
        return {"project": self.project.sha256, "extras": list(self.extras), "wheels": wheels}


class Wheelhouse:
    """Builds and downloads missing wheels, for one host at a time."""

    def __init__(self, folder: Path, progress: Progress) -> None:
        self._folder, self._progress = folder, progress
        self._unreachable = ""
        self._lock = asyncio.Lock()
        self._wheels, self._builders, self._houses = folder / "wheels", folder / "build", folder / "houses"
        for each in (self._wheels, self._builders, self._houses):
            each.mkdir(parents=True, exist_ok=True)

    async def wheel_set(self, host: str, target: WheelTarget, extras: Iterable[str]) -> WheelSet:
        """Return the wheels that a host needs.

        Raise HostsError if the project cannot be built, a wheel for the host is missing, or no index can be reached.
        """
        async with self._lock:
            if self._unreachable:
                raise HostsError(self._unreachable)  # another attempt would take just as long
            try:
                project = await self._project()
                extra_names = tuple(sorted(extras))
                key = _key([requirements(project), extra_names, target.options(), constraints(), lock()])
                note_path = self._houses / f"{key}.json"
                names = json.loads(note_path.read_text()) if note_path.exists() else []
                if not names or not all((self._wheels / name).exists() for name in names):
                    names = await self._gather(host, note_path, project, extra_names, target)
            except UnreachableError as error:
                self._unreachable = (
                    f"launcher: the package index cannot be reached ({error}); connect this machine to it for the "
                    "first push, or give pip a folder with all wheels (PIP_NO_INDEX=1 PIP_FIND_LINKS=FOLDER)"
                )
                raise HostsError(self._unreachable) from error
        wheels = [_wheel(self._wheels / name) for name in names]
        installer = next(wheel for wheel in wheels if wheel.path.name.startswith(f"{PIP}-"))
        others = tuple(wheel for wheel in wheels if wheel is not installer)
        return WheelSet(_wheel(project), installer, others, extra_names)

    async def _project(self) -> Path:
        """Return the wheel of this project, built from the checkout or from the installed version.

        The build requirements are cached, so that the next build needs no index.
        """
        root = checkout()
        source = str(root) if root else requirement(importlib.metadata.distribution(PROJECT))
        folder = self._folder / PROJECT / _key([zsim.__version__, _sources(root)] if root else source)
        if not folder.is_dir():
            self._progress(f"building the wheel of {PROJECT}")
            with tempfile.TemporaryDirectory(dir=self._folder) as temporary:
                built = Path(temporary, "wheel")
                build = ("wheel", "--no-deps", "--wheel-dir", str(built), source)
                try:
                    if not await has_all_wheels(self._builders, build, self._progress):
                        if needs := _description(root)["build-system"]["requires"] if root else []:
                            await pip("download", "--dest", str(self._builders), *needs, progress=self._progress)
                        await pip(*build, "--find-links", str(self._builders), progress=self._progress)
                except PipError as error:
                    raise HostsError(f"launcher: no wheel of {PROJECT} from {source}: {error}") from error
                folder.parent.mkdir(exist_ok=True)
                try:
                    built.rename(folder)
                except OSError:
                    if not folder.is_dir():  # else another process has built the same wheel meanwhile
                        raise
                    shutil.rmtree(built)
        return next(folder.glob("*.whl"))

    async def _gather(
        self, host: str, note: Path, project: Path, extras: Sequence[str], target: WheelTarget
    ) -> list[str]:
        self._progress(f"gathering the wheels for {target}" + (f" with {', '.join(extras)}" if extras else ""))
        requested = f"{project}[{','.join(extras)}]" if extras else str(project)
        with tempfile.TemporaryDirectory(dir=self._folder) as temporary:
            try:
                other_versions = await download_wheels(
                    [requested, PIP], target, Path(temporary), (constraints(), lock()), self._wheels, self._progress
                )
            except PipError as error:
                line = f"no wheels for {target}: {error}"
                if match := re.search(r"satisfies the requirement ([\w.-]+)", str(error)):
                    remedy = "use another Python there, or build that wheel there, copy it to this machine,"
                    line = f"no wheel of {match[1]} for {target}; {remedy} and set PIP_FIND_LINKS to its folder"
                raise HostsError(f"{host}: {line}") from error
            names = sorted(path.name for path in Path(temporary).glob("*.whl") if path.name != project.name)
            for name in names:
                os.replace(Path(temporary, name), self._wheels / name)
        if other_versions:
            self._progress(
                f"{host}: {target} gets other package versions than this machine, so results are not identical"
            )
        note.with_suffix(".part").write_text(json.dumps(names))
        os.replace(note.with_suffix(".part"), note)
        return names


def requirements(project: Path) -> list[str]:
    with zipfile.ZipFile(project) as archive:
        name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        lines = archive.read(name).decode().partition("\n\n")[0].splitlines()
    return sorted(line for line in lines if line.startswith("Requires-"))


def requirement(installed: importlib.metadata.Distribution) -> str:
    """Return the requirement with which pip finds an installed distribution again: its origin, or its version."""
    origin = json.loads(installed.read_text("direct_url.json") or "{}")  # PEP 610
    if "vcs_info" in origin:
        return f"{PROJECT} @ {origin['vcs_info']['vcs']}+{origin['url']}@{origin['vcs_info']['commit_id']}"
    return f"{PROJECT} @ {urldefrag(origin['url']).url}" if origin else f"{PROJECT}=={installed.version}"


@cache
def constraints() -> list[str]:
    """Return the versions of the packages installed here from an index, as pip constraints."""
    versions = set()
    for each in importlib.metadata.distributions():
        name = each.metadata["Name"].lower()
        if name not in (PROJECT, PIP) and "+" not in each.version and not each.read_text("direct_url.json"):
            versions.add(f"{name}=={each.version}")
    return sorted(versions)


def lock() -> list[str]:
    """Return the versions with which a checkout is tested, as pip constraints; empty without a checkout."""
    root = checkout()
    path = root / LOCK if root else None
    return path.read_text("utf-8").splitlines() if path and path.exists() else []


def checkout() -> Path | None:
    """Return the root of the checkout from which this code is imported; None if it is installed."""
    root = Path(zsim.__file__).resolve().parents[1]
    is_checkout = (root / "pyproject.toml").exists() and _description(root).get("project", {}).get("name") == PROJECT
    return root if is_checkout else None


def _description(root: Path) -> dict[str, Any]:
    return tomllib.loads((root / "pyproject.toml").read_text())


def _sources(root: Path) -> list[tuple[str, str]]:
    """Return the path and hash of each file that affects the wheel."""
    files = [root / "pyproject.toml", root / "README.md"]
    for package in _description(root)["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        files += sorted(path for path in (root / package).rglob("*") if path.is_file())
    sources = [path for path in files if "__pycache__" not in path.parts]
    return [(str(path.relative_to(root)), _sha256(path)) for path in sources]


def _wheel(path: Path) -> Wheel:
    return Wheel(path, _sha256(path), path.stat().st_size)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _key(content: Any) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:KEY_DIGITS]


def default_cache() -> Path:
    """Return the folder of the wheelhouse on this machine (XDG Base Directory Specification)."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zsim"
    except RuntimeError as error:  # HOME is not set, and the system does not know the user
        reason = "this user has no home folder for the cache; set XDG_CACHE_HOME to a folder"
        raise HostsError(f"launcher: {reason}") from error


# Running pip


async def download_wheels(
    requested: Sequence[str],
    target: WheelTarget,
    into: Path,
    constraint_lists: Sequence[Sequence[str]],
    cached: Path,
    progress: Progress,
) -> bool:
    """Collect wheels for a target in a folder; return whether the first list of constraints could not be met.

    Projects that the index has only as sources are built here.

    Args:
        constraint_lists: lists of pip constraints, the preferred one first: the versions of this machine, because
            identical results need identical versions. The first list that can be met is used, else the newest versions.
        cached: folder of cached wheels; no index is needed if it has all of them.

    Raises:
        PipError: there are no wheels for the target.
        UnreachableError: the index does not answer.
    """
    pip_arguments = ("download", "--only-binary=:all:", *target.options(), "--dest", str(into))

    async def download(requested: Sequence[str], built: str) -> None:
        """Download wheels; if that fails, first build wheels from sources into the folder `built`."""
        try:
            await pip(*pip_arguments, *requested, progress=progress)
        except PipError:
            progress("building packages from sources")
            await pip("wheel", "--wheel-dir", built, *requested, progress=progress)
            await pip(*pip_arguments, "--find-links", built, *requested, progress=progress)

    with tempfile.TemporaryDirectory() as scratch:
        for count, versions in enumerate(filter(None, constraint_lists)):
            limits = Path(scratch, f"constraints{count}.txt")
            limits.write_text("\n".join(versions))
            pinned = (*requested, "--constraint", str(limits))
            if await has_all_wheels(cached, (*pip_arguments, *pinned), progress):
                return count > 0
            try:
                await download(pinned, f"{scratch}/{count}")
                return count > 0
            except PipError:
                progress("looking for other package versions")
        await download(requested, f"{scratch}/other")
        return True


async def has_all_wheels(cached: Path, arguments: Sequence[str], progress: Progress) -> bool:
    """Run pip with the wheels of a folder and no index; return whether these were enough."""
    if not any(cached.glob("*.whl")):
        return False
    try:
        await pip(*arguments, "--no-index", "--find-links", str(cached), progress=progress)
    except PipError:
        return False
    return True


async def pip(*arguments: str, progress: Progress) -> None:
    """Run this Python's pip with the user's configuration, except for the number of retries.

    Raise PipError if it fails, and UnreachableError, with the reason, if an index does not answer.
    """
    options = ("--disable-pip-version-check", "--no-input", "-q")
    process = await asyncio.create_subprocess_exec(
        sys.executable, SAFE_PATH, "-m", "pip", *arguments, *options, stdin=asyncio.subprocess.DEVNULL,
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
                progress(f"the package index does not answer ({unanswered}); trying once more")
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
    """Extract the reason from a connection error printed by pip."""
    last = re.split(r"[:,] ", error)[-1].strip("\"')")
    return re.sub(r"\[Errno -?\d+\] ", "", last) + (")" if "(" in last else "")
