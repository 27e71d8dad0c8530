"""What a run puts on each host; how `zsim up` ends and fetches its record; remote processes over a fake link."""

import asyncio
import errno
import io
import os
import re
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from local_host import LocalHost
from refused import has_terms, refused
from rich.console import Console

from zsim.errors import HostsError, RunError
from zsim.scenario import scenario_file
from zsim_api.run_folder import Launch
from zsim_deploy import certificates, inventory
from zsim_deploy.cli import hosts_commands
from zsim_deploy.hosts import host_run as module
from zsim_deploy.hosts.control_socket import ControlSocket
from zsim_deploy.hosts.host_link import EventLoopThread
from zsim_deploy.hosts.host_run import LOST, HostPlan, HostRun, ProcessLog, RemoteProcess, _refuse_unless_able
from zsim_deploy.hosts.status_table import StatusTable
from zsim_deploy.launch.supervisor import UNREAD, Outcome
from zsim_deploy.roles.closed_output import CLOSED

SCENARIO = """
name: pair
duration_s: 1
drones: [{name: drone1, position_m: [0, 0, 0]}, {name: -d2, position_m: [3, 0, 0]}]
processes: {expect: [estimator.drone1, estimator.-d2, my.drone1]}
"""
HOSTS = {
    "hosts": {
        "h1": {"address": "127.0.0.1", "port": 1, "folder": "/z"},
        "h2": {"address": "10.0.0.2"},
        "h3": {"address": "10.0.0.3"},
    },
    "roles": {"world": "h1", "estimator.*": "h1", "my.*": "h2"},
    "routers": {"field": {"host": "h1"}},
}


@pytest.fixture
def paths(tmp_path: Path) -> tuple[Path, Path]:
    scenario, hosts = tmp_path / "pair.yaml", tmp_path / "hosts.yaml"
    scenario.write_text(SCENARIO)
    hosts.write_text(yaml.safe_dump(HOSTS))
    return scenario, hosts


@pytest.fixture
def plan(paths: tuple[Path, Path]) -> HostPlan:
    scenario, hosts = paths
    return HostPlan(inventory.load(hosts), scenario_file.load(scenario), "abc", ["--rate", "4"])


def test_a_plan_lists_processes_hosts_and_ports(plan: HostPlan) -> None:
    assert list(plan.processes) == ["router.field", "world", "recorder", "estimator.drone1", "estimator.-d2"]
    assert plan.hosts() == ["h1"]
    assert (sorted(plan.ports("h1")), plan.ports("h3")) == ([7447, 7448], [])
    (remark,) = plan.remarks
    assert has_terms(remark, "my.drone1", "h2")


def test_a_command_line_has_the_endpoint_identity_and_options(plan: HostPlan) -> None:
    reach = ["--connect", "tls/127.0.0.1:7447", "--federation", "zsim", "--host", "h1"]
    tls = ["--tls", "/z/runs/abc/identity/estimator.-d2"]
    assert plan.arguments("estimator.-d2") == ["estimator", "--launched", "abc", *reach, *tls, "--", "-d2"]
    world = plan.arguments("world")
    assert world[-2:] == ["--", "/z/runs/abc/scenario.yaml"]
    assert world[world.index("--access") + 1] == "/z/runs/abc/identity/world/access.json"
    assert world[world.index("--rate") + 1] == "4"


def test_a_move_changes_one_host_and_keeps_the_others(plan: HostPlan) -> None:
    moved = plan.moved("estimator.drone1", "h3").moved("estimator.-d2", "h2")
    assert {name: moved.host(name) for name in moved.processes} == {
        "router.field": "h1",
        "world": "h1",
        "recorder": "h1",
        "estimator.drone1": "h3",
        "estimator.-d2": "h2",
    }
    assert "~/.zsim/runs/abc/identity/estimator.drone1" in moved.arguments("estimator.drone1")
    assert plan.host("estimator.drone1") == "h1"


