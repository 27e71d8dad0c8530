"""How `zsim doctor` judges the reports of hosts; and the probe's round trip and bandwidth over loopback."""

import asyncio
import errno
import io
import itertools
import json
import os
import platform
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, contextmanager, nullcontext
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from local_host import LocalHost, Text
from refused import has_terms, refused

from zsim import __version__
from zsim.errors import HostsError
from zsim_deploy import certificates
from zsim_deploy.certificates import CertificateRequest
from zsim_deploy.hosts import doctor, probe
from zsim_deploy.hosts.doctor import (
    CheckResult,
    HostReport,
    NetworkPath,
    check_hosts,
    compare_reports,
    leftovers,
    path_faults,
    port_faults,
    scp,
)
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.inventory import Host, Inventory, InventoryFile

SOUND = {
    "python": platform.python_version(),
    "zsim": __version__,
    "fingerprint": "a" * 16,
    "parts": {"zsim": __version__, "code": "c0de"},
    "machine": {"libc": "glibc-2.36", "numba": "0.68.1", "scipy": "1.17.1"},
    "cores": 2,
    "load": 0.1,
    "governors": ["performance"],
    "free_bytes": 50_000_000_000,
    "unwritable": None,
}


def report(offset_s: float = 0.0, **changes) -> HostReport:
    return HostReport({**SOUND, **changes}, round_trip_s=0.01, clock_offset_s=offset_s)


def test_hosts_without_a_relevant_difference_have_no_faults_or_warnings():
    """The fingerprint of a host that computes nothing is not compared."""
    router = report(fingerprint="b" * 16, machine={"libc": "glibc-2.31"})
    for other in (report(), router):
        assert compare_reports({"h1": other, "h2": report()}) == ([], [])


@pytest.mark.parametrize(
    ("found", "fault", "warning"),
    [
        (report(zsim="0.0.1"), ("h1", "zsim", "0.0.1", __version__, "zsim push --hosts"), ()),
        (report(unwritable="/opt"), ("h1", "folder", "/opt", "hosts.h1.folder"), ()),
        (report(offset_s=3600.0), (), ("h1", "clock", "+3600.0 s")),
        (report(load=1.9), (), ("h1", "load", "1.9", "2 cores")),
        (report(governors=["powersave"]), (), ("h1", "governor", "powersave")),
        (report(free_bytes=10_000_000), (), ("h1", "0.0 GB", "disk")),
        (report(fingerprint="b" * 16), (), ("fingerprints", "h1 bbbbbbbb", "h2 aaaaaaaa")),
    ],
)
def test_blocking_findings_are_faults_and_the_others_warnings(found, fault, warning):
    faults, warnings = compare_reports({"h1": found, "h2": report()})
    assert [has_terms(line, *fault) for line in faults] == [True] * bool(fault)
    assert [has_terms(line, *warning) for line in warnings] == [True] * bool(warning)


def test_processors_python_and_libraries_may_differ():
    other = report(python="3.14.1", machine={"libc": "musl", "numba": "0.70.0", "scipy": "1.18.0"})
    assert compare_reports({"h1": other, "h2": report()}) == ([], [])


def test_different_code_is_named_part_by_part():
    other = report(fingerprint="b" * 16, parts={"zsim": __version__, "code": "d1ff"})
    faults, (different,) = compare_reports({"h1": other, "h2": report()})
    assert faults == []
    assert has_terms(different, "h1 bbbbbbbb", "code", "h1 d1ff", "h2 c0de")
    assert "zsim:" not in different


def test_a_package_missing_on_one_host_is_named():
    faults, (lacking,) = compare_reports({"h1": report(machine={"libc": "musl", "scipy": "1.17.1"}), "h2": report()})
    assert faults == []
    assert has_terms(lacking, "h1", "numba", "zsim push --hosts")


def test_an_unreachable_path_is_a_fault_and_a_slow_one_a_warning():
    figures = [
        {"error": "Connection refused"},
        {"round_trip_s": 0.1, "bits_per_s": 2e6},
        {"round_trip_s": 0.001, "bits_per_s": 2e9},
    ]
    (fault,), (slow,) = path_faults([NetworkPath(f"h{i}", "h1", 7447, each) for i, each in enumerate(figures, 2)])
    assert has_terms(fault, "h2", "port 7447", "h1", os.strerror(errno.ECONNREFUSED))
    assert has_terms(slow, "h3", "h1", "2.0 Mbit/s")


