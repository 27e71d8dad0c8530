"""The lab of hosts itself: SSH to the hosts, cut links, slow links and cleaning up."""

import asyncio
import itertools
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import lab as lab_module
import namespaces
import pytest
from federation import Role, wait_gone
from lab import LAUNCHER, Lab

from zsim.errors import HostsError
from zsim_deploy import inventory
from zsim_deploy.hosts.host_link import HostLink

PORT = 9000
SOON_S, LATE_S = 120.0, 0.4  # timeouts for an expected and for an unexpected answer
BATCH = 50  # datagrams in transit at once; the buffer of any socket holds twice as many


def over_ssh(lab: Lab, command: str) -> dict[str, str]:
    """Run a shell command on each host from the launcher; return each output."""
    placed = inventory.load(lab.inventory({"world": lab.names[0]}))

    async def one(name: str) -> str:
        link = HostLink(name, placed.inventory.hosts[name], placed.folder)
        try:
            return (await link.run(command)).decode().strip()
        finally:
            await link.close()

    async def everyone() -> list[str]:
        return await asyncio.gather(*map(one, lab.names))

    with lab.inside(LAUNCHER):
        return dict(zip(lab.names, asyncio.run(everyone()), strict=True))


def udp(lab: Lab, name: str) -> socket.socket:
    """Return a UDP socket bound in a host's network namespace."""
    with lab.inside(name):
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        made.bind((lab.address(name), PORT))
    return made


class Echo:
    """Measures round trips from one host to another."""

    def __init__(self, here: socket.socket, address: str) -> None:
        self._here, self._there = here, (address, PORT)
        self._count = itertools.count()

    def round_trip_s(self, within_s: float = SOON_S) -> float | None:
        """Return the time that an answer took, or None if none came in time."""
        question = str(next(self._count)).encode()
        self._here.settimeout(within_s)
        start_s = time.monotonic()
        self._here.sendto(question, self._there)
        try:
            while self._here.recv(100) != question:
                continue  # the answer to an earlier question
        except TimeoutError:
            return None
        return time.monotonic() - start_s


@contextmanager
def echo(lab: Lab, name: str, from_: str = LAUNCHER) -> Iterator[Echo]:
    """Let a host echo the datagrams of another."""

    def answer() -> None:
        while (came := there.recvfrom(100))[0] != b"end":
            there.sendto(*came)

    with udp(lab, name) as there, udp(lab, from_) as here:
        thread = threading.Thread(target=answer)
        thread.start()
        try:
            yield Echo(here, lab.address(name))
        finally:
            with udp_end(lab, name) as last:
                last.sendto(b"end", (lab.address(name), PORT))
            thread.join()


def udp_end(lab: Lab, name: str) -> socket.socket:
    """Return a UDP socket on the host itself, whose loopback is never cut."""
    with lab.inside(name):
        return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)


def test_a_command_runs_on_each_host_over_ssh(lab: Lab) -> None:
    assert over_ssh(lab, "echo $ZSIM_LAB_HOST") == {name: name for name in lab.names}
    addresses = over_ssh(lab, "ip -brief -4 addr show dev eth0")
    assert all(f" {lab.address(name)}/" in text for name, text in addresses.items())


def test_a_failing_command_is_one_line_with_its_host(lab: Lab) -> None:
    with pytest.raises(HostsError, match=r"^h[123]: nosuch .*\(127\)"):
        over_ssh(lab, "nosuch")


def test_environment_variables_are_set_on_their_host_only(lab: Lab) -> None:
    lab.environment("h2", ZSIM_WORD="two words")
    assert over_ssh(lab, "echo $ZSIM_WORD") == {"h1": "", "h2": "two words", "h3": ""}
    assert lab.run("h2", "printenv", "ZSIM_WORD").stdout == "two words\n"


def test_a_cut_isolates_a_host_until_it_is_healed(lab: Lab) -> None:
    with echo(lab, "h1") as other, echo(lab, "h2", from_="h3") as cut:
        assert cut.round_trip_s() is not None
        lab.cut("h2")
        assert cut.round_trip_s(LATE_S) is None
        assert other.round_trip_s() is not None
        lab.heal("h2")
        assert cut.round_trip_s() is not None


