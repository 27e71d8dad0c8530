"""The wheels that hosts need, gathered on the launcher's machine by pip, once for each content.

CACHE/wheels/*.whl           wheels of other projects, for all hosts
CACHE/build/*.whl            wheels of what builds this project, for this machine
CACHE/houses/KEY.json        names of the wheels that one kind of host needs; KEY is a hash of what was asked
CACHE/zsim/KEY/zsim-*.whl    this project, built; KEY is a hash of its sources
"""

import asyncio
import hashlib
import importlib.metadata
import json
import os
import re
import shutil
import tempfile
import tomllib
import zipfile
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urldefrag

import zsim
from zsim.errors import HostsError
from zsim_deploy.push.installer import WheelTarget
from zsim_deploy.push.wheel_download import PipError, Progress, UnreachableError, download_wheels, is_kept, pip

PROJECT = "zsim"
KEY_DIGITS = 16  # 64 bits of a SHA-256; what one person builds never collides
PIP = "pip"  # installs on a host that has none; never held to the version here, which may be too old for a newer Python


class Wheel(NamedTuple):
    path: Path
    sha256: str
    size_bytes: int


class WheelSet(NamedTuple):
    """What one host needs."""

    project: Wheel
    pip: Wheel
    others: tuple[Wheel, ...]
    extras: tuple[str, ...]

    def wheels(self) -> tuple[Wheel, ...]:
        return (self.project, self.pip, *self.others)

    def manifest(self) -> dict[str, Any]:
        """Return what a host keeps of it."""
        wheels = {wheel.path.name: wheel.sha256 for wheel in self.others}
        return {"project": self.project.sha256, "extras": list(self.extras), "wheels": wheels}


class Wheelhouse:
    """Builds and downloads what is not there yet, one thing at a time.

    Args:
        folder: of the cache.
        progress: called with what is being done.
    """

    def __init__(self, folder: Path, progress: Progress) -> None:
        self._folder, self._progress = folder, progress
        self._unreachable = ""
        self._lock = asyncio.Lock()
        self._wheels, self._builders = folder / "wheels", folder / "build"
        for made in (self._wheels, self._builders, folder / "houses"):
            made.mkdir(parents=True, exist_ok=True)

    async def wheel_set(self, host: str, target: WheelTarget, extras: Iterable[str]) -> WheelSet:
        """Return what a host needs.

        Args:
            host: its name, for errors.

        Raises:
            HostsError: the project cannot be built, a wheel that fits the host does not exist, or pip has no index.
        """
        async with self._lock:
            if self._unreachable:
                raise HostsError(self._unreachable)  # for the next host it would take as long again
            try:
                project = await self._project()
                wanted = tuple(sorted(extras))
                key = _key([requirements(project), wanted, target.options(), constraints()])
                names = self._known(key) or await self._gather(host, key, project, wanted, target)
            except UnreachableError as error:
                self._unreachable = (
                    f"launcher: the package index cannot be reached ({error}); connect this machine to it for the "
                    "first push, or give pip a folder with all wheels (PIP_NO_INDEX=1 PIP_FIND_LINKS=FOLDER)"
                )
                raise HostsError(self._unreachable) from error
        wheels = [_wheel(self._wheels / name) for name in names]
        pip = next(wheel for wheel in wheels if wheel.path.name.startswith(f"{PIP}-"))
        return WheelSet(_wheel(project), pip, tuple(wheel for wheel in wheels if wheel is not pip), wanted)

    async def _project(self) -> Path:
        """Return the wheel of this project: of the checkout, or of what is installed."""
        checkout = _checkout()
        source = str(checkout) if checkout else requirement(importlib.metadata.distribution(PROJECT))
        folder = self._folder / PROJECT / _key([zsim.__version__, _sources(checkout)] if checkout else source)
        if not folder.is_dir():
            self._progress(f"building the wheel of {PROJECT}")
            with tempfile.TemporaryDirectory(dir=self._folder) as made:
                try:
                    await self._build(source, _build_requirements(checkout), f"{made}/wheel")
                except PipError as error:
                    raise HostsError(f"launcher: no wheel of {PROJECT} from {source}: {error}") from error
                folder.parent.mkdir(exist_ok=True)
                _move(Path(made, "wheel"), folder)
        return next(folder.glob("*.whl"))

    async def _build(self, source: str, needs: Sequence[str], into: str) -> None:
        """Build the wheel; what that needs is kept, so that the next time no index is asked."""
        build = ("wheel", "--no-deps", "--wheel-dir", into, source)
        if await is_kept(self._builders, build, self._progress):
            return
        if needs:
            await pip("download", "--dest", str(self._builders), *needs, progress=self._progress)
        await pip(*build, "--find-links", str(self._builders), progress=self._progress)

    def _known(self, key: str) -> list[str]:
        """Return the names of a house that was gathered before; none if a wheel of it is missing."""
        note = self._folder / "houses" / f"{key}.json"
        names = json.loads(note.read_text()) if note.exists() else []
        return names if all((self._wheels / name).exists() for name in names) else []

    async def _gather(
        self, host: str, key: str, project: Path, extras: Sequence[str], target: WheelTarget
    ) -> list[str]:
        self._progress(f"gathering the wheels for {target}" + (f" with {', '.join(extras)}" if extras else ""))
        wanted = f"{project}[{','.join(extras)}]" if extras else str(project)
        with tempfile.TemporaryDirectory(dir=self._folder) as made:
            try:
                other_versions = await download_wheels(
                    [wanted, PIP], target, Path(made), constraints(), self._wheels, self._progress
                )
            except PipError as error:
                raise HostsError(f"{host}: {_lacking(error, target)}") from error
            names = sorted(path.name for path in Path(made).glob("*.whl") if path.name != project.name)
            for name in names:
                os.replace(Path(made, name), self._wheels / name)
        if other_versions:
            self._progress(f"{host}: {target} gets other versions of packages than are here: not the same bits")
        note = self._folder / "houses" / f"{key}.json"
        note.with_suffix(".part").write_text(json.dumps(names))
        os.replace(note.with_suffix(".part"), note)
        return names


