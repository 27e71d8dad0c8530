"""The folder that a rendering is written into: what an earlier one left there goes, and nothing else does.

A list beside the files says which ones a rendering wrote, as `sha256sum` does: a file that somebody has put there or
has changed since is never removed.
"""

import contextlib
import hashlib
from collections.abc import Mapping
from pathlib import Path

from zsim.errors import RunError


def write(out: Path, target: str, texts: Mapping[str, str]) -> list[str]:
    """Write the texts into a folder; return the files of an earlier rendering for this target that were removed.

    Args:
        out: the folder, made if it is not there.
        target: what it is rendered for; each target has a list of its own.
        texts: by path inside the folder, HOST/FILE or FILE; a host named `..` does not lead out of it.

    Raises:
        RunError: it cannot be written, a path leads out of it, or a file that has to go was changed by somebody.
    """
    root, record = out.resolve(), out / listing(target)
    for name in texts:
        if not _inside(root, name):
            raise RunError(f"{name}: leads out of {out}; rename that host in the inventory")
    stale = _stale(root, _read(record, out), texts)
    for name in stale:
        _remove(root, name)
    _put(record, "".join(f"{_digest(text.encode())}  {name}\n" for name, text in texts.items()))
    for name, text in texts.items():
        _put(root / name, text)
    return stale


def listing(target: str) -> str:
    """Return the name of the list of a target's files."""
    return f".zsim-render-{target}.sha256"


def _stale(root: Path, former: Mapping[str, str], texts: Mapping[str, str]) -> list[str]:
    """Return what was rendered before, is there as it was written, and is none of the texts."""
    found = [name for name in former if name not in texts and _inside(root, name) and (root / name).is_file()]
    for name in found:
        if not _is(root / name, former[name]):
            raise RunError(
                f"{root / name}: an earlier rendering wrote it and it was changed since; "
                "remove it, or give --out another folder"
            )
    return found


def _inside(root: Path, name: str) -> bool:
    path = (root / name).resolve()
    return root in (path.parent, path.parent.parent)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _is(path: Path, digest: str) -> bool:
    try:
        return _digest(path.read_bytes()) == digest
    except OSError:
        return False


def _read(record: Path, out: Path) -> dict[str, str]:
    """Return the digests of what was rendered before, by path."""
    try:
        lines = record.read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error.strerror}); give --out another folder") from error
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines) if name}


def _remove(root: Path, name: str) -> None:
    path = root / name
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise RunError(f"{path}: cannot be removed ({error.strerror}); give --out another folder") from error
    if path.parent != root:
        with contextlib.suppress(OSError):  # something else is in it
            path.parent.rmdir()


def _put(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror}); give --out another folder") from error