def test_a_slow_link_delays_both_directions(lab: Lab) -> None:
    least_s = 2 * 0.040
    with echo(lab, "h3") as link:
        lab.slow("h3", 50, 10)
        assert min(link.round_trip_s() or SOON_S for _ in range(5)) >= least_s
        lab.slow("h3", 0)
        assert any((link.round_trip_s() or SOON_S) < least_s for _ in range(5000))


def test_a_slow_link_can_be_cut(lab: Lab) -> None:
    lab.slow("h2", 5)
    with echo(lab, "h2") as link:
        assert link.round_trip_s() is not None
        lab.cut("h2")
        assert link.round_trip_s(LATE_S) is None
        lab.heal("h2")
        assert link.round_trip_s() is not None


def test_a_slow_link_loses_its_share_and_preserves_the_order(lab: Lab) -> None:
    sent, share = 2000, 0.1
    lab.slow("h1", 20, 20, share)
    with udp(lab, "h1") as there, udp(lab, LAUNCHER) as here:
        came = [number for number in carried(here, there, sent + BATCH) if number < sent]
    assert came == sorted(came)
    assert 0.06 * sent < sent - len(came) < 0.14 * sent  # six standard deviations


def carried(here: socket.socket, there: socket.socket, count: int) -> list[int]:
    """Send numbers in batches, each once part of the previous batch has arrived; return those received."""
    came: list[int] = []
    there.settimeout(SOON_S)
    for first in range(0, count, BATCH):
        for number in range(first, first + BATCH):
            here.sendto(number.to_bytes(4, "big"), there.getsockname())
        while not came or came[-1] < first:
            came.append(int.from_bytes(there.recv(4), "big"))
    return came


def test_zsim_processes_are_listed_on_their_host_only(lab: Lab) -> None:
    nowhere = f"tcp/{lab.address('h1')}:7447"
    with closing(Role(["estimator", "drone1", "--connect", nowhere, "--insecure"], lab.prefix("h2"))) as role:
        role.line("waiting for a world")
        assert {name: list(lab.processes(name)) for name in lab.names} == {"h1": [], "h2": [role.process.pid], "h3": []}
    assert not lab.processes("h2")


def test_nothing_is_left_of_a_lab_when_a_test_fails(tmp_path: Path) -> None:
    lab_module.demand()
    made, running = Lab(tmp_path, ("a", "b")), []
    with suppress(ZeroDivisionError), made:
        made.slow("b", 10)
        over_ssh(made, "nohup sleep 600 >/dev/null 2>&1 & echo started")
        running = inhabitants(made)
        assert len(running) >= 2 * 2 + 1  # an sshd and a sleep on each host, and one process for the link
        raise ZeroDivisionError
    assert all(wait_gone(pid, 0.0) for pid in running)
    assert not any((namespaces.FOLDER / namespace).exists() for namespace in made.namespaces())


def inhabitants(lab: Lab) -> list[int]:
    """Return the process ids of a lab."""
    return [pid for namespace in lab.namespaces() for pid, _ in namespaces.members(namespace)]


def test_concurrent_labs_are_isolated(lab: Lab, tmp_path: Path) -> None:
    with Lab(tmp_path / "other", ("h1",)) as other:
        other.cut("h1")
        with echo(lab, "h1") as link:
            assert link.round_trip_s() is not None
    assert over_ssh(lab, "true") == dict.fromkeys(lab.names, "")


def test_missing_tools_skip_a_test_but_fail_it_in_ci(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lab_module, "TOOLS", {"no-such-tool": "no-such-package"})
    monkeypatch.setattr(lab_module.os, "geteuid", lambda: 0)
    wanted = "a lab of hosts needs no-such-package; apt-get install it"
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match=wanted):
        lab_module.demand()
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match=wanted):
        lab_module.demand()
