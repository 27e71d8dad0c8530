"""What a run leaves behind, for pages that are open when its console leaves."""

import os
from pathlib import Path

import pytest

from zsim_bridges.console import page_server
from zsim_bridges.console.page_server import RunFiles

PAGE = "a page"


class Clock:
    """Wall time that passes only while somebody sleeps.

    Attributes:
        now_s: the time.
    """

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.at_sleep = lambda: None

    def time(self) -> float:
        return self.now_s

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.at_sleep()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(page_server, "time", made)
    return made


def test_sizes_are_those_of_the_files_that_are_there(tmp_path: Path) -> None:
    files = RunFiles(tmp_path)
    (tmp_path / "run.mcap").write_bytes(b"1234567")
    shown = files.shown(PAGE, has_copies=False)
    assert not shown["leaves"]
    assert {name: each["size_bytes"] for name, each in shown["files"].items()} == {"report": None, "record": 7}
    assert shown["files"]["record"]["path"] == str(tmp_path / "run.mcap")


def test_a_console_that_does_not_know_the_folder_shows_none() -> None:
    assert RunFiles(None).shown(PAGE, has_copies=False) == {"files": {}, "leaves": False}


def test_without_a_page_nobody_is_waited_for(clock: Clock) -> None:
    RunFiles(None).offer(20.0, deserted=lambda: False)
    assert clock.now_s == 1000.0


def test_a_page_is_waited_for_until_it_has_its_copies(clock: Clock, tmp_path: Path) -> None:
    files = RunFiles(tmp_path)
    files.shown(PAGE, has_copies=False)
    clock.at_sleep = lambda: files.shown(PAGE, has_copies=clock.now_s > 1005.0)  # type: ignore[func-returns-value]
    files.offer(20.0, deserted=lambda: False)
    assert 1005.0 < clock.now_s < 1005.0 + 2 * page_server.POLL_S


def test_a_page_that_has_its_copies_keeps_nobody(clock: Clock, tmp_path: Path) -> None:
    files = RunFiles(tmp_path)
    assert not files.shown(PAGE, has_copies=True)["leaves"]
    files.offer(20.0, deserted=lambda: False)
    assert clock.now_s == 1000.0
    assert files.shown(PAGE, has_copies=True)["leaves"]


def test_a_page_that_never_has_its_copies_is_waited_for_so_long(clock: Clock, tmp_path: Path) -> None:
    files = RunFiles(tmp_path)
    files.shown(PAGE, has_copies=False)
    clock.at_sleep = lambda: files.shown(PAGE, has_copies=False)  # type: ignore[func-returns-value]
    files.offer(20.0, deserted=lambda: False)
    assert clock.now_s == pytest.approx(1020.0, abs=page_server.POLL_S)


def test_a_page_that_was_closed_is_waited_for_no_longer_than_its_looks_may_take(clock: Clock, tmp_path: Path) -> None:
    files = RunFiles(tmp_path)
    files.shown(PAGE, has_copies=False)
    files.shown("another page", has_copies=True)
    files.offer(20.0, deserted=lambda: False)
    assert clock.now_s == pytest.approx(1000.0 + page_server.LOOKED_S, abs=2 * page_server.POLL_S)


def test_who_is_no_page_is_not_waited_for(clock: Clock, tmp_path: Path) -> None:
    files = RunFiles(tmp_path)
    files.shown("", has_copies=False)
    files.offer(20.0, deserted=lambda: False)
    assert clock.now_s == 1000.0


def test_the_pages_that_are_known_have_a_bound(clock: Clock, tmp_path: Path) -> None:
    files = RunFiles(tmp_path)
    for number in range(10 * page_server.LOOKS_MAX):
        files.shown(f"page {number}", has_copies=False)
    assert len(files._looked_s) == page_server.LOOKS_MAX


def test_who_is_deserted_waits_for_no_page(clock: Clock, tmp_path: Path) -> None:
    files = RunFiles(tmp_path)
    files.shown(PAGE, has_copies=False)
    files.offer(20.0, deserted=lambda: clock.now_s > 1001.0)
    assert clock.now_s == pytest.approx(1001.0, abs=2 * page_server.POLL_S)


def test_a_report_of_another_run_in_the_folder_is_not_shown(tmp_path: Path) -> None:
    report = tmp_path / "report.html"
    report.write_text("of another run")
    os.utime(report, (1.0, 1.0))
    files = RunFiles(tmp_path)
    assert files.shown("", has_copies=False)["files"]["report"]["size_bytes"] is None
    report.write_text("of this run")
    assert files.shown("", has_copies=False)["files"]["report"]["size_bytes"] == len("of this run")
