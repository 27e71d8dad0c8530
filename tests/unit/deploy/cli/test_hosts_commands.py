"""`zsim logs`: known roles, and following until the end of the run. `zsim ps`: which processes are shown."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from refused import has_terms, refused

from zsim.errors import RunError
from zsim_deploy.cli import hosts_commands
from zsim_deploy.cli.hosts_commands import logs, ps
from zsim_deploy.hosts.control_socket import ControlSocket

ROLES = ["world", "recorder", "estimator.d1"]


def row(role: str) -> dict[str, object]:
    """Return the row of a process that has not started yet."""
    unknown = dict.fromkeys(("pid", "lag_ms", "messages_per_s", "round_trip_ms"))
    return {"role": role, "host": "h1", "state": "starting", "restarts": 0, **unknown}


class Run:
    """A run that is up until it is ended."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.asked = threading.Event()
        self.is_over = False
        (out / "logs").mkdir(parents=True)
        self.intercom = ControlSocket("zsim", {"where": self._where, "ps": lambda: {"rows": [*map(row, ROLES)]}})

    def _where(self) -> dict[str, object]:
        self.asked.set()
        return {"out": str(self.out), "roles": ROLES}

    def end(self) -> None:
        if not self.is_over:
            self.is_over = True
            self.intercom.close()

    def write(self, text: str) -> None:
        with (self.out / "logs" / "estimator.d1.log").open("a") as log:
            log.write(text)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(hosts_commands, "FOLLOW_S", 0.001)
    made = Run(tmp_path / "out")
    yield made
    made.end()


@pytest.mark.usefixtures("run")
def test_an_unknown_role_is_refused_with_the_known_ones() -> None:
    with refused(RunError, "role", "'nobody'", "world", "recorder", "estimator.d1"):
        logs("nobody", federation="zsim")
    with refused(RunError, "role", "'controller.*'", "world", "recorder", "estimator.d1"):
        ps(["controller.*"], federation="zsim")


def test_a_log_is_printed_and_an_empty_one_is_not_an_error(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    logs("estimator.d1", federation="zsim")
    logs("world", federation="zsim")
    silent, world = capsys.readouterr().err.splitlines()
    assert silent.startswith("estimator.d1 ")
    assert has_terms(world, "zsim up", "record")
    run.write("drone ä\n")
    logs("estimator.d1", federation="zsim")
    assert capsys.readouterr().out == "drone ä\n"


def test_following_a_log_ends_with_the_run_after_its_last_line(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    """The file is created only after following has begun."""
    follower = threading.Thread(target=logs, args=("estimator.d1", True, "zsim"), daemon=True)
    follower.start()
    assert run.asked.wait(120.0)
    run.write("last words\n")
    run.end()
    follower.join(120.0)
    assert not follower.is_alive()
    assert capsys.readouterr().out == "last words\n"


@pytest.mark.usefixtures("run")
@pytest.mark.parametrize(
    ("patterns", "shown"), [(None, ROLES), (["estimator.*"], ["estimator.d1"]), (["wor*", "recorder"], ROLES[:2])]
)
def test_processes_are_selected_by_patterns(
    capsys: pytest.CaptureFixture[str], patterns: list[str] | None, shown: list[str]
) -> None:
    ps(patterns, federation="zsim", as_json=True)
    ps(only=patterns, federation="zsim", as_json=True)
    for printed in capsys.readouterr().out.splitlines():
        assert [entry["role"] for entry in json.loads(printed)["rows"]] == shown
