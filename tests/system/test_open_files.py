"""Low limits on open files: one line reports how many a command needs, and that many are enough."""

import re
import subprocess
from pathlib import Path

import pytest
from federation import ONE, PAIR
from forked_commands import ROOT, USER_FAULT, ZSIM
from refused import has_terms

PATIENCE_S = 120.0  # wall time for a run of 1 s of simulated time on a busy machine
TOO_FEW = (10, 16, 24)  # unchecked limits that cause a traceback, a panic or a hang
BRIEF = ONE.replace("expect: []", "expect: [estimator.drone1]").replace("duration_s: 10", "duration_s: 1")
BRIEF_PAIR = PAIR.replace("duration_s: 12", "duration_s: 1")
HOSTS = "hosts: {h1: {address: 192.0.2.1}}\nroles: {'*': h1}\nsecurity: {insecure: true}\n"
COMMANDS: dict[str, tuple[str, ...]] = {
    "run": ("run", "{one}", "--no-report", "--out", "{out}"),
    "a hosted run": ("run", "{pair}", "--hosted", "--no-report", "--out", "{out}"),
    "world": ("world", "{one}", "--listen", "tcp/127.0.0.1:9"),
    "an agent": ("estimator", "drone1", "--connect", "tcp/127.0.0.1:9"),
    "an observer": ("keys", "--connect", "tcp/127.0.0.1:9"),
    "gateway": ("gateway", "--connect", "tcp/127.0.0.1:9"),
    "console": ("console", "--connect", "tcp/127.0.0.1:9"),
    "up": ("up", "{pair}", "--hosts", "{hosts}", "--no-report", "--out", "{out}"),
    "sweep": ("sweep", "{one}", "--vary", "seed", "--runs", "2", "--workers", "2", "--out", "{out}"),
}


def zsim(folder: Path, files: int, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run a command under a limit of `files` open files."""
    one, pair, out, hosts = (folder / name for name in ("one.yaml", "pair.yaml", "out", "hosts.yaml"))
    hosts.write_text(HOSTS)
    one.write_text(BRIEF)
    pair.write_text(BRIEF_PAIR)
    words = [word.format(one=one, pair=pair, out=out, hosts=hosts) for word in arguments]
    command = ["bash", "-c", f'ulimit -n {files}; exec "$@"', "zsim", *ZSIM, *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, cwd=ROOT)


def needed(folder: Path, name: str) -> int:
    """Run a command with too few files, check the line that reports it, and return the number in it."""
    few = TOO_FEW[len(name) % len(TOO_FEW)]
    done = zsim(folder, few, *COMMANDS[name])
    assert done.returncode == USER_FAULT, done.stderr
    line = done.stderr.splitlines()[-1]  # a sweep shows its progress first
    assert "Traceback" not in done.stderr
    said = re.search(r"must be (\d+) for", line)
    assert said is not None, line
    assert has_terms(line, str(few), said[1], f"`ulimit -n {said[1]}`")
    assert not (folder / "out" / "logs").exists()
    return int(said[1])


SESSIONS = ("an observer", "gateway", "console", "up")  # these open a session as an agent does
RUNS = ["run", pytest.param("a hosted run", marks=pytest.mark.soak)]
OTHERS = ["world", "an agent", "sweep", *(pytest.param(name, marks=pytest.mark.soak) for name in SESSIONS)]


@pytest.mark.parametrize("name", OTHERS)
def test_too_low_a_limit_is_reported_with_the_number_needed(tmp_path: Path, name: str) -> None:
    needed(tmp_path, name)


@pytest.mark.parametrize("name", RUNS)
def test_the_reported_number_of_files_is_enough(tmp_path: Path, name: str) -> None:
    flown = zsim(tmp_path, needed(tmp_path, name), *COMMANDS[name])
    assert flown.returncode == 0, flown.stderr
