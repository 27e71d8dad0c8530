"""Cause and victim: who waits for another's outputs."""

from zsim.contract import keys
from zsim.contract.run_messages import Done, Join
from zsim.scenario import scenario_file
from zsim_world.run.participants import DataFlow
from zsim_world.run.world import World

GATE_NS = 20_000_000
SCENARIO = scenario_file.from_text("""
name: pair
duration_s: 1
drones: [{name: d1, position_m: [0, 0, 0]}, {name: d2, position_m: [5, 0, 0]}]
clusters: [{name: main, drones: [d1, d2]}]
processes: {expect: []}
""")
ESTIMATORS, CONTROLLER = ("estimator.d1", "estimator.d2"), "controller.main"


def test_estimators_feed_the_controller_and_nobody_else_anybody():
    flow = DataFlow(SCENARIO)
    names = (*ESTIMATORS, CONTROLLER, "planner.main", "tester.one")
    pairs = {(writer, reader) for writer in names for reader in names if flow.feeds(writer, reader)}
    assert pairs == {(e, reader) for e in ESTIMATORS for reader in (CONTROLLER, "planner.main")}


def standing(*done: str) -> dict[str, tuple[str, ...]]:
    """Return whom a world waits for, and by whom each is held up, when those given are done with a gate."""
    world = World(SCENARIO, run_id="r")
    for pid, name in enumerate((*ESTIMATORS, CONTROLLER)):
        join = Join(0, 0, "r", pid, name.split(".")[0], "h", pid, GATE_NS)
        world.handle(keys.process(name, "join"), join, 0)
    while world.may_advance():
        world.advance(0)
    for pid, name in enumerate((*ESTIMATORS, CONTROLLER)):
        if name in done:
            world.handle(keys.process(name, "done"), Done(0, 0, "r", pid, 0, 0), 0)
    return {waiting.name: waiting.held_by for waiting in world.waiting_for(10**9)}


def test_who_lacks_an_estimate_is_a_victim():
    assert standing("estimator.d1") == {"estimator.d2": (), CONTROLLER: ("estimator.d2",)}


def test_who_has_them_all_is_the_cause():
    assert standing(*ESTIMATORS) == {CONTROLLER: ()}