@pytest.mark.parametrize(
    ("found", "terms"),
    [
        ({"error": os.strerror(errno.EADDRINUSE), "taken": True}, ("in use", "ss -ltnp", "port")),
        ({"error": os.strerror(errno.EACCES), "taken": False}, (os.strerror(errno.EACCES), "another port")),
    ],
)
def test_a_port_that_cannot_be_opened_is_not_called_unreachable(found, terms):
    (path,) = asyncio.run(doctor.network_paths([Silent()], Silent(json.dumps(found) + "\n"), {"h1": "python"}, 7447))
    (line,), warnings = path_faults([path])
    assert has_terms(line, "h1", "port 7447", *terms)
    assert warnings == []


def checked_up(folder: Path) -> CheckResult:
    """Check a host that does not answer, with an inventory in the given folder."""
    host = Host(address="127.0.0.1", port=1, user="nobody")  # tcpmux, on which nothing listens
    return check_hosts(InventoryFile(Inventory(hosts={"h1": host}, roles={"world": "h1"}), folder, "lab.yaml"), None)


def test_bad_certificates_are_faults_and_readable_keys_a_warning(tmp_path):
    (fault, _) = checked_up(tmp_path).faults
    assert has_terms(fault, f"{tmp_path}/certs", "no certificates", f"zsim certs init {tmp_path}/lab.yaml")
    then = datetime.now(UTC) - timedelta(days=60)
    signer = certificates.authority(tmp_path / "certs", then)
    place = certificates.issue(tmp_path / "certs", signer, CertificateRequest("h1", "world", ("127.0.0.1",)), then)
    (place.parent / "world.access.json").touch()
    (place / "key.pem").chmod(0o644)
    found = checked_up(tmp_path)
    (fault, _) = found.faults
    renew = f"zsim certs init {tmp_path}/lab.yaml --scenario FILE --renew"
    assert has_terms(fault, f"{tmp_path}/certs", "expired", "world", "h1", renew)
    (warning,) = found.warnings
    assert has_terms(warning, f"{place}/key.pem", "read")


class Silent(HostLink):
    """A host whose commands print nothing and never end, or print the given lines and end with a code."""

    def __init__(self, out: str | None = None, error: str = "", code: int = 1, python: str | None = None) -> None:
        super().__init__("h1", Host(address="192.0.2.1", python=python), Path())
        self._said = (out, error)
        self._code = code

    @asynccontextmanager
    async def channel(self, retry: bool = False) -> AsyncIterator[Any]:
        yield self

    async def create_process(self, *_command, **_options):
        streams = [asyncio.StreamReader(), asyncio.StreamReader()]
        for stream, text in zip(streams, self._said, strict=True):
            if text is not None:
                stream.feed_data(text.encode())
                stream.feed_eof()
        return SimpleNamespace(
            stdout=Text(streams[0]),
            stderr=Text(streams[1]),
            stdin=io.StringIO(),
            close=lambda: None,
            wait_closed=lambda: asyncio.sleep(0),
            exit_status=self._code,
        )


def test_a_greeting_of_the_login_shell_is_ignored():
    clocks = [json.dumps({"time_ns": 10**18})] * doctor.OFFSET_SAMPLES
    output = "\n".join(["Welcome to lab", "17", json.dumps(SOUND), *clocks, ""])
    assert asyncio.run(doctor.host_report(Silent(output), "python")).facts == SOUND


def test_a_host_that_does_not_answer_is_reported(monkeypatch):
    monkeypatch.setattr(doctor, "ABOUT_S", 0.01)
    monkeypatch.setattr(doctor, "READY_S", 0.01)
    with refused(HostsError, "h1", "no answer", "0.01 s"):
        asyncio.run(doctor.host_report(Silent(), "python"))
    (path,) = asyncio.run(doctor.network_paths([Silent()], Silent(), {"h1": "python"}, 7447))
    assert has_terms(path.measured["error"], "h1", "no answer", "0.01 s")


PUSH = "zsim push --hosts lab.yaml"


