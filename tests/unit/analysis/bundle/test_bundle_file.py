"""The file of a bundle: the same bytes for the same content, and refused when it is not as it was written."""

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
    opened,
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


def rewritten(path: Path, change: Callable[[zipfile.ZipInfo, bytes], tuple[zipfile.ZipInfo, bytes] | None]) -> Path:
    """Write an archive anew, with members changed or (None) left out."""
    other = path.with_name("other.zsim")
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(other, "w") as target:
        for entry in source.infolist():
            if (made := change(entry, source.read(entry))) is not None:
                target.writestr(*made)
    return other


def added(path: Path, *names: str, mode: int = stat.S_IFREG | 0o644, content: bytes = b"x") -> Path:
    with zipfile.ZipFile(path, "a") as archive:
        for name in names:
            entry = zipfile.ZipInfo(name)
            entry.external_attr = mode << 16
            archive.writestr(entry, content)
    return path


def test_a_bundle_is_the_same_bytes_and_holds_what_was_given(bundle: Path, tmp_path: Path) -> None:
    again = write_bundle(tmp_path / "again.zsim", BLANK, dict(reversed(MEMBERS.items())), force=False)
    assert again.path.read_bytes() == bundle.read_bytes()
    assert zipfile.ZipFile(bundle).testzip() is None
    with opened(bundle) as (manifest, folder):
        assert set(manifest.files) == set(MEMBERS)
        assert (folder / "figures/a.csv").read_bytes() == MEMBERS["figures/a.csv"]
    assert not folder.exists()
    with refused(RunError, "one.zsim", "--force", "--out"):
        write_bundle(bundle, BLANK, MEMBERS, force=False)


@pytest.mark.parametrize(
    "name", ["../x", "/x", "a/../../x", "a\\..\\x", "C:/x", "a//x", ".hidden", "a/", "x" * 300, "a\nb"]
)
def test_a_member_that_would_be_written_elsewhere_is_refused(bundle: Path, tmp_path: Path, name: str) -> None:
    with refused(RunError, "member", "name"), opened(added(bundle, name)):
        pass
    assert {path.name for path in tmp_path.iterdir()} == {"one.zsim"}


@pytest.mark.parametrize("mode", [stat.S_IFLNK | 0o777, stat.S_IFIFO | 0o644, stat.S_IFCHR | 0o644])
def test_a_link_or_a_device_is_refused(bundle: Path, mode: int) -> None:
    with (
        refused(RunError, "member", "'link'", "plain"),
        opened(added(bundle, "link", mode=mode, content=b"/etc/passwd")),
    ):
        pass


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("name", [SCENARIO, SCENARIO.upper()])
def test_a_name_that_is_there_twice_is_refused(bundle: Path, name: str) -> None:
    with refused(RunError, "member", f"'{name}'", "twice"), opened(added(bundle, name)):
        pass


def test_what_is_not_in_the_manifest_and_what_is_missing_are_refused(bundle: Path) -> None:
    left = rewritten(bundle, lambda entry, content: None if entry.filename == LOCK else (entry, content))
    with refused(RunError, "changed", LOCK, "missing", MANIFEST), opened(left):
        pass
    with refused(RunError, "changed", "more.txt", "not", MANIFEST), opened(added(bundle, "more.txt")):
        pass


@pytest.mark.parametrize("name", sorted([*MEMBERS, MANIFEST]))
def test_a_changed_member_is_refused(bundle: Path, name: str) -> None:
    def change(entry: zipfile.ZipInfo, content: bytes) -> tuple[zipfile.ZipInfo, bytes]:
        return entry, content.replace(b"one", b"two").replace(b"2\n", b"3\n").replace(
            b".6\n", b".7\n"
        ) if entry.filename == name else content

    with refused(RunError, "changed", name), opened(rewritten(bundle, change)):
        pass


@pytest.mark.parametrize("field", ["format", "files", "seed", "more"])
def test_a_manifest_that_cannot_be_read_is_refused(bundle: Path, field: str) -> None:
    def change(entry: zipfile.ZipInfo, content: bytes) -> tuple[zipfile.ZipInfo, bytes]:
        if entry.filename == MANIFEST:
            content = msgspec.json.encode({**msgspec.json.decode(content), field: ["x"]})
        return entry, content

    with refused(RunError, "other.zsim", MANIFEST), opened(rewritten(bundle, change)):
        pass


def test_a_manifest_of_another_spelling_is_none(bundle: Path) -> None:
    def change(entry: zipfile.ZipInfo, content: bytes) -> tuple[zipfile.ZipInfo, bytes]:
        if entry.filename == MANIFEST:
            entry.filename = MANIFEST.upper()
        return entry, content

    with refused(RunError, "other.zsim", MANIFEST), opened(rewritten(bundle, change)):
        pass


def test_what_is_compressed_or_larger_than_the_file_is_refused(bundle: Path) -> None:
    def squeezed(entry: zipfile.ZipInfo, content: bytes) -> tuple[zipfile.ZipInfo, bytes]:
        entry.compress_type = zipfile.ZIP_DEFLATED
        return entry, content

    with refused(RunError, "member", "compressed", "stored"), opened(rewritten(bundle, squeezed)):
        pass
    entries = bundle_file.MEMBERS_MAX + 1
    many = added(bundle, *(f"m{number}" for number in range(entries)))
    with refused(RunError, "members", str(bundle_file.MEMBERS_MAX)), opened(many):
        pass


@pytest.mark.parametrize("cut", [0, 10, 500, -30, -1])
def test_a_file_that_is_cut_or_none_is_refused(bundle: Path, cut: int) -> None:
    bundle.write_bytes(bundle.read_bytes()[:cut])
    with refused(RunError, "one.zsim", "bundle"), opened(bundle):
        pass


def test_any_changed_byte_is_refused_in_a_line(bundle: Path) -> None:
    whole = bundle.read_bytes()
    accepted, lines = list[int](), list[str]()
    for place in range(0, len(whole), 7):
        bundle.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            with opened(bundle) as (manifest, folder):
                held = {name: (folder / name).read_bytes() for name in manifest.files}
            accepted.append(place)
            assert held == MEMBERS, place  # a date, or another field of the archive that says nothing of the content
        except RunError as error:
            lines.append(str(error))
    assert len(accepted) < len(lines) / 4
    assert not any("\n" in line for line in lines)


@pytest.mark.parametrize(
    "line", ["--index-url=x", "numpy", "numpy>=2", "numpy @ file:///x", "-e .", "numpy==2 ; x", "../x==1"]
)
def test_a_lock_with_anything_but_versions_is_refused(line: str) -> None:
    assert pins_of("# of 2026\nnumpy==2.4.6\n\ntyping-extensions==4.1\n", "lock") == [
        "numpy==2.4.6",
        "typing-extensions==4.1",
    ]
    with refused(RunError, "lock", "NAME==VERSION"):
        pins_of(f"numpy==2.4.6\n{line}\n", "lock")
