"""The file of a bundle: identical bytes for identical content, and refusal of modified files."""

import stat
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from refused import refused

from zsim.errors import RunError
from zsim_analysis.bundle import bundle_file
from zsim_analysis.bundle.bundle_file import (
    FORMAT,
    LOCK,
    MANIFEST,
    README,
    SCENARIO,
    Manifest,
    open_bundle,
    pins_of,
    write_bundle,
)

MEMBERS: dict[str, Any] = {
    README: b"# one\n",
    SCENARIO: b"name: one\n",
    LOCK: b"numpy==2.4.6\n",
    "figures/a.csv": b"1,2\n",
}
BLANK = Manifest(
    format=FORMAT, zsim="1", commit="", name="one", seed=3, duration_s=1.0, scenario_sha256="", truth_sha256="",
    outputs={}, until_ns=0, own_code=[], needs=[], not_run_again="", fingerprints=[], machine={}, files={},
)  # fmt: skip


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return write_bundle(tmp_path / "one.zsim", BLANK, MEMBERS, force=False).path


def rewritten(path: Path, change: "Change") -> Path:
    """Rewrite an archive with members changed or, if None, omitted."""
    other = path.with_name("other.zsim")
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(other, "w") as target:
        for entry in source.infolist():
            if (made := change(entry, source.read(entry))) is not None:
                target.writestr(*made)
    return other


def added(path: Path, *names: str, mode: int) -> Path:
    with zipfile.ZipFile(path, "a") as archive:
        for name in names:
            entry = zipfile.ZipInfo(name)
            entry.external_attr = mode << 16
            archive.writestr(entry, b"x")
    return path


def test_a_bundle_is_reproducible_and_contains_its_members(bundle: Path, tmp_path: Path) -> None:
    again = write_bundle(tmp_path / "again.zsim", BLANK, dict(reversed(MEMBERS.items())), force=False)
    assert again.path.read_bytes() == bundle.read_bytes()
    assert zipfile.ZipFile(bundle).testzip() is None
    with open_bundle(bundle) as (manifest, folder):
        assert set(manifest.files) == set(MEMBERS)
        assert (folder / "figures/a.csv").read_bytes() == MEMBERS["figures/a.csv"]
    assert not folder.exists()
    with refused(RunError, "one.zsim", "--force", "--out"):
        write_bundle(bundle, BLANK, MEMBERS, force=False)


Change = Callable[[zipfile.ZipInfo, bytes], tuple[zipfile.ZipInfo, bytes] | None]


def of(name: str, change: Change) -> Change:
    """Change one member."""
    return lambda entry, content: change(entry, content) if entry.filename == name else (entry, content)


def with_content(entry: zipfile.ZipInfo, content: bytes) -> tuple[zipfile.ZipInfo, bytes]:
    return entry, content.replace(b"one", b"two").replace(b"2\n", b"3\n").replace(b".6\n", b".7\n")


def with_field(field: str) -> Change:
    return lambda entry, content: (entry, msgspec.json.encode({**msgspec.json.decode(content), field: ["x"]}))


def in_capitals(entry: zipfile.ZipInfo, content: bytes) -> tuple[zipfile.ZipInfo, bytes]:
    entry.filename = entry.filename.upper()
    return entry, content


def squeezed(entry: zipfile.ZipInfo, content: bytes) -> tuple[zipfile.ZipInfo, bytes]:
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry, content


@pytest.mark.parametrize(
    ("change", "terms"),
    [
        *((of(name, with_content), ("changed", name)) for name in sorted([*MEMBERS, MANIFEST])),
        *((of(MANIFEST, with_field(name)), ("other.zsim", MANIFEST)) for name in ("format", "files", "seed", "more")),
        (of(MANIFEST, in_capitals), ("other.zsim", MANIFEST)),
        (of(LOCK, lambda *_: None), ("changed", LOCK, "missing", MANIFEST)),
        (squeezed, ("member", "compressed", "stored")),
    ],
)
def test_a_changed_member_is_refused(bundle: Path, change: Change, terms: tuple[str, ...]) -> None:
    with refused(RunError, *terms), open_bundle(rewritten(bundle, change)):
        pass


ELSEWHERE = ("../x", "/x", "a/../../x", "a\\..\\x", "C:/x", "a//x", ".hidden", "a/", "x" * 300, "a\nb")
MANY = bundle_file.MEMBERS_MAX + 1


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    ("names", "mode", "terms"),
    [
        *(([name], stat.S_IFREG, ("member", "name")) for name in ELSEWHERE),
        *((["link"], kind, ("member", "'link'", "plain")) for kind in (stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR)),
        *(([name], stat.S_IFREG, ("member", f"'{name}'", "twice")) for name in (SCENARIO, SCENARIO.upper())),
        (["more.txt"], stat.S_IFREG, ("changed", "more.txt", "not", MANIFEST)),
        ([f"m{number}" for number in range(MANY)], stat.S_IFREG, ("members", str(bundle_file.MEMBERS_MAX))),
    ],
)
def test_an_additional_member_is_refused_and_not_extracted(
    bundle: Path, tmp_path: Path, names: list[str], mode: int, terms: tuple[str, ...]
) -> None:
    with refused(RunError, *terms), open_bundle(added(bundle, *names, mode=mode | 0o644)):
        pass
    assert {path.name for path in tmp_path.iterdir()} == {"one.zsim"}


@pytest.mark.parametrize("cut", [0, 10, 500, -30, -1])
def test_a_truncated_or_empty_file_is_refused(bundle: Path, cut: int) -> None:
    bundle.write_bytes(bundle.read_bytes()[:cut])
    with refused(RunError, "one.zsim", "bundle"), open_bundle(bundle):
        pass


def test_any_changed_byte_of_content_is_refused_in_one_line(bundle: Path) -> None:
    whole = bundle.read_bytes()
    accepted, lines = list[int](), list[str]()
    for place in range(0, len(whole), 7):
        bundle.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            with open_bundle(bundle) as (manifest, folder):
                held = {name: (folder / name).read_bytes() for name in manifest.files}
            accepted.append(place)
            assert held == MEMBERS, place  # a date or another archive field that does not affect the content
        except RunError as error:
            lines.append(str(error))
    assert len(accepted) < len(lines) / 4
    assert not any("\n" in line for line in lines)


@pytest.mark.parametrize(
    "line", ["--index-url=x", "numpy", "numpy>=2", "numpy @ file:///x", "-e .", "numpy==2 ; x", "../x==1"]
)
def test_a_lock_with_anything_but_pinned_versions_is_refused(line: str) -> None:
    assert pins_of("# of 2026\nnumpy==2.4.6\n\ntyping-extensions==4.1\n", "lock") == [
        "numpy==2.4.6",
        "typing-extensions==4.1",
    ]
    with refused(RunError, "lock", "NAME==VERSION"):
        pins_of(f"numpy==2.4.6\n{line}\n", "lock")