@pytest.mark.parametrize(
    ("python", "code", "error", "terms"),
    [
        (None, 1, "/usr/bin/python3: No module named zsim_deploy", ("PYTHON", "no zsim", __version__, PUSH)),
        (None, 127, "bash: line 1: PYTHON: No such file or directory", ("no zsim", ".zsim", PUSH)),
        (None, 1, "PYTHON: Command not found.", ("no zsim", ".zsim", PUSH)),
        ("PYTHON", 1, "PYTHON: No module named zsim_deploy", ("PYTHON", "no zsim", __version__, "install", "hosts.h1.python", PUSH)),
        ("PYTHON", 126, "bash: line 1: PYTHON: Is a directory", ("PYTHON", "not a program", os.strerror(errno.EISDIR), "hosts.h1.python", "install", PUSH)),
        (None, 1, "Traceback (most recent call last):\nMemoryError", ("PYTHON", "code 1", "MemoryError")),
        (None, 0, "", ("PYTHON", "code 0", "nothing")),
    ],
)  # fmt: skip
def test_a_host_without_zsim_is_distinguished_from_other_faults(python, code, error, terms):
    with refused(HostsError, "h1", *terms):
        asyncio.run(doctor.host_report(Silent("Welcome to lab\n", error, code, python), "PYTHON", "lab.yaml"))


def test_the_clock_is_printed_for_each_line(monkeypatch, capsys):
    monkeypatch.setattr(probe.time, "time_ns", itertools.count(5).__next__)
    probe.clock(io.StringIO("\n\n"))
    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == [{"time_ns": 5}, {"time_ns": 6}]


@contextmanager
def served():
    """Let the probe answer one connection and yield its port."""
    with probe.listening(0) as server:

        def answer() -> None:
            with server.accept()[0] as connection:
                probe.answer(connection)

        thread = threading.Thread(target=answer)
        thread.start()
        port = server.getsockname()[1]
        yield port
        socket.create_connection(("127.0.0.1", port)).close()  # ends the wait if the test did not connect
        thread.join()


@pytest.mark.parametrize("address", ["127.0.0.1", "::1"])
def test_the_probe_measures_round_trip_and_bandwidth(address):
    try:
        socket.create_server((address, 0), family=socket.getaddrinfo(address, 0)[0][0]).close()
    except OSError:
        pytest.skip("this machine has no IPv6")
    with served() as port:
        found = probe.reach(address, port)
    assert found["round_trip_s"] > 0.0
    assert found["bits_per_s"] > 1e6


class Slow(nullcontext):
    """A link of the given bandwidth and round trip, on its own clock; it times out like a socket."""

    def __init__(self, bits_per_s: float, round_trip_s: float) -> None:
        super().__init__(self)
        self._bits_per_s, self._round_trip_s, self.now_s = bits_per_s, round_trip_s, 0.0

    def setsockopt(self, *_): ...

    def sendall(self, data: bytes) -> None:
        took_s = 8 * len(data) / self._bits_per_s
        if took_s > probe.TIMEOUT_S:
            raise TimeoutError("timed out")
        self.now_s += took_s

    def recv(self, _size: int) -> bytes:
        self.now_s += self._round_trip_s
        return b"."


@pytest.mark.parametrize("round_trip_s", [0.001, 0.6, 2.0])
@pytest.mark.parametrize("bits_per_s", [50e3, 1e6, 4e6, 30e6, 1e9])
def test_any_link_is_measured_in_time(monkeypatch, bits_per_s, round_trip_s):
    link = Slow(bits_per_s, round_trip_s)
    monkeypatch.setattr(probe.socket, "create_connection", lambda *_: link)
    monkeypatch.setattr(probe.time, "monotonic", lambda: link.now_s)
    found = probe.reach("h1", 7447)
    assert found["round_trip_s"] == pytest.approx(round_trip_s, abs=0.002)
    assert found["bits_per_s"] == pytest.approx(bits_per_s, rel=0.01)
    assert link.now_s < doctor.REACH_S


def test_the_probe_reports_why_nothing_answers():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    assert "refused" in probe.reach("127.0.0.1", port)["error"]


