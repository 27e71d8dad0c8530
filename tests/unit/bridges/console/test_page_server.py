"""Who may open a page, and where it is. What a run leaves behind, for pages that are open when its console leaves."""

import os
import socket
from pathlib import Path

import numpy as np
import pytest

from zsim.errors import RunError
from zsim_bridges.console import page_server
from zsim_bridges.console import picture as pic
from zsim_bridges.console.page_server import OPERATOR, VIEWER, ListenAddress, PageRequest, PageTokens, RunFiles

SCENARIOS = Path(__file__).parents[4] / "scenarios"
LEVEL = (1.0, 0.0, 0.0, 0.0)
RNG = np.random.default_rng(4)


def some_attitudes(count: int) -> np.ndarray:
    q = RNG.normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def drones(p_W: np.ndarray, q_WB: np.ndarray, t_ns: int = 0) -> pic.DronePoses:
    names = tuple(f"drone{i}" for i in range(len(p_W)))
    return pic.DronePoses(t_ns, names, p_W, q_WB, np.full((len(p_W), 4), 300.0), np.zeros(3))


def asked(path: str = "/", host: str = "127.0.0.1:8080", origin: str | None = None, token: str = "", **cookies: str):
    return PageRequest(path, host, origin, token, cookies)


def test_on_this_machine_alone_no_token_is_asked_for():
    guard = PageTokens("127.0.0.1", 8080, None, "look")
    assert guard.role_of(asked()) == OPERATOR
    assert guard.role_of(asked("/view/state")) == VIEWER
    assert guard.role_of(asked(origin="http://127.0.0.1:8080")) == OPERATOR


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("evil.example:8080", None),
        ("127.0.0.1:8080", "http://evil.example"),
        ("127.0.0.1:8080", "http://127.0.0.1:9000"),
        ("127.0.0.1:8080", "null"),
        ("[::1:8080", None),
    ],
)
def test_a_stranger_s_page_may_not_ask(host: str, origin: str | None):
    assert PageTokens("127.0.0.1", 8080, None, "look").role_of(asked(host=host, origin=origin)) is None


def test_with_a_token_only_who_shows_it_comes_in():
    guard = PageTokens("0.0.0.0", 8080, "steer", "look")
    assert guard.role_of(asked(host="lab:8080")) is None
    assert guard.role_of(asked(token="wrong")) is None
    assert guard.role_of(asked(token="steer")) == OPERATOR
    assert guard.role_of(asked(zsim_operator_8080="steer")) == OPERATOR
    assert guard.role_of(asked(zsim_operator_8081="steer")) is None
    assert guard.role_of(asked(origin="http://evil.example", zsim_operator_8080="steer")) is None
    assert guard.role_of(asked(origin="http://[bad", zsim_operator_8080="steer")) is None


def test_the_viewers_token_opens_the_viewers_page_alone():
    guard = PageTokens("0.0.0.0", 8080, "steer", "look")
    assert guard.role_of(asked("/view", token="look")) == VIEWER
    assert guard.role_of(asked("/view", zsim_viewer_8080="look")) == VIEWER
    assert guard.role_of(asked("/view", token="steer")) == VIEWER
    assert guard.role_of(asked("/", token="look")) is None
    assert guard.role_of(asked("/", zsim_viewer_8080="look", zsim_operator_8080="look")) is None


def test_others_need_a_token():
    with pytest.raises(RunError, match=r"0\.0\.0\.0"):
        PageTokens("0.0.0.0", 8080, None, "look")
    with pytest.raises(RunError, match="token"):
        PageTokens("127.0.0.1", 8080, "", "look")


def test_a_link_names_this_machine_where_all_may_come():
    assert ListenAddress("127.0.0.1", 8080).url() == "http://127.0.0.1:8080/"
    assert ListenAddress("::1", 8080).url("/view") == "http://[::1]:8080/view"
    for everywhere in ("0.0.0.0", "::"):
        assert ListenAddress(everywhere, 8080).url("/", "a b&#").endswith(":8080/?token=a%20b%26%23")
        address = ListenAddress(everywhere, 8080).url("/", "steer")
        assert address == f"http://{socket.gethostname()}:8080/?token=steer"


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
