"""No text from other processes or hosts reaches a terminal with control codes."""

import ast
import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from zsim.errors import printable
from zsim.runtime.progress import cell
from zsim_deploy.cli import hosts_commands
from zsim_deploy.hosts import control_socket, doctor, status_table
from zsim_deploy.hosts.doctor import CheckResult, HostReport, NetworkPath
from zsim_deploy.hosts.push import PushProgress

ROOT = Path(__file__).parents[3]
PACKAGES = ("zsim", "world", "agents", "deploy")
ANSWERS = {"probe.py", "on_host.py"}  # they print JSON for a launcher, not for a terminal
SHOWING = {"print", "Text"}
SAFE = ("printable", "json.dumps", "cell")  # these remove or escape the codes
NASTY = "\x1b]0;owned\x07\x9b2J\u202e[red]x"
CODES = {"\x1b", "\x07", "\x9b", "\u202e"}


def is_safe(text: ast.expr) -> bool:
    """Return whether a text is a constant, a choice between constants, or free of codes."""
    if isinstance(text, ast.IfExp):
        return is_safe(text.body) and is_safe(text.orelse)
    return isinstance(text, ast.Constant) or (isinstance(text, ast.Call) and ast.unparse(text.func) in SAFE)


def test_every_printed_or_rendered_text_is_free_of_codes() -> None:
    found, unsafe = set(), []
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("*.py") if path.name not in ANSWERS):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in SHOWING and node.args:
                found.add(node.func.id)
                unsafe += [] if is_safe(node.args[0]) else [f"{path.relative_to(ROOT)}:{node.lineno}"]
    assert (found, unsafe) == (SHOWING, [])


def shown(renderable: Any) -> str:
    console = Console(file=io.StringIO(), width=300, force_terminal=True, color_system=None)
    console.print(renderable)
    return console.file.getvalue()  # type: ignore[attr-defined]


FACTS = {"python": NASTY, "zsim": NASTY, "fingerprint": "ab", "cores": 2, "load": 0.1, "governors": [NASTY]}
ROW = {"role": NASTY, "host": NASTY, "pid": 1, "state": NASTY, "lag_ms": None, "messages_per_s": None}


@pytest.mark.parametrize(
    "table",
    [
        doctor.hosts_table({NASTY: HostReport(FACTS, 0.001, 0.0)}),
        doctor.paths_table([NetworkPath(NASTY, NASTY, 7447, {"error": NASTY})]),
        status_table.table([{**ROW, "round_trip_ms": None, "restarts": 0}]),
        cell(NASTY),
    ],
)
def test_tables_of_texts_from_hosts_contain_no_codes(table: Any) -> None:
    text = shown(table)
    assert not CODES & set(text)
    assert printable(NASTY) in text


def test_the_progress_of_a_push_contains_no_codes() -> None:
    console = Console(file=io.StringIO(), width=300)
    PushProgress(console).update("h1", f"waiting for the push of {NASTY}")
    terminal = PushProgress(Console(file=io.StringIO(), force_terminal=True))
    terminal.update("h1", NASTY)
    text = console.file.getvalue() + shown(terminal._table())  # type: ignore[attr-defined]
    assert not CODES & set(text)
    assert text.count(printable(NASTY)) == 2


def test_answers_of_launcher_and_hosts_contain_no_codes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(control_socket, "ask", lambda *_, **__: NASTY)
    hosts_commands.restart("estimator.drone1")
    hosts_commands.move("estimator.drone1", "h2")
    (tmp_path / "hosts.yaml").write_text("hosts: {h1: {address: 192.0.2.1}}\nroles: {world: h1}\n")
    found = CheckResult([], [], [NASTY])
    monkeypatch.setattr(doctor, "check_hosts", lambda *_: found)
    hosts_commands.doctor(hosts=tmp_path / "hosts.yaml")
    output, errors = capsys.readouterr()
    assert not CODES & set(output + errors)
    assert output.count(printable(NASTY)) == 2
    assert printable(NASTY) in errors
