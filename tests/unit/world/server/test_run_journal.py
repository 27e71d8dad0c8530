"""The journal of a run: what a world finds on disk, and that it continues without publishing anything twice."""

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
from fake_link import FakeLink
from small_world import GATE_NS, small_world

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Mode
from zsim.contract.run_messages import Event
from zsim.errors import RunError
from zsim.runtime.membership import HealthMeter
from zsim.scenario.roles import WORLD
from zsim_world.run.inputs import Advanced, Called, Entry, Published, Run, Taken
from zsim_world.server import run_journal
from zsim_world.server.run_journal import RunJournal, journaled_run
from zsim_world.server.world_process import WorldProcess

NEXT_NS = run_journal.CHECKPOINT_NS
RUN = ("run1", "a" * 64)


def journal(folder: Path, **options: Any) -> RunJournal:
    return RunJournal(folder, *RUN, **options)


def written(folder: Path, checkpoints: int = 0, **options: Any) -> list[Entry]:
    """Write a journal with two frames before each checkpoint and after the last; return the entries."""
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


def test_without_a_checkpoint_a_run_continues_from_its_start(tmp_path: Path):
    entries = written(tmp_path)
    again = journal(tmp_path)
    assert again.open() == (None, 0)
    assert list(again.truth(0)) == []
    assert list(again.entries()) == entries
    again.close()


@pytest.mark.parametrize(("checkpoints", "first", "truth"), [(1, 0, b""), (2, 1, b"0"), (5, 4, b"0123")])
def test_a_run_continues_from_the_last_checkpoint_but_one(tmp_path: Path, checkpoints: int, first: int, truth: bytes):
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
def test_an_incomplete_last_frame_is_dropped(tmp_path: Path, cut: int):
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
def test_an_incomplete_checkpoint_is_skipped(tmp_path: Path, damage: str):
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


def test_a_journal_folder_serves_only_one_world(tmp_path: Path):
    first, second = journal(tmp_path), journal(tmp_path)
    first.open()
    with pytest.raises(RunError, match="another world"):
        second.open()
    first.close()
    second.close()


def test_a_full_disk_ends_the_journal_but_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
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


def test_a_journal_without_a_folder_does_nothing():
    kept = RunJournal(None)
    assert kept.open() is None
    kept.note(Advanced(1, False))
    kept.commit()
    assert not kept.is_due(2**60, 2**60)
    kept.close()
    kept.remove()


def test_a_finished_run_leaves_no_journal(tmp_path: Path):
    written(tmp_path / "journal", 2)
    kept = journal(tmp_path / "journal")
    kept.open()
    kept.close()
    kept.remove()
    assert list(tmp_path.iterdir()) == []


GATES = 600


class AtOnce:
    """An executor like `ThreadPoolExecutor` that works at once, so that no flight overtakes the disk."""

    def __init__(self, *_: Any) -> None: ...

    def submit(self, act: Callable[..., None], *arguments: Any) -> Future[None]:
        act(*arguments)
        done: Future[None] = Future()
        done.set_result(None)
        return done

    def shutdown(self, *_: Any, **__: Any) -> None: ...


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Create checkpoints often enough for each part of these short flights to have some."""
    monkeypatch.setattr(run_journal, "ThreadPoolExecutor", AtOnce)
    monkeypatch.setattr(run_journal, "CHECKPOINT_NS", 1_000_000_000)
    monkeypatch.setattr(run_journal, "CHECKPOINT_WALL_NS", 0)


def fly(folder: Path | None, until: int = GATES + 1, drones: int = 1) -> FakeLink:
    """Run a world until a gate; d1 is commanded to take off before the first gate."""
    made, link = small_world(drones=drones, duration_s=GATES * GATE_NS / 1e9), FakeLink()
    link.deliver(keys.command("d1", "mode"), Mode(0, 0, "somebody", "takeoff"))
    journal = RunJournal(folder, "run1", "a" * 64)
    ended = lambda: "enough" if made.now_ns >= until * GATE_NS else None  # noqa: E731
    WorldProcess(link, made, ended, journal=journal).run()  # type: ignore[arg-type]
    return link


def end(link: FakeLink) -> dict[str, Any]:
    return next(event for event in _events(link) if event.kind == "end").data


def _events(link: FakeLink) -> list[Event]:
    return link.published_on(keys.EVENT)


def _drone(link: FakeLink) -> list[tuple[str, bytes]]:
    return [(key, payload) for key, payload in link.published if key.startswith("drone/") and "/cmd/" not in key]


@pytest.mark.usefixtures("often")
def test_a_world_continues_where_another_one_ended(tmp_path: Path):
    whole = fly(None)
    parts = [fly(tmp_path / "journal", until) for until in (40, 290, 560, GATES + 1)]
    assert [end(part)["last_ns"] // GATE_NS for part in parts] == [40, 290, 560, GATES]
    assert [pair for part in parts for pair in _drone(part)] == _drone(whole)
    assert end(parts[-1])["truth_sha256"] == end(whole)["truth_sha256"]
    assert next(event.seq for event in _events(parts[-1])) > 0
    assert not (tmp_path / "journal").exists()


@pytest.mark.usefixtures("often")
def test_a_long_flight_continues_from_a_checkpoint(tmp_path: Path):
    fly(tmp_path, 560)
    again = RunJournal(tmp_path, "run1", "a" * 64)
    checkpoint = again.open()
    again.close()
    assert checkpoint is not None
    assert checkpoint.state is not None


@pytest.mark.usefixtures("often")
def test_a_checkpoint_of_another_fleet_is_refused(tmp_path: Path):
    fly(tmp_path, 560)
    with pytest.raises(RunError, match="does not fit"):
        fly(tmp_path, drones=2)


@pytest.mark.parametrize("is_complete", [True, False])
def test_entries_after_an_end_are_kept_only_after_the_last_gate(is_complete: bool):
    """Continuing a run undoes an end before its last gate; its recorder must not receive that end."""
    noted: list[Entry] = []
    run = Run(small_world(), HealthMeter(WORLD), noted.append)
    end = run.world.clock.complete if is_complete else run.world.clock.stop
    end("the launcher is gone")
    run.world.publish_end()
    clock = run.world.clock_message(())
    run.enter(Published(keys.CLOCK, clock.seq, messages.encode(clock)))
    assert clock.state == "stopped"
    assert [type(entry) for entry in noted] == [Published] * is_complete
