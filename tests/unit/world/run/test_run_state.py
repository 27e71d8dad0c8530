"""The state of a world: a world restored from it continues with the same bytes, whatever flies, fails or is delayed."""

from typing import Any

import pytest

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Mode, Velocity
from zsim.contract.framing import GateMessages
from zsim.contract.run_messages import ControlRequest, Done, Join
from zsim.contract.snapshot import pack, restore, unpack
from zsim.scenario import scenario_file
from zsim_world.run.world import World

GATE_NS = 20_000_000
GATES = 340
RESTORED = (1, 9, 11, 61, 77, 101, 113, 127, 133, 180, 240, 290, 320)
PILOT, CLIENT = "pilot.one", "client"
FAULTS: list[dict[str, Any]] = [
    *({"kind": f"{each}_noise", "target": "drone1", "factor": 2, "at_s": 0.5, "for_s": 2} for each in ("gps", "baro")),
    {"kind": "gps_dropout", "target": "drone2", "probability": 0.5, "at_s": 1},
    {"kind": "mag_stuck", "target": "drone1", "at_s": 1.2, "for_s": 1.5},
    {"kind": "gyro_bias", "target": "drone2", "value_deg_s": [1, 0, 0], "at_s": 1.5, "for_s": 1},
    {"kind": "rotor_stuck", "target": "drone1", "rotor": "all", "at_s": 2.5, "for_s": 0.2},
    {"kind": "gust", "target": "world", "velocity_m_s": [3, 0, 0], "at_s": 1.6, "for_s": 2},
    {"kind": "link_loss", "target": f"{PILOT}/world", "probability": 0.5, "at_s": 2},
    {"kind": "link_delay", "target": f"{PILOT}/world", "delay_ms": 90, "at_s": 2.2, "for_s": 1},
]
ADDED = (
    {"kind": "gps_stuck", "target": "drone2"},
    {"kind": "link_delay", "target": f"{PILOT}/world", "delay_ms": 40, "at_s": 3.5},
)
SCENARIO: dict[str, Any] = {
    "name": "restored",
    "seed": 7,
    "duration_s": 10,
    "time": {"command_delay_gates": 2},
    "sensors": {"preset": "paper", "gps": {"latency_ms": 130}, "baro": {"latency_ms": 50}},
    "environment": {
        "wind": {"steady_m_s": [1, 0, 0], "gust_m_s": 0.5},
        "obstacles": [{"name": "post", "shape": "box", "position_m": [0.9, 0, 1], "size_m": [0.2, 3, 2]}],
    },
    "drones": [
        {"name": "drone1", "position_m": [0, 0, 0]},
        {"name": "drone2", "position_m": [0, 0.7, 0], "sensors": {"pitot": {"module": "airspeed", "latency_ms": 30}}},
    ],
    "processes": {"expect": [PILOT], "on_death": {"pilot": "wait"}},
    "faults": FAULTS,
}


class Flown:
    """A world, its participant and client, and what they do at each gate."""

    def __init__(self) -> None:
        self.world = World(scenario_file.resolve(SCENARIO), run_id="run1")
        self.published: list[tuple[str, bytes]] = []

    def start(self) -> None:
        self.world.handle(keys.process(PILOT, "join"), _join(), 0)
        self.go_on(0)

    def go_on(self, k: int) -> None:
        """Publish gate k, and let participant and client answer it."""
        world, t_ns = self.world, k * GATE_NS
        assert world.may_advance()
        world.advance(1_000_000 * k)
        velocity = Velocity(t_ns, k, PILOT, (0.6, -0.1 if k % 50 < 25 else 0.1, 0.05), 0.2)
        if k == 10:
            for i, drone in enumerate(("drone1", "drone2")):
                world.handle(keys.command(drone, "mode"), Mode(t_ns, i, PILOT, "takeoff"), 1_000_000 * k)
        for drone in ("drone1", "drone2"):
            world.handle(keys.command(drone, "velocity"), velocity, 1_000_000 * k)
        if k == 100:
            request = ControlRequest("acquire", {"drone": "drone2", "priority": 3}, CLIENT)
            assert world.control(request).ok
            for fault in ADDED:
                assert world.control(ControlRequest("fault_add", fault, CLIENT)).ok
        world.handle(keys.process(PILOT, "done"), Done(t_ns, k, "run1", 5, t_ns, 2 + 2 * (k == 10)), 1_000_000 * k)
        self._publish()

    def _publish(self) -> None:
        for key, message in self.world.take_outbox():
            if isinstance(message, GateMessages):
                self.published += message.pairs
            else:
                self.published.append((key, messages.encode(message)))


def _join() -> Join:
    return Join(0, 0, "run1", 5, "pilot", "laptop", 12, GATE_NS, "1", "", ())


@pytest.fixture(scope="module")
def whole() -> tuple[Flown, dict[int, bytes], dict[int, int]]:
    """A flight, its states at some gates, and the number of messages published up to these."""
    flown, states, sizes = Flown(), {}, {}
    flown.start()
    for k in range(1, GATES):
        flown.go_on(k)
        if k in RESTORED:
            states[k], sizes[k] = pack(flown.world.checkpoint()), len(flown.published)
    return flown, states, sizes


def test_the_flight_covers_what_has_to_be_restored(whole: tuple[Flown, dict[int, bytes], dict[int, int]]):
    payloads = whole[0].published
    events = [messages.decode(key, payload) for key, payload in payloads if key == keys.EVENT]
    assert {"fault", "fault_end", "commander", "mode", "collision", "refused"} <= {event.kind for event in events}
    assert any(key.endswith("/pitot") for key, _ in payloads)


@pytest.mark.parametrize("k", RESTORED)
def test_a_restored_world_publishes_the_same_bytes(whole: tuple[Flown, dict[int, bytes], dict[int, int]], k: int):
    flown, states, sizes = whole
    again = Flown()
    again.world.take_outbox()
    state = unpack(states[k])
    restore(again.world, state)
    assert all(pack({"part": part}) == pack({"part": state[name]}) for name, part in again.world.checkpoint().items())
    for gate in range(k + 1, GATES):
        again.go_on(gate)
    assert again.published == flown.published[sizes[k] :]


def test_the_truth_hash_continues_after_a_restore(whole: tuple[Flown, dict[int, bytes], dict[int, int]]):
    first, second, truth = Flown(), Flown(), bytearray()
    first.world.keep_truth(truth.extend)
    first.start()
    for k in range(1, 40):
        first.go_on(k)
    state, hashed = unpack(pack(first.world.checkpoint())), bytes(truth)
    restore(second.world, state)
    second.world.keep_truth(lambda data: None, [hashed[:1000], hashed[1000:]])
    for k in range(40, 60):
        first.go_on(k)
        second.go_on(k)
    assert first.world.result()["truth_sha256"] == second.world.result()["truth_sha256"]
    assert len(hashed) == 40 * 2 * 14 * 8


def test_a_state_of_another_fleet_is_refused(whole: tuple[Flown, dict[int, bytes], dict[int, int]]):
    alone = {**SCENARIO, "drones": SCENARIO["drones"][:1], "faults": []}
    with pytest.raises(ValueError, match="shape"):
        restore(World(scenario_file.resolve(alone)), unpack(whole[1][77]))
