"""The bundle file: a zip archive with the same bytes for the same content, fully checked before any use.

Members are stored, not compressed: zlib's output depends on its version, and a stored member cannot be larger than the
file that contains it. `bundle.json` lists a bundle's content with the hash of each member and, as `seal`, its own.
These hashes detect accidental and manual changes; they are not a signature.
"""

import hashlib
import importlib.metadata
import re
import shutil
import stat
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import msgspec
from msgspec import Struct

from zsim.errors import OTHER_OUT, RunError, file_fault
from zsim.output_folder import temporary_folder
from zsim_analysis.report import indented_json

SUFFIX = ".zsim"
MANIFEST, README, SCENARIO, LOCK = "bundle.json", "README.md", "scenario.yaml", "lock.txt"
RECORD, GATES, RESULTS = "run.mcap", "gates.csv", "results.json"
MODULES, FIGURES = "modules", "figures"  # folders
FORMAT = 1
MEMBERS_MAX = 5000
MANIFEST_BYTES_MAX = 4 << 20
NAME_MAX = 200  # longest name of a member [characters]
CHUNK_BYTES = 1 << 20
DATE = (1980, 1, 1, 0, 0, 0)  # date of every member: the earliest that a zip archive can store
MODE = (stat.S_IFREG | 0o644) << 16
UNIX = 3  # stored as the creating system on every system, so that the bytes are the same
PIN = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9])?==[A-Za-z0-9][A-Za-z0-9.!+_]*")  # a line of the lock file
EXTRAS = ("agents", "record", "report", "world")  # extras that a rerun and its figures need
PART = re.compile(r"\w[\w.+@ -]*(?<![ .])")  # part of a member's path: no `..`, no drive, nothing hidden


class File(Struct, frozen=True, forbid_unknown_fields=True):
    """A member of a bundle."""

    sha256: str
    bytes: int