def test_governors_are_read_where_the_system_has_them(tmp_path):
    for cpu, text in (("cpu0", "powersave\n"), ("cpu1", "performance\n")):
        folder = tmp_path / cpu / "cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text(text)
    assert probe.governors(tmp_path) == ["performance", "powersave"]
    assert probe.governors(tmp_path / "nowhere") == []


def test_a_port_in_use_is_reported(capsys):
    with probe.listening(0) as taken:
        probe.serve(taken.getsockname()[1])
    assert json.loads(capsys.readouterr().out) == {"error": os.strerror(errno.EADDRINUSE), "taken": True}


def test_the_nearest_existing_parent_of_a_folder_is_checked(tmp_path, monkeypatch):
    assert probe.unwritable(tmp_path / "zsim" / "runs") is None
    (tmp_path / "file").touch()
    assert has_terms(probe.unwritable(tmp_path / "file" / "zsim"), f"{tmp_path}/file", "not a folder")
    monkeypatch.setattr(probe.os, "access", lambda path, _mode: path != tmp_path)
    assert has_terms(probe.unwritable(tmp_path / "zsim"), str(tmp_path), "written")


WAITS = "import sys; print('there', flush=True); sys.stdin.read()"


def local(folder: Path) -> LocalHost:
    return LocalHost(base=Path("/inventory"), folder=str(folder), user="pi", port=2222)


def run_of(folder: Path, run: str, *files: str) -> None:
    for file in files:
        path = folder / "runs" / run / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_leftover_records_and_keys_are_reported_in_a_line_each(tmp_path: Path) -> None:
    assert asyncio.run(leftovers(local(tmp_path / "not there"), tmp_path)) == []
    folder = tmp_path / "our zsim"
    run_of(folder, "ghi", "scenario.yaml", "identity/world/ca.pem")
    assert asyncio.run(leftovers(local(folder), tmp_path)) == []
    run_of(folder, "abc", "run.mcap")
    run_of(folder, "def", "run.mcap", "identity/world/key.pem")
    records, keys = asyncio.run(leftovers(local(folder), Path("/inventory")))
    assert f"h1:{folder}/runs/abc/run.mcap, h1:{folder}/runs/def/run.mcap;" in records
    assert f"`scp -P 2222 'pi@127.0.0.1:{folder}/runs/abc/run.mcap' .`" in records
    assert f"`rm -r '{folder}/runs/def/identity'`" in keys


@pytest.mark.skipif(shutil.which("ps") is None, reason="needs ps (apt-get install procps)")
def test_files_of_a_current_run_are_not_leftovers(tmp_path: Path) -> None:
    run_of(tmp_path, "abcdef", "run.mcap", "identity/world/key.pem")
    words = [sys.executable, "-c", WAITS, "world", "--launched", "abcdef", "--host", "h1"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout
        process.stdout.readline()
        assert asyncio.run(leftovers(local(tmp_path), tmp_path)) == []
        process.communicate()
    assert len(asyncio.run(leftovers(local(tmp_path), tmp_path))) == 2


def test_the_advised_copy_uses_the_ssh_options_of_the_launcher() -> None:
    host = Host(address="::1", ssh="fe80::1", key="keys/a b", known_hosts="/etc/known")
    command = "scp -i '/lab/keys/a b' -o UserKnownHostsFile=/etc/known '[fe80::1]:.zsim/runs/1/run.mcap' ."
    assert scp(host, Path("/lab"), "~/.zsim/runs/1/run.mcap") == command
    assert scp(Host(address="h1"), Path(), "~/.zsim/runs/1/run.mcap") == "scp h1:.zsim/runs/1/run.mcap ."


def test_a_port_in_use_on_a_host_is_a_fault() -> None:
    link = LocalHost()
    with socket.create_server(("127.0.0.1", 0)) as taken, socket.create_server(("127.0.0.1", 0)) as free:
        numbers = [found.getsockname()[1] for found in (taken, free)]
        free.close()
        (line,) = asyncio.run(port_faults(link, sys.executable, numbers))
    assert has_terms(line, "h1", f"port {numbers[0]}", "in use")
    assert asyncio.run(port_faults(link, sys.executable, numbers[1:])) == []
    assert asyncio.run(port_faults(link, "/no/python", [])) == []