def test_a_host_gets_its_files_and_a_missing_certificate_is_reported(plan: HostPlan, tmp_path: Path) -> None:
    for name in plan.processes:
        for file in ("ca.pem", "certificate.pem", "key.pem"):
            path = tmp_path / "certs" / "h1" / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{file} of {name}")
    for name in ("world", "router.field"):
        (tmp_path / "certs" / "h1" / f"{name}.access.json").write_text("{}")
    found = plan.files("h1")
    assert len(found) == 3 * len(plan.processes) + 2 + 1
    assert found["identity/estimator.-d2/key.pem"] == b"key.pem of estimator.-d2"
    assert b"name: pair" in found["scenario.yaml"]
    assert plan.files("h3") == {}
    certificate = "certs/h3/estimator.drone1/ca.pem"
    with refused(HostsError, certificate, "read", "zsim certs init", "hosts.yaml", "--scenario FILE") as error:
        plan.moved("estimator.drone1", "h3").identity("estimator.drone1")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("given", [None, "out", "there"])
def test_a_refused_start_leaves_no_new_folder(
    paths: tuple[Path, Path], given: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing listens on port 1. A folder that existed before is kept."""
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    out: Any = Path(given) if given else None
    with refused(HostsError, "h1", "ssh", "127.0.0.1", "port 1", "reached"):
        hosts_commands.up(scenario=paths[0], hosts=paths[1], out=out, insecure=True)
    left = {path.name for path in (*tmp_path.glob("runs/*"), *tmp_path.glob("out"), *tmp_path.glob("there"))}
    assert left == {"there"}


def test_a_federation_already_up_is_refused_before_any_host_is_contacted(
    paths: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with (
        ControlSocket("zsim", {}),
        refused(RunError, "'zsim'", "already up", "--set federation=NAME"),
    ):
        hosts_commands.up(scenario=paths[0], hosts=paths[1], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with ControlSocket("zsim", {}), refused(HostsError, "h1", "reached"):
        hosts_commands.up(
            scenario=paths[0], hosts=paths[1], out=tmp_path / "out", set_=["federation=other"], insecure=True
        )


def test_bad_certificates_are_reported_before_any_host_is_contacted(
    paths: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with refused(HostsError, "certs", "no certificates", "zsim certs init"):
        hosts_commands.up(scenario=paths[0], hosts=paths[1], out=tmp_path / "out")
    now, placed = datetime.now(UTC) - timedelta(days=10), inventory.load(paths[1])
    folder = placed.folder / "certs"
    wanted, access = certificates.enrolment(placed, scenario_file.load(paths[0]))
    signer = certificates.authority(folder, now)
    for each in wanted:
        certificates.issue(folder, signer, each, now, days=1.0)
    for host, name, _ in access:
        (folder / host / f"{name}.access.json").write_text("{}")
    with refused(HostsError, "expired", "router.field", "h1", "estimator.drone1", "--renew"):
        hosts_commands.up(scenario=paths[0], hosts=paths[1], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_insecure_processes_use_tcp_and_need_no_certificates(paths: tuple[Path, Path]) -> None:
    placed = inventory.insecure(inventory.load(paths[1]))
    plan = HostPlan(placed, scenario_file.load(paths[0]), "abc")
    assert "--insecure" in plan.arguments("world")
    assert "tcp/127.0.0.1:7447" in plan.arguments("estimator.drone1")
    assert (plan.files("h1").keys(), plan.certificate_faults(datetime.now(UTC))) == ({"scenario.yaml"}, [])


def test_a_host_whose_python_lacks_the_agents_gets_no_role(tmp_path: Path) -> None:
    bare = tmp_path / "python"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -I -S "$@"\n')
    bare.chmod(0o755)
    link: Any = LocalHost(folder=str(tmp_path))
    says = r"^h1: import zsim_agents.estimation.estimator failed: ModuleNotFoundError.*; controller.main cannot run on h1; install"
    with pytest.raises(HostsError, match=says):
        asyncio.run(_refuse_unless_able(link, str(bare), "controller.main"))
    asyncio.run(_refuse_unless_able(link, sys.executable, "controller.main"))


ONE_DRONE = "name: one\nduration_s: 1\ndrones: [{name: drone1, position_m: [0, 0, 0]}]\nprocesses: {expect: []}\n"
ONE_HOST = {
    "hosts": {"h1": {"address": "10.0.0.1", "user": "pi"}},
    "roles": {"world": "h1"},
    "security": {"insecure": True},
}
INTERRUPTED = Outcome("interrupted", interrupted=True)
AT = r"h1:~/\.zsim/runs/abc/run\.mcap \(fetch it with `scp pi@10\.0\.0\.1:\.zsim/runs/abc/run\.mcap \.`\)"


class Said(StatusTable):
    """A status table without a terminal."""

    def __init__(self) -> None:
        super().__init__(1.0, Console(file=io.StringIO(), width=500))

    def text(self) -> str:
        assert isinstance(self.console.file, io.StringIO)
        return self.console.file.getvalue()


@pytest.fixture
def board() -> Said:
    return Said()


@pytest.fixture
def up(board: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a run whose host is never contacted."""
    scenario, hosts = tmp_path / "one.yaml", tmp_path / "hosts.yaml"
    scenario.write_text(ONE_DRONE)
    hosts.write_text(yaml.safe_dump(ONE_HOST))
    found = HostRun(scenario_file.load(scenario), inventory.load(hosts), tmp_path / "out", Launch("abc"), board)
    monkeypatch.setattr(found._links, "listen", lambda: None)
    yield found
    found._loop.close()


def ends_as(up: Any, outcome: Any, fetched: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a run's processes, and the fetching of its record, end with the given results or exceptions."""

    def result_of(found: Any) -> Any:
        if isinstance(found, BaseException):
            raise found
        return found

    async def fetch(*_: Any) -> bool:
        return result_of(fetched)

    monkeypatch.setattr(up._supervisor, "run", lambda _: result_of(outcome))
    monkeypatch.setattr(module, "fetch", fetch)


@pytest.mark.parametrize("early", [True, False], ids=["processes end", "record is fetched"])
def test_a_second_ctrl_c_ends_at_once_and_shows_where_the_record_is(
    up: Any, board: Said, monkeypatch: pytest.MonkeyPatch, early: bool
) -> None:
    def interrupt(work: Any) -> None:
        work.close()
        raise KeyboardInterrupt

    ends_as(up, KeyboardInterrupt() if early else INTERRUPTED, True, monkeypatch)
    with monkeypatch.context() as patched:
        patched.setattr(up._loop, "call", interrupt)
        with pytest.raises(KeyboardInterrupt):
            up._fly()
    assert re.search(rf"not fetched.* {AT}", board.text())
    assert has_terms(board.text(), "fetching") is not early


def test_a_run_ended_before_its_start_has_no_record(up: Any, board: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    ends_as(up, INTERRUPTED, False, monkeypatch)
    assert up._fly() == INTERRUPTED
    assert has_terms(board.text(), "nothing", "recorded")
    assert not up._record_stays


def test_a_record_that_cannot_be_fetched_fails_the_run(up: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    ends_as(up, Outcome("duration"), HostsError("h1: gone"), monkeypatch)
    outcome = up._fly()
    assert outcome.failed
    assert has_terms(outcome.reason, "record", "h1: gone", "h1:…")
    assert up._record_stays


@pytest.mark.parametrize("reason", [CLOSED, UNREAD])
def test_a_run_whose_output_is_closed_ends_and_then_prints_lines(up: Any, board: Said, reason: str) -> None:
    with board:
        up._signals.reason = reason
        up._signals._hung_up()
        up._poll()
        outcome = up._supervisor.run()
        assert (outcome.reason, outcome.interrupted) == (reason, True)
        board.say("fetching")
    assert board.text() == "fetching\n"


FILES = {"identity/estimator.d1/key.pem": b"secret"}
PATIENCE_S = 120.0  # the timeout of a test that would otherwise wait for ever


class Stream:
    """The output of a process."""

    def __init__(self, *lines: str) -> None:
        self._lines = list(lines)

    def __aiter__(self) -> "Stream":
        return self

    async def __anext__(self) -> str:
        if not self._lines:
            raise StopAsyncIteration
        return self._lines.pop(0)

    def write(self, _: str) -> None: ...


class Process:
    """A process that prints some lines and ends."""

    exit_signal, exit_status = None, 0

    def __init__(self, *output: str, complains: tuple[str, ...] = ()) -> None:
        self.stdin, self.stdout, self.stderr = Stream(), Stream(*output), Stream(*complains)

    async def wait(self) -> "Process":
        return self

    async def __aenter__(self) -> "Process":
        return self

    async def __aexit__(self, *_: object) -> None: ...


class Link:
    """A link to a host on which every command starts the given process."""

    name = "h1"

    def __init__(self, then: Process | Exception | None) -> None:
        self._then = then
        self.brought: list[tuple[str, dict[str, bytes]]] = []

    async def put_files(self, folder: str, files: dict[str, bytes], *_: Any, retry: bool) -> None:
        assert retry
        self.brought.append((folder, files))

    @asynccontextmanager
    async def channel(self, retry: bool = False) -> AsyncIterator["Link"]:
        assert retry
        yield self

    def create_process(self, *_: Any, **__: Any) -> Process:
        assert isinstance(self._then, Process)
        return self._then


class Absent(Link):
    """A link to an absent host, which fails with the given fault or waits for ever."""

    @asynccontextmanager
    async def channel(self, retry: bool = False) -> AsyncIterator[Link]:
        if isinstance(self._then, Exception):
            raise self._then
        await asyncio.Event().wait()
        yield self


Start = Callable[..., RemoteProcess]


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Start]:
    loop = EventLoopThread()

    def start(link: Any, on_line: Any = None, log: ProcessLog | None = None) -> RemoteProcess:
        log = log or ProcessLog(tmp_path / "estimator.d1.log", lambda text: None)
        remote = RemoteProcess("estimator.d1", ["python3", "estimator"], link, loop, log, on_line, ("/z/runs/1", FILES))
        remote.start()
        return remote

    yield start
    loop.close()


def test_output_is_kept_and_a_greeting_is_not_taken_for_the_pid(started: Start, tmp_path: Path) -> None:
    output: list[str] = []
    link = Link(Process("Welcome to h1\n", "zsim-pid 77\n", '{"say": 1}\n', complains=("here\n", "\n")))
    remote = started(link, output.append)
    assert remote.wait(PATIENCE_S)
    assert (remote.pid, remote.code, output) == (77, 0, ['{"say": 1}\n'])
    assert remote.last_log_line() == "here"
    assert (tmp_path / "estimator.d1.log").read_text() == "here\n\n"


def test_a_broken_link_or_a_failing_line_handler_ends_a_remote_process(started: Start) -> None:
    def fail(line: str) -> None:
        raise TypeError("not iterable")

    for link, on_line, terms in (
        (Link(Process("zsim-pid 77\n", "1234\n")), fail, ("launcher", "TypeError('not iterable')")),
        (Absent(HostsError("h1: gone")), None, ("connection", "h1", "h1: gone")),
    ):
        remote = started(link, on_line)
        assert remote.wait(PATIENCE_S)
        assert (remote.code, remote.outcome()) == (LOST, remote.last_log_line())
        assert has_terms(remote.outcome(), *terms)


def test_an_unwritable_log_is_reported_once_and_the_process_continues(started: Start, tmp_path: Path) -> None:
    output: list[str] = []
    log = ProcessLog(tmp_path / "gone" / "estimator.d1.log", output.append)
    remote = started(Link(Process("zsim-pid 77\n", complains=("one\n", "two\n"))), log=log)
    assert remote.wait(PATIENCE_S)
    assert (remote.code, remote.last_log_line()) == (0, "two")
    (line,) = output
    assert has_terms(line, "gone/estimator.d1.log", "written", os.strerror(errno.ENOENT))


def test_a_process_waiting_for_its_host_can_be_killed(started: Start) -> None:
    remote = started(Absent(None))
    assert remote.state == "starting"
    remote.kill()
    assert remote.wait(PATIENCE_S)
    assert remote.code == LOST


def test_a_restarted_process_is_sent_its_files_again(started: Start) -> None:
    link = Link(Process("zsim-pid 77\n"))
    remote = started(link)
    assert remote.wait(PATIENCE_S)
    assert link.brought == []
    remote.start()
    assert remote.wait(PATIENCE_S)
    assert link.brought == [("/z/runs/1", FILES)]
