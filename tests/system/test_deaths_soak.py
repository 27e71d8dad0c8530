"""Every process of a run dies, stops, moves or loses its link, again and again: no bit and no gate is lost. `make soak`."""

import random
import re
import signal
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import pytest
from deployment import ROLES, START_S, STEP, Deployment, closing, in_flight
from federation import PAIR, PAIR_ROLES, Federation, Record, Role
from lab import Lab
from test_kill import Flight, check_end, check_whole

from zsim.record import RecordReader
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_analysis.in_process import fly
from zsim_deploy.launch.supervisor import RESTART_WINDOW_S, RESTARTS_MAX

pytestmark = pytest.mark.soak

ROUNDS = 15  # in each, everybody dies once and is stopped once
STOPPED_S, CUT_S = 0.3, 3.0  # wall time; the second is long enough to be noticed
PAUSE_S = 0.5  # wall time between two at most: most come while others are on their way back
ROUND_S = 1.2 * RESTART_WINDOW_S / RESTARTS_MAX  # wall time of a round at least: a launcher takes more for a fault
ESTIMATORS = ("estimator.drone1", "estimator.drone2", "estimator.drone3")
LAB_ROLES = (*ESTIMATORS, "controller.main", "recorder", "world")
BACK = {"world": "world: goes on at t = "}
Act = Callable[[], object]


class Deaths:
    """Lets them happen in rounds, each before the last one is over.

    Args:
        run: the launcher.
        seed: of their order and times.
    """

    def __init__(self, run: Role, seed: int) -> None:
        self._run = run
        self._chance = random.Random(seed)
        self.count = 0

    def round(self, acts: Sequence[tuple[Act, str]]) -> None:
        """Do all of these in a random order, then wait until all are over.

        Each has the pattern of the line that shows that it is over, none for what nobody notices.
        """
        until_s = time.monotonic() + ROUND_S
        expected = {back: len(re.findall(back, self._run.text())) + 1 for _, back in acts if back}
        for act, _ in self._chance.sample(acts, len(acts)):
            act()
            self.count += 1
            threading.Event().wait(self._chance.uniform(0, PAUSE_S))
        for pattern, number in expected.items():
            self._run.line(pattern, START_S, number)
        threading.Event().wait(max(0.0, until_s - time.monotonic()))


def back(role: str) -> str:
    """Return the pattern of the line that shows that a role that died is there again."""
    return BACK.get(role, f"(restart|superseded): {role} on ")


def pause(kill: Callable[[int], object]) -> None:
    """Stop a process for a moment."""
    kill(signal.SIGSTOP)
    threading.Event().wait(STOPPED_S)
    kill(signal.SIGCONT)


def sha256_in_process(scenario: Scenario, record: Record, folder: Path) -> str:
    """Return the hash of the same flight when nothing happens to anybody."""
    path = folder / "undisturbed.mcap"
    fly(msgspec.structs.replace(scenario, duration_s=record.end()["last_ns"] / 1e9), path)
    with RecordReader(path) as reader:
        return Record(reader).sha256()


@pytest.mark.parametrize("seed", range(2))
def test_on_one_host(federation: Federation, tmp_path: Path, seed: int) -> None:
    flight = Flight(federation)
    deaths = Deaths(flight.run, seed)
    for _ in range(ROUNDS):
        names = (*PAIR_ROLES, "recorder", "world")
        deaths.round([(lambda name=name: federation.kill(name), back(name)) for name in names])
        deaths.round([(lambda name=name: pause(lambda n: federation.kill(name, n)), "") for name in names])
    flight.finish()
    record = check_end(federation, whole=True)
    check_whole(record)
    drones = ["drone1", "drone2"]
    wanted = sha256_in_process(scenario_file.from_text(PAIR), record, tmp_path)
    assert (record.sha256(), record.recomputed_sha256(drones)) == (wanted, wanted)
    assert deaths.count == 2 * 5 * ROUNDS


@pytest.mark.parametrize("seed", range(2))
def test_on_three_hosts(lab: Lab, tmp_path: Path, seed: int) -> None:
    with closing(Deployment(lab, ROLES)) as deployment:
        run = deployment.up("--rate", "4", "--duration", "100000")
        in_flight(run)
        deaths = Deaths(run, seed)
        for number in range(ROUNDS):
            deaths.round([(lambda role=role: deployment.kill(role), back(role)) for role in LAB_ROLES])
            deaths.round([(lambda r=role: pause(lambda n: deployment.kill(r, n)), "") for role in LAB_ROLES])
            host = ("h1", "h2", "h3")[number % 3]
            deaths.round([(lambda to=host: move(deployment, "estimator.drone3", to), "")])
            deaths.round([(lambda: cut(deployment, "h3"), "")])
        deployment.zsim("down").ends(with_code=0)
        run.ends(with_code=130, within_s=START_S)
        record = deployment.record()
        wanted = sha256_in_process(scenario_file.load(STEP), record, tmp_path)
        drones = ["drone1", "drone2", "drone3"]
        assert (record.sha256(), record.recomputed_sha256(drones)) == (wanted, wanted)
        check_whole(record)
        assert deaths.count == 14 * ROUNDS


def move(deployment: Deployment, role: str, host: str) -> None:
    """Move a role, unless it is there, or is on its way to somewhere: then that is refused."""
    deployment.zsim("move", role, host).process.wait(START_S)


def cut(deployment: Deployment, host: str) -> None:
    """Cut a host off for a while."""
    deployment.cut(host)
    threading.Event().wait(CUT_S)
    deployment.heal(host)
