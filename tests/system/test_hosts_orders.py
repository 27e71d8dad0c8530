"""Commands to a running `zsim up`, with and without TLS, and what it leaves behind on its hosts."""

import re
import signal
import threading
import time
from pathlib import Path
from shutil import rmtree

import pytest
import yaml
from deployment import START_S, STEP, Deployment, closing, in_flight
from lab import LAUNCHER, Lab
from refused import has_terms

from zsim.transport.tls import KEY
from zsim_deploy.launch.supervisor import UNREAD

IN_FLIGHT = r" [1-9][0-9]*\.[0-9] . 3600 s"  # a line of progress after the first second

ROLES = {"world": "h1", "recorder": "h1", "controller.main": "h2", "estimator.*": ["h1", "h2"]}
SPARE = "h3"
DRONES = 10  # with the world, the recorder and the link's own channel, more than sshd's 10 channels


def keys(deployment: Deployment) -> list[Path]:
    """Return the certificates and keys left on the hosts."""
    return [path for name in deployment.lab.names for path in deployment.lab.host_folder(name).rglob("*.pem")]


def nothing_stays(deployment: Deployment) -> None:
    """Check that no file of a run is left on the hosts."""
    assert keys(deployment) == []
    assert [path for name in deployment.lab.names for path in deployment.lab.host_folder(name).glob("runs/*")] == []


def goes_on(deployment: Deployment) -> None:
    """Wait until every process is running and none is waited for."""
    until_s = time.monotonic() + START_S
    while {row["state"] for row in deployment.ps().values()} != {"running"}:
        assert time.monotonic() < until_s, deployment.ps()
        threading.Event().wait(0.05)  # no line reports that a process is no longer waited for


@pytest.mark.soak
def test_processes_can_be_restarted_and_moved_during_a_run(lab: Lab) -> None:
    """One move is refused for lack of a certificate; the other succeeds, although no process has run on its host."""
    with closing(Deployment(lab, ROLES)) as deployment:
        rmtree(lab.folder / "certs" / SPARE / "estimator.drone1", ignore_errors=True)
        run = deployment.up("--rate", "4", "--duration", "3600")
        in_flight(run)
        both = [deployment.zsim("restart", "estimator.drone2") for _ in range(2)]
        for command in both:
            command.process.wait(START_S)
            if command.process.poll():
                command.ends(with_code=2)
                assert "estimator.drone2 " in command.text()
        assert 0 in [command.process.poll() for command in both]
        run.line("superseded: estimator.drone2 on h2", START_S)
        refused = deployment.zsim("move", "estimator.drone1", SPARE)
        refused.ends(with_code=2)
        assert re.fullmatch(r"\S*/certs: .*estimator.drone1 on h3; .*certs init.*", refused.text())
        goes_on(deployment)
        assert not lab.host_folder(SPARE).exists()
        assert keys(deployment)
        move = deployment.zsim("move", "controller.main", SPARE)
        move.ends(with_code=0, within_s=START_S)
        run.line(f"superseded: controller.main on {SPARE}", START_S)
        assert deployment.ps()["controller.main"]["host"] == SPARE
        goes_on(deployment)
        deployment.zsim("down").ends(with_code=0)
        run.ends(with_code=130, within_s=START_S)
        assert "Traceback" not in run.text()
        assert "zsim down" in deployment.record().end()["reason"]
        nothing_stays(deployment)


@pytest.mark.soak
def test_closing_the_terminal_ends_the_run_like_ctrl_c(lab: Lab) -> None:
    """Meanwhile, other runs on these hosts are refused before anything starts, and leave nothing behind."""
    with closing(Deployment(lab, ROLES, secure=False)) as deployment:
        run = deployment.up("--rate", "4", "--duration", "3600")
        in_flight(run)
        follower = deployment.zsim("logs", "estimator.drone2", "--follow")
        follower.line("estimator.drone2: in run")
        others = {"is already up .* --set federation=NAME": (), "h1: port 7447 is in use there": ("other",)}
        for pattern, federation in others.items():
            options = [f"--set=federation={name}" for name in federation]
            other = deployment.zsim(
                "up", str(STEP), "--hosts", deployment.hosts, "--out", str(lab.folder / "other"), *options
            )
            other.ends(with_code=2, within_s=START_S)
            assert re.search(pattern, other.text())
            assert not (lab.folder / "other").exists()
        goes_on(deployment)
        run.signal(signal.SIGHUP)
        run.ends(with_code=130, within_s=START_S)
        reason = deployment.record().end()["reason"]
        assert "terminal" in reason
        assert has_terms(run.text().splitlines()[-1], reason, f"{deployment.out}/up.log")
        assert f"ended: {reason}\n" in (deployment.out / "up.log").read_text()
        nothing_stays(deployment)
        follower.ends(with_code=0, within_s=START_S)


