"""User agents that exchange messages: each message arrives at the same gate however the agents are run.

python test_talking_agents.py ENDPOINT FOLDER a b     runs talkers as one process; writes what each received
"""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest
from federation import ONE, PATIENCE_S, Federation

from zsim.contract import keys, messages
from zsim.contract.flight_messages import ClusterState
from zsim.runtime.agent import Agent, AgentGroup, Output
from zsim.runtime.bus import Bus
from zsim.runtime.inbox import output_hold_ns
from zsim.runtime.runner import Runner
from zsim.scenario import scenario_file
from zsim.transport.connection import find_world
from zsim_world.run.world import World

NAMES = ("a", "b", "c")
WAITS_FOR = {"b": "a"}  # reader: the talker whose state its gate waits for; the others only read states
GATES = 25
EXPECT = [word for name in NAMES for word in ("--expect", f"talk.{name}")]


class Talker(Agent):
    """Publishes a state at every gate, and notes every state received with the gate of its arrival."""

    def __init__(self, info: messages.Info, name: str) -> None:
        super().__init__()
        status, self._key = keys.status("drone1"), keys.cluster_state(name)
        self.name, self.period_ns = f"talk.{name}", info.gate_ns
        self.gate_keys = (status, *(keys.cluster_state(WAITS_FOR[each]) for each in WAITS_FOR if each == name))
        self.reads = (status, keys.cluster_state("*"))
        self.writes = (self._key,)
        self.heard: list[list[Any]] = []
        self._new: list[tuple[str, int]] = []
        self._gate_ns = info.gate_ns

    def receive(self, key: str, message: Any) -> None:
        self._new.append((key, message.t_ns // self._gate_ns))

    def step(self, t_ns: int) -> list[Output]:
        self.heard += [[t_ns // self._gate_ns, *each] for each in self._new]
        self._new = []
        return [
            Output(self._key, ClusterState(t_ns, self.next_seq(self._key), "idle", (), (), (), (), (), None, 0, ""))
        ]


def as_one(info: messages.Info, names: Sequence[str]) -> tuple[list[Talker], Agent]:
    talkers = [Talker(info, name) for name in names]
    return talkers, talkers[0] if len(talkers) == 1 else AgentGroup(talkers, output_hold_ns(info))


def note(folder: Path, talkers: Sequence[Talker]) -> None:
    for talker in talkers:
        (folder / talker.name).write_text(json.dumps(talker.heard))


def main(endpoint: str, folder: str, *names: str) -> None:
    with find_world(endpoint, "zsim", PATIENCE_S, print) as (link, info):
        talkers, agent = as_one(info, names)
        Runner(link, info, agent, say=print).run()
        note(Path(folder), talkers)


def in_one_process(path: str, processes: Sequence[Sequence[str]]) -> dict[str, list[list[Any]]]:
    world = World(scenario_file.load(path, duration_s=GATES * 0.02))
    made = [as_one(world.info(), names) for names in processes]
    bus = Bus(world, [agent for _, agent in made], time.monotonic_ns)
    bus.join()
    while bus.turn():
        pass
    bus.end()
    return {talker.name: talker.heard for talkers, _ in made for talker in talkers}


def on_zenoh(federation: Federation, processes: Sequence[Sequence[str]]) -> dict[str, list[list[Any]]]:
    world = federation.world(ONE, "--duration", str(GATES * 0.02), *EXPECT)
    command = [sys.executable, __file__, federation.endpoint, str(federation.folder)]
    started = [subprocess.Popen([*command, *names]) for names in processes]
    try:
        world.ends(with_code=0)
        assert [process.wait(PATIENCE_S) for process in started] == [0] * len(started)
    finally:
        for process in started:
            process.kill()
            process.wait()
    return {f"talk.{name}": json.loads((federation.folder / f"talk.{name}").read_text()) for name in NAMES}


def expected() -> dict[str, list[list[Any]]]:
    """Return the expected arrivals: awaited states in their own gate, others two gates later, one for the delay."""
    heard: dict[str, list[list[Any]]] = {}
    for name in NAMES:
        delays = {keys.cluster_state(each): 0 if WAITS_FOR.get(name) == each else 2 for each in NAMES}
        delays[keys.status("drone1")] = 0
        arrivals = [[gate + delay, gate, key] for key, delay in delays.items() for gate in range(GATES + 1)]
        in_order = sorted(arrival for arrival in arrivals if arrival[0] <= GATES)
        heard[f"talk.{name}"] = [[at, key, stamp] for at, stamp, key in in_order]
    return heard


@pytest.mark.parametrize("names", [*map("".join, permutations(NAMES))])
def test_messages_arrive_as_expected_in_one_process_in_any_order(federation: Federation, names: Sequence[str]) -> None:
    path = federation.write(ONE)
    assert in_one_process(path, [[name] for name in names]) == expected()
    assert in_one_process(path, [names]) == expected()
    assert in_one_process(path, [names[:1], names[1:]]) == expected()


@pytest.mark.parametrize(
    "processes",
    [
        ["a", "b", "c"],
        ["bc", "a"],
        *(pytest.param(each, marks=pytest.mark.soak) for each in (["abc"], ["cba"], ["ca", "b"])),
    ],
    ids=lambda names: "-".join(names),
)
def test_messages_arrive_as_expected_over_zenoh(federation: Federation, processes: Sequence[str]) -> None:
    assert on_zenoh(federation, processes) == expected()


if __name__ == "__main__":
    main(*sys.argv[1:])
