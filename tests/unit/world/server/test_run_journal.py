"""The journal of a run on disk: what a world finds there, whatever has become of the files."""

from pathlib import Path
from typing import Any

import pytest

from zsim.errors import RunError
from zsim_world.run.inputs import Advanced, Called, Entry, Taken
from zsim_world.server import run_journal
from zsim_world.server.run_journal import RunJournal, journaled_run

NEXT_NS = run_journal.CHECKPOINT_NS
RUN = ("run1", "a" * 64)


def journal(folder: Path, **options: Any) -> RunJournal:
    return RunJournal(folder, *RUN, **options)


def written(folder: Path, checkpoints: int = 0, **options: Any) -> list[Entry]:
    """Write a journal of two frames before each checkpoint and after the last; return the entries."""
    entries: list[Entry] = []
    kept = journal(folder, **options)
    assert kept.open() is None
    for number in range(checkpoints + 1):
        for name in ("a", "b"):
            new = [
                Taken(number, (f"key/{name}", b"\x00\xff")),
                Advanced(number, name == "b"),
                Called("died", (name, number)),
            ]
            for entry in new:
                kept.note(entry)
            kept.commit()
            entries += new
        kept.keep_truth(memoryview(b"%d" % number))
        if number < checkpoints:
            kept.add_checkpoint({"number": number + 1}, 0, 0)
            wait_written(kept)
    kept.close()
    return entries


def wait_written(kept: RunJournal) -> None:
    while not kept.is_due(2**60, 2**60):
        continue


def test_a_new_journal_starts_a_run(tmp_path: Path):
    kept = journal(tmp_path / "journal")
    assert kept.open() is None
    assert journaled_run(tmp_path / "journal") == "run1"
    assert journaled_run(tmp_path) is None
    kept.close()


def test_a_run_goes_on_from_its_start(tmp_path: Path):
    entries = written(tmp_path)
    again = journal(tmp_path)
    assert again.open() == (None, 0)
    assert list(again.truth(0)) == []
    assert list(again.entries()) == entries
    again.close()


@pytest.mark.parametrize(("checkpoints", "first", "truth"), [(1, 0, b""), (2, 1, b"0"), (5, 4, b"0123")])
def test_a_run_goes_on_from_the_last_checkpoint_but_one(tmp_path: Path, checkpoints: int, first: int, truth: bytes):
    entries = written(tmp_path, checkpoints)
    again = journal(tmp_path)
    found = again.open()
    assert found is not None
    assert found.state == ({"number": first} if first else None)
    assert b"".join(again.truth(found.truth_bytes)) == truth
    assert list(again.entries()) == entries[6 * first :]
    again.close()
    files = {place.name for place in tmp_path.iterdir()}
    assert f"{checkpoints - 3}.entries" not in files
    assert len(files) <= 7


@pytest.mark.parametrize("cut", [1, 7, 8, 9, 30])
def test_what_is_torn_at_the_end_was_never_published(tmp_path: Path, cut: int):
    entries = written(tmp_path)
    place = tmp_path / "0.entries"
    place.write_bytes(place.read_bytes()[:-cut])
    again = journal(tmp_path)
    again.open()
    assert list(again.entries()) == entries[:3]
    again.note(entries[5])
    again.commit()
    again.close()
    third = journal(tmp_path)
    third.open()
    assert list(third.entries()) == [*entries[:3], entries[5]]
    third.close()


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "bit"])
def test_a_checkpoint_that_is_not_whole_is_passed_over(tmp_path: Path, damage: str):
    entries = written(tmp_path, 3)
    place = tmp_path / "3.checkpoint"
    data = bytearray(place.read_bytes())
    data[-3] ^= 1
    {"missing": place.unlink, "empty": lambda: place.write_bytes(b""), "bit": lambda: place.write_bytes(data)}.get(
        damage, lambda: place.write_bytes(data[:-2])
    )()
    again = journal(tmp_path)
    found = again.open()
    assert found is not None
    assert found.state == {"number": 1}
    assert list(again.entries()) == entries[6:]
    again.close()


def test_a_journal_of_another_run_is_refused(tmp_path: Path):
    written(tmp_path)
    other = RunJournal(tmp_path, "run2", RUN[1])
    with pytest.raises(RunError, match="run2"):
        list(other.entries()) if other.open() else None
    other.close()


def test_a_folder_has_one_world(tmp_path: Path):
    first, second = journal(tmp_path), journal(tmp_path)
    first.open()
    with pytest.raises(RunError, match="another world"):
        second.open()
    first.close()
    second.close()


def test_a_full_disk_ends_the_journal_and_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    lines: list[str] = []
    kept = journal(tmp_path, say=lines.append)
    kept.open()

    def full(file: int, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(run_journal.os, "write", full)
        kept.note(Advanced(1, False))
        kept.commit()
        kept.keep_truth(memoryview(b"x"))
    kept.note(Advanced(2, False))
    kept.commit()
    assert len(lines) == 1
    assert "No space left" in lines[0]
    assert not kept.is_due(2**60, 2**60)
    kept.remove()


def test_a_journal_of_nothing_is_quiet():
    kept = RunJournal(None)
    assert kept.open() is None
    kept.note(Advanced(1, False))
    kept.commit()
    assert not kept.is_due(2**60, 2**60)
    kept.close()
    kept.remove()


def test_a_run_that_is_over_leaves_no_journal(tmp_path: Path):
    written(tmp_path / "journal", 2)
    kept = journal(tmp_path / "journal")
    kept.open()
    kept.close()
    kept.remove()
    assert list(tmp_path.iterdir()) == []
