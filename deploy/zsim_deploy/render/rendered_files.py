"""What all renderings share: the folder that they are written into, YAML for people, and the image of a container.

A list beside the files holds their digests, as `sha256sum` prints them: a later rendering removes what an earlier one
wrote, and never a file that somebody else put there or has changed since.
"""

import contextlib
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from zsim import RELEASE
from zsim.errors import RunError
from zsim_deploy.inventory.inventory import Host, InventoryFile
from zsim_deploy.launch.role_launcher import SINGLE_THREADED

BASE = "python:3.11-slim"  # the oldest Python that zsim runs on
WHEEL = f"zsim-{RELEASE}-py3-none-any.whl"
USER = 1000  # first ordinary user of Debian
CACHE = "/var/cache/zsim"
CERTIFICATES, ACCESS, SCENARIO, RUNS = "/certs", "/access/access.json", "/scenario/scenario.yaml", "/runs"
ENVIRONMENT = {**SINGLE_THREADED, "NUMBA_CACHE_DIR": CACHE}


def write(out: Path, target: str, texts: Mapping[str, str], force: bool = False) -> list[str]:
    """Write the texts into a folder; return the files of an earlier rendering for this target that were removed.

    Args:
        out: the folder, made if it is not there.
        target: what it is rendered for; each target has a list of its own.
        texts: by path inside the folder, HOST/FILE or FILE; a host named `..` does not lead out of it.
        force: overwrite what no rendering wrote, or what was changed since.

    Raises:
        RunError: it cannot be written, a path leads out of it, or a file in the way is somebody's.
    """
    root, record = out.resolve(), out / listing(target)
    for name in texts:
        if not _inside(root, name):
            raise RunError(f"{name}: leads out of {out}; rename that host in the inventory")
    former = _read(record, out)
    if not force:
        _refuse_changed(root, former, texts)
    stale = _stale(root, former, texts)
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
    names = [name for name in former if name not in texts and _inside(root, name) and (root / name).is_file()]
    for name in names:
        if not _is(root / name, former[name]):
            raise RunError(
                f"{root / name}: an earlier rendering wrote it and it was changed since; "
                "remove it, or give --out another folder"
            )
    return names


def _refuse_changed(root: Path, former: Mapping[str, str], texts: Mapping[str, str]) -> None:
    """Refuse to overwrite what is not as an earlier rendering wrote it, nor as this one would."""
    for name, text in texts.items():
        path, known = root / name, (former.get(name, ""), _digest(text.encode()))
        if path.exists() and not any(_is(path, digest) for digest in known):
            raise RunError(
                f"{path}: no rendering wrote it as it is; give --out another folder, or --force to replace it"
            )


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


def document(plain: Any, remarks: Sequence[str] = ()) -> str:
    """Return one YAML document; the same content gives the same text."""
    head = "".join(f"# {line}\n" for line in remarks)
    return head + yaml.dump(plain, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=1000)


def documents(plain: Sequence[Any], remarks: Sequence[str] = ()) -> str:
    """Return several YAML documents in one text."""
    head = "".join(f"# {line}\n" for line in remarks)
    return head + "---\n".join(document(one) for one in plain)


class _Dumper(yaml.SafeDumper):
    """Keeps lines of a text as lines, and writes the same list twice rather than as an alias."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    style = "|" if "\n" in text else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _text)


def dockerfile(extras: Sequence[str]) -> str:
    """Return the Dockerfile of an image with these extras; the wheel is to be beside it."""
    wanted = f"[{','.join(extras)}]" if extras else ""
    return f"""\
# Wants {WHEEL} beside it: pip wheel --no-deps -w FOLDER CHECKOUT
FROM {BASE}
COPY {WHEEL} /tmp/
RUN pip install --no-cache-dir "/tmp/{WHEEL}{wanted}" \\
    && rm /tmp/{WHEEL} \\
    && install -d -m 1777 {CACHE} {RUNS}
USER {USER}:{USER}
WORKDIR /tmp
ENTRYPOINT ["python"]
"""


def unused(placed: InventoryFile, host: str) -> list[str]:
    """Return a remark on the fields of a host that containers do not use."""
    described = placed.inventory.hosts[host]
    defaults = Host(address=described.address)
    names = [name for name in ("folder", "python") if getattr(described, name) != getattr(defaults, name)]
    return [f"hosts.{host}: {', '.join(names)} not used, the image has its own"] if names else []
