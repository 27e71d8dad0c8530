"""How a process is stopped, the private key that a launcher lends to it, and its priority."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from refused import has_terms

from zsim.transport.tls import Identity
from zsim_deploy.roles.closed_output import CLOSED
from zsim_deploy.roles.stop_channel import NICE, REASONS, KeyLease, interruptible, key_lease

ROLE = """
import os, sys, time
from pathlib import Path
from zsim.transport.tls import Identity
from zsim_deploy.roles.stop_channel import StopChannel
folder = Path(sys.argv[1])
stop = StopChannel("run1", Identity(tls=folder))
print("ready", flush=True)
while not stop.stopped():
    time.sleep(0.001)
print(stop.orphaned(), (folder / "key.pem").exists(), flush=True)
os._exit(0) if stop.orphaned() else sys.exit(0)
"""


@pytest.fixture
def key(tmp_path: Path) -> Path:
    path = tmp_path / "runs" / "run1" / "identity" / "estimator.d1" / "key.pem"
    path.parent.mkdir(parents=True)
    path.write_text("secret")
    return path


@pytest.mark.parametrize(("given", "printed"), [("", ["True", "False"]), ("stop enough\n", ["False", "True"])])
def test_an_orphaned_process_returns_its_key_before_it_stops(key: Path, given: str, printed: list[str]) -> None:
    command = [sys.executable, "-c", ROLE, str(key.parent)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin
        assert process.stdout
        process.stdin.write(given)
        process.stdin.flush() if given else process.stdin.close()
        assert process.stdout.read().split() == ["ready", *printed]
        process.wait(60.0)
    assert not key.exists()


HELD = """
import signal, sys, time
from zsim_deploy.roles import stop_channel
if sys.argv[1] == "windows":
    del signal.pthread_kill
stop_channel.GRACE_S = 0.01
stop = stop_channel.StopChannel(held_by=lambda _: ", in a law")
signal.raise_signal(signal.SIGTERM)
try:
    while True:
        time.sleep(0.001)
except KeyboardInterrupt as error:
    print(stop.reason(), error, sep="|")
"""


@pytest.mark.parametrize("system", ["posix", "windows"])
def test_code_that_does_not_check_for_a_stop_is_interrupted(system: str) -> None:
    done = subprocess.run([sys.executable, "-c", HELD, system], capture_output=True, text=True, timeout=60.0)
    assert (done.stdout, done.stderr) == ("terminated|terminated, in a law\n", "")


def test_a_key_sent_for_a_successor_is_kept(key: Path) -> None:
    old = KeyLease(key.parent)
    key.unlink()
    key.write_text("another")
    old.release()
    assert key.read_text() == "another"
    KeyLease(key.parent).release()
    assert not key.exists()
    old.release()


def test_a_key_that_belongs_to_the_host_is_not_treated_as_lent(key: Path) -> None:
    certs = Path("certs/h1/estimator.d1")
    for tls, launched in ((None, "run1"), (key.parent, None), (key.parent, "run2"), (certs, "run1")):
        assert key_lease(Identity(tls=tls), launched) is None
    assert key_lease(Identity(tls=key.parent), "run1") is not None


HANGS = """
import threading
from zsim_deploy.roles import stop_channel
stop_channel.GRACE_S = 0.01
stop_channel.StopChannel("run1")
threading.Event().wait()
"""


def test_a_process_that_hangs_without_its_launcher_is_ended_with_a_reason() -> None:
    done = subprocess.run(
        [sys.executable, "-c", HANGS], input="", capture_output=True, text=True, timeout=60.0, check=False
    )
    assert done.returncode == 1
    assert has_terms(done.stderr.splitlines()[-1], "launcher", "0.01")


BY_HAND = """
import signal, sys, time
signal.signal(signal.SIGHUP, getattr(signal, sys.argv[1]))  # whoever runs the tests may be under nohup
from zsim_deploy.roles.stop_channel import StopChannel
stop = StopChannel()
print("ready", flush=True)
while not stop.stopped():
    time.sleep(0.001)
if sys.argv[1] == "SIG_DFL":
    print("nobody reads this", flush=True)
raise SystemExit(7 if stop.reason() == sys.argv[2] else 0)
"""


@pytest.mark.parametrize(
    ("before", "numbers", "reason"),
    [
        ("SIG_DFL", (signal.SIGHUP, signal.SIGHUP), CLOSED),  # shells send SIGHUP more than once
        ("SIG_IGN", (signal.SIGHUP, signal.SIGTERM), REASONS[signal.SIGTERM]),
    ],
    ids=["terminal", "nohup"],
)
def test_a_closed_terminal_ends_a_process_in_an_orderly_way(
    before: str, numbers: tuple[signal.Signals, ...], reason: str
) -> None:
    command = [sys.executable, "-c", BY_HAND, before, reason]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert process.stdout.readline() == "ready\n"
        process.stdout.close()  # like a closed terminal: writing to it fails
        for number in numbers:
            process.send_signal(number)
        assert process.wait(60.0) == 7


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_raises_keyboard_interrupt(number: signal.Signals) -> None:
    former = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), interruptible():
        signal.raise_signal(number)
    assert signal.getsignal(number) is former


def test_an_interrupt_that_a_library_turns_into_an_error_is_restored() -> None:
    def fail(number: int = 0) -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(number) if number else None
        raise SystemError("returned NULL without setting an exception")

    with pytest.raises(KeyboardInterrupt), interruptible():
        fail(signal.SIGINT)
    with pytest.raises(SystemError), interruptible():
        fail()


AUTOGROUP = Path("/proc/self/autogroup")
NICEST = 19  # the maximum on Linux
PROGRAM = """
import os
from pathlib import Path
from zsim_deploy.roles.stop_channel import lower_priority
lower_priority()
print(os.nice(0), Path("/proc/self/autogroup").read_text().split()[-1])
"""


@pytest.mark.skipif(not AUTOGROUP.exists(), reason="sessions are not scheduled as groups by this kernel")
@pytest.mark.parametrize("leads", [True, False])
def test_a_session_leader_lowers_the_priority_of_its_whole_session(leads: bool) -> None:
    """A role of a run leads its session. In a terminal, the session is the shell's, and keeps its priority."""
    start = [sys.executable, "-c", PROGRAM]
    shell = [] if leads else ["sh", "-c", '"$@"; exit $?', "sh"]
    done = subprocess.run([*shell, *start], capture_output=True, text=True, check=True, start_new_session=True)
    own = min(NICEST, os.nice(0) + NICE)
    assert done.stdout.split() == [str(own), str(NICE if leads else 0)]
