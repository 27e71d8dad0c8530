"""The private key that a launcher lends: it goes with the process, and not with the one before it."""

import subprocess
import sys
from pathlib import Path

import pytest

from zsim.transport.tls import Identity
from zsim_deploy.security.key_lease import Lent, lent

ROLE = """
import os, sys, time
from pathlib import Path
from zsim.transport.tls import Identity
from zsim_deploy.roles.stop_channel import Leash
from zsim_deploy.security.key_lease import lent
folder = Path(sys.argv[1])
leash = Leash(True, lent(Identity(tls=folder), "run1"))
print("ready", flush=True)
while not leash.pulled():
    time.sleep(0.001)
print(leash.deserted(), (folder / "key.pem").exists(), flush=True)
os._exit(0) if leash.deserted() else sys.exit(0)
"""


@pytest.fixture
def key(tmp_path: Path) -> Path:
    path = tmp_path / "runs" / "run1" / "identity" / "estimator.d1" / "key.pem"
    path.parent.mkdir(parents=True)
    path.write_text("secret")
    return path


def role(key: Path, given: str) -> list[str]:
    """Run a process that lives until it is told to stop, or deserted; return what it says."""
    command = [sys.executable, "-c", ROLE, str(key.parent)]
    done = subprocess.run(command, input=given, capture_output=True, text=True, timeout=60.0, check=True)
    return done.stdout.split()


def test_a_deserted_process_has_given_its_key_back_before_it_does_anything_else(key: Path) -> None:
    assert role(key, "") == ["ready", "True", "False"]


def test_a_process_that_is_told_to_stop_keeps_its_key_to_its_end(key: Path) -> None:
    command = [sys.executable, "-c", ROLE, str(key.parent)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin
        assert process.stdout
        process.stdin.write("stop enough\n")
        process.stdin.flush()
        assert process.stdout.read().split() == ["ready", "False", "True"]
        process.wait(60.0)
    assert not key.exists()


def test_a_key_that_was_brought_for_a_successor_stays(key: Path) -> None:
    old = Lent(key.parent)
    key.unlink()
    key.write_text("another")
    old.give_back()
    assert key.read_text() == "another"
    Lent(key.parent).give_back()
    assert not key.exists()
    old.give_back()


def test_a_key_of_the_hosts_own_is_not_lent(key: Path) -> None:
    certs = Path("certs/h1/estimator.d1")
    for tls, launched in ((None, "run1"), (key.parent, None), (key.parent, "run2"), (certs, "run1")):
        assert lent(Identity(tls=tls), launched) is None
    assert lent(Identity(tls=key.parent), "run1") is not None