@pytest.mark.soak  # test_kill covers this on one host
def test_after_a_broken_output_pipe_the_run_ends_and_its_record_is_fetched(lab: Lab) -> None:
    """As in `zsim up … 2>&1 | head`, the reader exits during the flight."""
    with closing(Deployment(lab, ROLES, secure=False)) as deployment:
        piped = '"$@" 2>&1 | sed -E "/' + IN_FLIGHT + '/q"'
        run = deployment.up("--rate", "4", "--duration", "3600", prefix=("sh", "-c", piped, "sh"))
        run.ends(with_code=0, within_s=START_S)
        deployment.nobody_left()
        assert deployment.record().end()["reason"] == UNREAD
        assert f"ended: {UNREAD}\n" in (deployment.out / "up.log").read_text()
        nothing_stays(deployment)


@pytest.mark.soak
def test_a_killed_launcher_leaves_a_record_but_no_keys(lab: Lab) -> None:
    """The next run reports the record and how to fetch it; a run whose own record cannot be fetched fails."""
    with closing(Deployment(lab, ROLES)) as deployment:
        run = deployment.up("--rate", "1", "--duration", "3600")
        in_flight(run)
        run.signal(signal.SIGKILL)
        deployment.nobody_left()
        assert [path.name for path in keys(deployment) if path.name == KEY] == []
        (path,) = lab.host_folder("h1").rglob("*.mcap")
        doctor = deployment.zsim("doctor", "--hosts", deployment.hosts)
        doctor.ends(with_code=0, within_s=START_S)
        assert re.search(f"^warning: h1: .*h1:{path};", doctor.text(), re.MULTILINE)
        rmtree(deployment.out)
        deployment.out.mkdir()
        (deployment.out / "run.mcap.part").symlink_to(lab.folder / "not there" / "run.mcap")
        second = deployment.up("--duration", "2", "--force")
        second.ends(with_code=1, within_s=START_S)
        remedy = re.search(rf"^warning: h1: .*h1:{path}; .*`(scp .*)`", second.text(), re.MULTILINE)
        assert remedy
        lab.run(LAUNCHER, "sh", "-c", remedy[1], cwd=lab.folder, check=True)
        assert (lab.folder / "run.mcap").read_bytes() == path.read_bytes()
        place = re.search(r"^ended: .* h1:(\S+) .*`scp ", second.text(), re.MULTILINE)
        assert place
        assert set(lab.host_folder("h1").rglob("*.mcap")) == {path, Path(place[1])}
        assert [path.name for path in keys(deployment) if path.name == KEY] == []


@pytest.mark.soak
def test_the_end_does_not_wait_for_a_recorder_that_is_cut_off(lab: Lab) -> None:
    """The record stays on its host; the keys are removed from the hosts that can be reached."""
    with closing(Deployment(lab, {**ROLES, "recorder": SPARE})) as deployment:
        run = deployment.up("--rate", "4", "--duration", "3600")
        in_flight(run)
        deployment.cut(SPARE)
        run.line(f"host {SPARE} does not answer", START_S)
        deployment.zsim("down").ends(with_code=0)
        run.line(f"fetching the record from {SPARE}:", START_S)
        run.ends(with_code=130, within_s=START_S)
        path = re.search(rf"record .*{SPARE}: .* {SPARE}:(\S+)", run.text())
        assert path is not None
        assert Path(path[1]).stat().st_size > 0
        assert f"{SPARE}: " in run.text()
        assert re.search(rf"{SPARE}: .*keys", run.text())
        assert {found.relative_to(lab.folder).parts[0] for found in keys(deployment)} == {SPARE}


@pytest.mark.soak
def test_a_host_may_run_more_processes_than_sshd_has_channels(lab: Lab) -> None:
    drones = [{"name": f"drone{i}", "position_m": [3.0 * i, 0.0, 0.0]} for i in range(DRONES)]
    scenario = lab.folder / "many.yaml"
    scenario.write_text(yaml.safe_dump({"name": "many", "duration_s": 1, "drones": drones}))
    with closing(Deployment(lab, {"world": "h1", "estimator.*": "h1"}, secure=False)) as deployment:
        run = deployment.zsim(
            "up", str(scenario), "--hosts", deployment.hosts, "--out", str(deployment.out), "--no-report"
        )
        run.ends(with_code=0, within_s=2 * START_S)
        assert {event["data"]["host"] for event in deployment.record().events("join")} == {"h1"}
        assert len(deployment.record().events("join")) == DRONES + 1