def _lacking(error: PipError, target: WheelTarget) -> str:
    """Return a line on the wheel that does not exist, from pip's error."""
    match = re.search(r"satisfies the requirement ([\w.-]+)", str(error))
    if match is None:
        return f"no wheels for {target}: {error}"
    other = "take another Python there, or build it there and give its folder to pip here (PIP_FIND_LINKS)"
    return f"no wheel of {match[1]} for {target}; {other}"


def requirements(project: Path) -> list[str]:
    """Return the requirements in a wheel's metadata, for all extras."""
    with zipfile.ZipFile(project) as archive:
        name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        lines = archive.read(name).decode().partition("\n\n")[0].splitlines()
    return sorted(line for line in lines if line.startswith("Requires-"))


def requirement(installed: importlib.metadata.Distribution) -> str:
    """Return the requirement by which pip gets an installed distribution again: where it came from, or its version."""
    origin = json.loads(installed.read_text("direct_url.json") or "{}")  # PEP 610
    if "vcs_info" in origin:
        return f"{PROJECT} @ {origin['vcs_info']['vcs']}+{origin['url']}@{origin['vcs_info']['commit_id']}"
    return f"{PROJECT} @ {urldefrag(origin['url']).url}" if origin else f"{PROJECT}=={installed.version}"


@cache
def constraints() -> list[str]:
    """Return the versions of what is installed here from an index."""
    versions = set()
    for each in importlib.metadata.distributions():
        name = each.metadata["Name"].lower()
        if name not in (PROJECT, PIP) and "+" not in each.version and not each.read_text("direct_url.json"):
            versions.add(f"{name}=={each.version}")
    return sorted(versions)


def _checkout() -> Path | None:
    """Return the folder from which this very code is imported, if it is a checkout of the project."""
    root = Path(zsim.__file__).resolve().parents[1]
    description = root / "pyproject.toml"
    known = tomllib.loads(description.read_text()) if description.exists() else {}
    return root if known.get("project", {}).get("name") == PROJECT else None


def _build_requirements(checkout: Path | None) -> list[str]:
    """Return what a checkout is built with; nothing where its wheel comes from elsewhere."""
    return tomllib.loads((checkout / "pyproject.toml").read_text())["build-system"]["requires"] if checkout else []


def _sources(root: Path) -> list[tuple[str, str]]:
    """Return path and hash of every file that goes into the wheel, or decides how it is made."""
    description = root / "pyproject.toml"
    packages = tomllib.loads(description.read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    files = [description, root / "README.md"]
    for package in packages:
        files += sorted(path for path in (root / package).rglob("*") if path.is_file())
    kept = [path for path in files if "__pycache__" not in path.parts]
    return [(str(path.relative_to(root)), _sha256(path)) for path in kept]


def _wheel(path: Path) -> Wheel:
    return Wheel(path, _sha256(path), path.stat().st_size)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _key(content: Any) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:KEY_DIGITS]


def _move(source: Path, target: Path) -> None:
    """Move a folder to where another process may have put the same meanwhile."""
    try:
        source.rename(target)
    except OSError:
        if not target.is_dir():
            raise
        shutil.rmtree(source)