class Manifest(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The content of a bundle, and the expected results of flying it again: `bundle.json`."""

    format: int
    zsim: str  # version of zsim that flew the bundled run
    commit: str  # commit of zsim at bundling; empty if unknown
    name: str  # name of the scenario
    seed: int
    duration_s: float
    scenario_sha256: str
    truth_sha256: str
    outputs: dict[str, str]  # SHA-256 of the agents' outputs by key, as in OutputHashes; empty if none are run again
    until_ns: int  # time of the last gate whose outputs are compared; later ones may be missing from the record
    own_code: list[str]  # users' classes, functions and modules that the scenario names
    needs: list[str]  # NAME==VERSION of the packages other than zsim's that these import
    not_run_again: str  # why commands are read from the record instead of running the agents again; else empty
    fingerprints: list[str]  # fingerprints of the world and its agents
    machine: dict[str, str]  # machine that flew the run; empty if it was bundled on another
    files: dict[str, File]  # all other members by path
    seal: str = ""  # SHA-256 of the manifest's text with this field empty

    def sealed(self) -> "Manifest":
        blank = msgspec.structs.replace(self, seal="")
        return msgspec.structs.replace(self, seal=hashlib.sha256(blank.text()).hexdigest())

    def text(self) -> bytes:
        return indented_json(self, "sorted")


class WrittenBundle(NamedTuple):
    path: Path
    size_bytes: int
    sha256: str
    manifest: Manifest


def refuse_existing(out: Path, force: bool) -> None:
    """Raise RunError if `out` exists and `force` does not allow replacing it."""
    if out.exists() and not force:
        raise RunError(f"{out}: already exists; --force replaces it, or {OTHER_OUT}")


def write_bundle(out: Path, manifest: Manifest, members: Mapping[str, Path | bytes], force: bool) -> WrittenBundle:
    """Write a bundle.

    Args:
        out: path of the bundle.
        manifest: the manifest without `files`.
        members: by path in the bundle, the content or the file that contains it.
        force: whether to replace an existing file.

    Raises:
        RunError: the file exists or cannot be written.
    """
    refuse_existing(out, force)
    files = {name: File(*_hashed(content)) for name, content in sorted(members.items())}
    sealed = msgspec.structs.replace(manifest, files=files).sealed()
    part = out.with_name(f".{out.name}.part")
    with file_fault(out, "cannot be written", OTHER_OUT):
        try:
            with zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
                ordered = {README: members[README], MANIFEST: sealed.text(), **dict(sorted(members.items()))}
                for name, content in ordered.items():
                    entry = zipfile.ZipInfo(name, DATE)
                    entry.create_system, entry.external_attr = UNIX, MODE
                    entry.file_size = len(content) if isinstance(content, bytes) else content.stat().st_size
                    with archive.open(entry, "w") as target:
                        for piece in _chunks(content):
                            target.write(piece)
            part.replace(out)
        finally:
            part.unlink(missing_ok=True)
    sha256, size_bytes = _hashed(out)
    return WrittenBundle(out, size_bytes, sha256, sealed)


@contextmanager
def open_bundle(path: Path) -> Iterator[tuple[Manifest, Path]]:
    """Check a bundle; yield its manifest and a temporary folder with its members.

    Raises:
        RunError: the file is not a bundle, was changed, or cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            manifest = _manifest(path, archive)
            folder = temporary_folder("bundle-")
            for name, expected in manifest.files.items():
                _extract(path, archive, name, expected, folder)
    except (zipfile.BadZipFile, NotImplementedError, EOFError, UnicodeError) as error:
        raise RunError(f"{path}: is not a bundle or is damaged ({error}); must be written by `zsim bundle`") from error
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        yield manifest, folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def is_bundle(path: Path) -> bool:
    return path.is_file() and (path.suffix == SUFFIX or zipfile.is_zipfile(path))


def differing_packages(lock: Iterable[str]) -> list[str]:
    """Return the packages of a lock file that are installed here in another version, or not at all."""
    differing = []
    for line in lock:
        name, _, version = line.partition("==")
        try:
            installed = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            installed = "none"
        if installed != version:
            differing.append(f"{name} {version}, here {installed}")
    return differing


def pins_of(text: str, where: str) -> list[str]:
    """Return a lock file's lines; raise RunError if one is not NAME==VERSION but, for example, an option or a URL."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    for line in lines:
        if not PIN.fullmatch(line):
            raise RunError(f"{where}: has the line {line[:80]!r}; must be NAME==VERSION")
    return lines


def _manifest(path: Path, archive: zipfile.ZipFile) -> Manifest:
    """Return an archive's manifest after checking its seal and that it lists all members, which must be plain files."""
    entries = archive.infolist()
    if len(entries) > MEMBERS_MAX:
        raise RunError(f"{path}: has {len(entries)} members; must be <= {MEMBERS_MAX}")
    names: set[str] = set()
    for entry in entries:
        if fault := _fault_of(entry, names):
            raise RunError(f"{path}: member {entry.filename[:NAME_MAX]!r} {fault}")
        names.add(entry.filename.casefold())
    size, declared_bytes = path.stat().st_size, sum(entry.file_size for entry in entries)
    if declared_bytes > size:
        raise RunError(
            f"{path}: its members have {declared_bytes} bytes, but the file only {size}; members must not overlap"
        )
    if MANIFEST not in archive.namelist():
        raise RunError(f"{path}: contains no {MANIFEST}; must be written by `zsim bundle`")
    manifest_entry = archive.getinfo(MANIFEST)
    if manifest_entry.file_size > MANIFEST_BYTES_MAX:
        raise RunError(f"{path}: {MANIFEST} has {manifest_entry.file_size} bytes; must be <= {MANIFEST_BYTES_MAX}")
    text = archive.read(manifest_entry)
    try:
        version: Any = msgspec.json.decode(text)
        if isinstance(version, dict) and version.get("format", FORMAT) != FORMAT:
            found_format = version["format"]
            raise RunError(f"{path}: {MANIFEST} is of format {found_format!r:.40}; must be {FORMAT}; use a newer zsim")
        manifest = msgspec.json.decode(text, type=Manifest)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise RunError(f"{path}: {MANIFEST} cannot be read ({error}); must be as `zsim bundle` wrote it") from error
    if manifest.sealed().seal != manifest.seal:
        raise RunError(f"{path}: was changed: the content of {MANIFEST} does not match its seal")
    members = {entry.filename for entry in entries} - {MANIFEST}
    if mismatched := sorted(members ^ set(manifest.files)):
        fault = f"is not in {MANIFEST}" if mismatched[0] in members else f"is missing, but listed in {MANIFEST}"
        raise RunError(f"{path}: was changed: {mismatched[0]} {fault}")
    for name in (README, SCENARIO, LOCK):
        if name not in members:
            raise RunError(f"{path}: contains no {name}; must be written by `zsim bundle`")
    return manifest


def _fault_of(entry: zipfile.ZipInfo, names: set[str]) -> str:
    """Return what is wrong with a member; empty if nothing is."""
    name, kind = entry.filename, stat.S_IFMT(entry.external_attr >> 16)
    parts = name.split("/")
    if len(name) > NAME_MAX or not all(PART.fullmatch(part) for part in parts) or name != entry.orig_filename:
        return "has an invalid name; must be a relative path within the bundle"
    if name.casefold() in names:
        return "exists twice; must exist once"
    if kind not in (0, stat.S_IFREG) or entry.is_dir():
        return "is not a plain file; must be one"
    if entry.flag_bits & 1:
        return "is encrypted; must be plain"
    if entry.compress_type != zipfile.ZIP_STORED or entry.compress_size != entry.file_size:
        return "is compressed; must be stored, as `zsim bundle` wrote it"
    return ""


def _extract(path: Path, archive: zipfile.ZipFile, name: str, expected: File, folder: Path) -> None:
    target = folder / name
    target.parent.mkdir(parents=True, exist_ok=True)
    digest, size = hashlib.sha256(), 0
    with archive.open(name) as source, target.open("xb") as file:
        while chunk := source.read(CHUNK_BYTES):
            digest.update(chunk)
            file.write(chunk)
            size += len(chunk)
    if (digest.hexdigest(), size) != (expected.sha256, expected.bytes):
        raise RunError(f"{path}: was changed: the content of {name} does not match {MANIFEST}")


def _hashed(content: Path | bytes) -> tuple[str, int]:
    """Return the SHA-256 and the size in bytes of `content`."""
    digest, size = hashlib.sha256(), 0
    for chunk in _chunks(content):
        digest.update(chunk)
        size += len(chunk)
    return digest.hexdigest(), size


def _chunks(content: Path | bytes) -> Iterator[bytes]:
    if isinstance(content, bytes):
        yield content
        return
    file: IO[bytes]
    with content.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            yield chunk
