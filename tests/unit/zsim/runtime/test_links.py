"""Links: which messages of a gate an agent receives and when, and both ends of the agents' radio."""

import math
from collections import Counter
from typing import Any

import plain_messages
import pytest
from msgspec.structs import replace
from plain_messages import GATE_NS, ZEROS, run_info
from refused import has_terms

from zsim.contract import keys
from zsim.contract.flight_messages import Mode, Status
from zsim.contract.framing import GateMessages, key_table
from zsim.contract.messages import AgentMessage, ClusterInfo, Imu, Info, encode, register_messages
from zsim.contract.run_messages import ControlRequest, Fault, Faults, RadioLinks
from zsim.contract.snapshot import pack, unpack
from zsim.runtime.agent import Agent, Output
from zsim.runtime.links import Links, Receiver, Transmitter, position_of, senders
from zsim.scenario import scenario_file
from zsim.scenario.faults import planned
from zsim.scenario.scenario import Radio
from zsim_agents.formation.controller import REQUESTS_MAX, Controller
from zsim_world.run.world import World

ME, OTHER = "controller.main", "estimator.d1"
ESTIMATE, STATUS = keys.estimate("d1"), keys.status("d1")
RUN = run_info(["d1", "d2"], [ClusterInfo("main", ("d1", "d2"))])
Given = tuple[str, Any]


def estimate(
    gate: int, position_m: tuple[float, float, float] = ZEROS, source: str = OTHER, drone: str = "d1"
) -> Given:
    return keys.estimate(drone), plain_messages.estimate(gate * GATE_NS, gate, position_m, source)


def status(gate: int) -> Given:
    return STATUS, plain_messages.status(gate * GATE_NS, gate)


def links(*faults: Fault, names: tuple[str, ...] = (ME,), seed: int = 1) -> Links:
    made = Links(replace(RUN, seed=seed), names)
    made.update(Faults(0, 0, faults))
    return made


def fault(kind: str, target: str = f"{OTHER}/{ME}", number: int = 1, **given: Any) -> Fault:
    return planned({"kind": kind, "target": target, **given}, number, "test", 0, GATE_NS)


def handed_over(made: Links, t_ns: int, inputs: list[Given]) -> list[Given]:
    return made.delivered(t_ns, inputs) if made.act_at(t_ns) else inputs


def gates(made: Links, last: int, given: Any = estimate) -> list[tuple[int, int]]:
    """Deliver one message per gate; return (gate of delivery, gate of the message) pairs."""
    handed = [(gate, handed_over(made, gate * GATE_NS, [given(gate)])) for gate in range(1, last + 1)]
    return [(gate, message.t_ns // GATE_NS) for gate, some in handed for _, message in some]


def test_without_a_fault_messages_pass_unchanged():
    inputs = [estimate(1)]
    assert handed_over(links(), GATE_NS, inputs) is inputs


def test_a_cut_acts_from_the_gate_after_its_start_to_its_end():
    made = links(fault("link_cut", at_s=0.04, for_s=0.06))
    assert gates(made, 8) == [(gate, gate) for gate in (1, 2, 6, 7, 8)]


@pytest.mark.parametrize(("delay_ms", "late"), [(1, 1), (20, 1), (21, 2), (60, 3)])
def test_a_delay_is_rounded_up_to_whole_gates(delay_ms: float, late: int):
    made = links(fault("link_delay", delay_ms=delay_ms))
    assert gates(made, 10) == [(gate + late, gate) for gate in range(1, 11 - late)]


def test_messages_still_delayed_when_a_delay_ends_come_first():
    made = links(fault("link_delay", delay_ms=40, for_s=0.06))
    assert gates(made, 6) == [(3, 1), (4, 2), (4, 4), (5, 3), (5, 5), (6, 6)]


def test_delays_add_up_and_a_cut_overrides_them():
    late = [fault("link_delay", delay_ms=20), fault("link_delay", number=2, delay_ms=30)]
    assert gates(links(*late), 5) == [(4, 1), (5, 2)]
    assert gates(links(*late, fault("link_cut", number=3)), 5) == []


def test_losses_match_their_probability_in_any_order_of_arrival():
    share, count = 0.3, 4000
    kept = {gate for gate, _ in gates(links(fault("link_loss", probability=share)), count)}
    assert len(kept) / count == pytest.approx(1 - share, abs=4 * math.sqrt(share * (1 - share) / count))
    made = links(fault("link_loss", probability=share))
    backwards = {gate for gate in range(count, 0, -1) if made.delivered(gate * GATE_NS, [estimate(gate)])}
    assert backwards == kept
    other = {gate for gate, _ in gates(links(fault("link_loss", probability=share), seed=2), count)}
    assert other != kept
    assert gates(links(fault("link_loss", probability=1.0)), 50) == []
    assert len(gates(links(fault("link_loss", probability=0.0)), 50)) == 50


def test_two_losses_draw_independently():
    first, second = fault("link_loss", probability=0.5), fault("link_loss", number=2, probability=0.5)
    count = 2000
    kept = len(gates(links(first, replace(second, rank=1)), count)) / count
    assert kept == pytest.approx(0.25, abs=4 * math.sqrt(0.25 * 0.75 / count))


def test_two_jitters_draw_independently():
    """The sum of two uniform delays of up to two gates each has a triangular distribution over four gates."""
    first, second = fault("link_jitter", jitter_ms=40), fault("link_jitter", number=2, jitter_ms=40)
    count = 2000
    late = [to - of for to, of in gates(links(first, replace(second, rank=1)), count)]
    shares = [late.count(gate) / len(late) for gate in (1, 2, 3, 4)]
    assert shares == pytest.approx([1 / 8, 3 / 8, 3 / 8, 1 / 8], abs=4 * math.sqrt(0.25 / count))
    late = [to - of for to, of in gates(links(fault("link_jitter", jitter_ms=100)), 3000)]
    assert set(late) == {1, 2, 3, 4, 5}  # any delay above zero takes at least a gate
    assert sum(late) / len(late) == pytest.approx(3.0, abs=0.1)


def test_a_cut_acts_both_ways_unless_it_is_one_way():
    there, back = fault("link_cut", f"{ME}/{OTHER}"), fault("link_cut", f"{ME}/{OTHER}", one_way=True)
    assert gates(links(there), 3) == []
    assert len(gates(links(back), 3)) == 3
    assert gates(links(fault("link_cut", f"{OTHER}/{ME}", one_way=True)), 3) == []


def test_a_cut_does_not_affect_other_links():
    made = links(
        fault("link_cut", "estimator.d2/controller.main"), fault("link_cut", f"{OTHER}/controller.b", number=2)
    )
    assert len(gates(made, 3)) == 3
    assert len(gates(links(fault("link_cut")), 3, status)) == 3  # a status is sent by the world
    assert gates(links(fault("link_cut", f"world/{ME}")), 3, status) == []


def test_senders_follow_from_the_key_and_the_source_of_a_message():
    assert senders(ESTIMATE, estimate(1)[1]) == (OTHER,)
    assert senders(ESTIMATE, estimate(1, source="controller.main")[1]) == (OTHER,)  # they share a process
    assert senders(ESTIMATE, estimate(1, source="my.filter")[1]) == (OTHER, "my.filter")
    assert senders(STATUS, status(1)[1]) == ("world",)
    told = AgentMessage(t_ns=0, seq=0, source="pilot.d7")  # from a process that serves several drones
    assert senders("swarm/d1/place", told, {"swarm/*/place": "pilot"}) == ("pilot.d1",)
    assert senders(keys.command("d1", "mode"), Mode(0, 0, "console.1", "land")) == ("console.1",)


def test_only_a_newer_fault_list_replaces_the_current_one():
    made = links(fault("link_cut"))
    made.update(Faults(0, 0, ()))
    assert gates(made, 1) == []
    made.update(Faults(0, 1, ()))
    assert len(gates(made, 1)) == 1


class Both(Agent):
    """The estimators of two drones in one agent, which reads whole gates and notes what it receives."""

    name, serves, takes_gates = "estimator.d1", ("estimator.d2",), True
    reads = tuple(keys.sensors(drone) for drone in ("d1", "d2"))

    def __init__(self) -> None:
        super().__init__()
        self.received: list[Any] = []

    def receive(self, key: str, message: Any) -> None:
        self.received.append(key)

    def receive_gate(self, gate: GateMessages) -> None:
        self.received.append(gate)

    def step(self, t_ns: int) -> list[Output]:
        return []


def test_an_estimator_of_several_drones_has_a_link_for_each():
    pairs = [(keys.sensor(drone, "imu"), encode(Imu(GATE_NS, 1, GATE_NS, ZEROS, ZEROS))) for drone in ("d1", "d2")]
    gate = GateMessages.of(GATE_NS, 1, key_table(["d1", "d2"]), pairs)
    made, inputs = Both(), [(keys.GATE, gate)]
    made.update_faults(info(), Faults(0, 0, (fault("link_cut", "world/estimator.d2"),)))
    made.deliver(GATE_NS, inputs)
    assert made.received == [keys.sensor("d1", "imu")]
    made.update_faults(info(), Faults(0, 1, ()))
    made.deliver(2 * GATE_NS, inputs)
    assert made.received[1:] == [gate]


def radio(**place: Any) -> Fault:
    return fault(
        "radio", "main", range_m=50, spread_m=5, place={name.replace("_", "."): at for name, at in place.items()}
    )


@pytest.mark.parametrize("distance_m", [30.0, 45.0, 50.0, 55.0, 70.0])
def test_a_radio_loses_more_at_greater_distance(distance_m: float):
    count = 2000
    kept = len(gates(links(radio()), count, lambda gate: estimate(gate, (distance_m, 0.0, 0.0))))
    expected = 1 / (1 + math.exp((distance_m - 50) / 5))
    assert kept / count == pytest.approx(expected, abs=4 * math.sqrt(0.25 / count))


def test_a_radio_is_located_at_its_process():
    far = (1000.0, 0.0, 0.0)
    assert gates(links(radio()), 5, lambda gate: estimate(gate, far)) == []
    assert len(gates(links(radio(controller_main=[990, 0, 0])), 5, lambda gate: estimate(gate, far))) == 5
    on_d2 = links(radio(controller_main="d2"))
    beside = [
        on_d2.delivered(gate * GATE_NS, [estimate(gate, far), estimate(gate, far, drone="d2")]) for gate in (1, 2)
    ]
    assert [len(handed) for handed in beside] == [2, 2]
    apart = [on_d2.delivered(gate * GATE_NS, [estimate(gate, far), estimate(gate, drone="d2")]) for gate in (3, 4)]
    assert [[message.position_m for _, message in handed] for handed in apart] == [[ZEROS], [ZEROS]]


def test_there_is_no_radio_between_a_drone_and_its_own_estimator():
    made = links(fault("radio", "world", range_m=1, spread_m=0.1), names=(OTHER,))
    assert len(gates(made, 5, lambda gate: estimate(gate, (1000.0, 0.0, 0.0)))) == 5


def test_a_radio_at_an_unknown_place_loses_nothing():
    assert len(gates(links(radio()), 5, status)) == 5  # no estimate has arrived yet
    assert position_of("controller.main", {"controller.main": "d9"}, ("d1",), {}.get) is None


@pytest.mark.parametrize("process", ["estimator.d2", "reference.d2", "pilot.d2"])
def test_a_process_named_after_a_drone_has_its_radio_on_that_drone(process: str) -> None:
    """d1 is 1000 m from the origin and beside d2; d2 hears itself wherever it is."""
    far, place = (1000.0, 0.0, 0.0), {"d2": (1000.0, 1.0, 0.0)}.get
    assert position_of(process, {}, ("d1", "d2"), place) == (1000.0, 1.0, 0.0)
    assert position_of(process, {process: [5, 0, 0]}, ("d1", "d2"), place) == [5, 0, 0]
    made = links(fault("radio", "world", range_m=50, spread_m=5), names=(process,))
    for gate in (1, 2, 3):
        handed = made.delivered(gate * GATE_NS, [estimate(gate, far), estimate(gate, far, drone="d2")])
        assert len(handed) == 2
    assert made.delivered(4 * GATE_NS, [estimate(4, drone="d1"), estimate(4, far, drone="d2")]) == [
        estimate(4, far, drone="d2")
    ]


@pytest.mark.parametrize("process", ["controller.d2", "camera.d2", "console.1", "pilot.nobody"])
def test_a_process_that_is_on_no_drone_is_at_the_origin(process: str) -> None:
    assert position_of(process, {}, ("d1", "d2"), {"d2": (1000.0, 1.0, 0.0)}.get) == ZEROS


def world() -> World:
    drones = [{"name": name, "position_m": [3 * k, 0, 0]} for k, name in enumerate(("d1", "d2"))]
    given = {"name": "t", "duration_s": 1, "drones": drones, "clusters": [{"name": "main", "drones": ["d1", "d2"]}]}
    return World(scenario_file.resolve(given))


def info() -> Info:
    return world().info()


def controller() -> Controller:
    return Controller(info(), world().scenario, "main")


def test_a_controller_keeps_the_newest_state_of_a_drone():
    made = controller()
    newest = Status(3 * GATE_NS, 3, "landing", 90.0, False, None, 1)
    made.deliver(3 * GATE_NS, [(STATUS, newest)])
    made.deliver(4 * GATE_NS, [status(2)])
    assert made._states == ["landing", "landed"]


def test_a_controller_takes_a_limited_number_of_requests_per_gate():
    """A paused run needs the limit; at the next gate the controller publishes the requests it took and takes others."""
    made, (key,) = controller(), controller().control_keys()
    answers = [made.control(key, ControlRequest("sing", {}, "op.1")) for _ in range(REQUESTS_MAX + 1)]
    assert [answer.error for answer in answers if has_terms(answer.error, str(REQUESTS_MAX), "requests")] == [
        answers[-1].error
    ]
    said = [output.key for output in made.step(GATE_NS)]
    assert said.count(keys.cluster_request("main")) == REQUESTS_MAX
    assert "wait for" not in made.control(key, ControlRequest("sing", {}, "op.1")).error


def test_restored_links_deliver_the_same_messages_at_the_same_gates():
    acting = fault("link_delay", delay_ms=100), fault("link_loss", number=2, probability=0.3)
    made, again = links(*acting), Links(RUN, (ME,))
    gates(made, 20)
    again.restore(unpack(pack(made.snapshot())))
    for gate in range(21, 60):
        inputs = [estimate(gate), status(gate)]
        handed = handed_over(made, gate * GATE_NS, inputs)
        assert handed_over(again, gate * GATE_NS, inputs) == handed
        assert handed


class Said(AgentMessage, frozen=True):
    key = "radiotest/{drone}/said"
    number: int
    text: str = ""


def said(gate: int, by: str = "d1", text: str = "") -> tuple[str, Said]:
    return Said.of(by), Said(t_ns=gate * GATE_NS, seq=gate, source=f"pilot.{by}", number=gate, text=text)


@pytest.fixture(autouse=True)
def known() -> None:
    register_messages([Said])


def receiver(name: str = "pilot.d2", **radio: Any) -> Receiver:
    return Receiver(RUN, Radio(**radio), name)


def heard(gate: int, *hears: tuple[int, ...], reception: tuple[tuple[float, ...], ...] = ()) -> RadioLinks:
    return RadioLinks(gate * GATE_NS, gate, hears, reception)


def test_the_links_at_the_time_of_sending_decide() -> None:
    made = receiver()
    assert made.delay_ns(*said(0)) is None  # no links are known yet
    made.take(heard(1, (), (0,)))
    made.take(heard(2, (), ()))
    assert [made.delay_ns(*said(gate)) for gate in (0, 1, 2, 3)] == [None, 0, None, None]


def test_messages_from_the_same_drone_or_a_wired_station_use_no_radio() -> None:
    made = receiver(loss=1.0)
    made.take(heard(0, (), ()))
    assert made.delay_ns(*said(0, "d2")) == 0
    assert made.delay_ns(*said(0, "main")) == 0
    placed = receiver(station_m=(0.0, 0.0, 0.0))
    placed.take(heard(0, (), (2,), ()))
    assert placed.delay_ns(*said(0, "main")) == 0
    placed.take(heard(1, (), (0,), ()))
    assert placed.delay_ns(*said(1, "main")) is None


def test_loss_and_reception_multiply() -> None:
    made = receiver(loss=0.2)
    made.take(heard(0, (), (0,), reception=((), (0.5,))))
    received = sum(made.delay_ns(*said(gate)) == 0 for gate in range(4000))
    assert received / 4000 == pytest.approx(0.4, abs=4 * math.sqrt(0.24 / 4000))


def test_draws_depend_on_the_receiver_and_the_message() -> None:
    one, other = receiver(loss=0.5), receiver("watch.d2", loss=0.5)
    for made in (one, other):
        made.take(heard(0, (), (0,)))
    first = [one.delay_ns(*said(gate)) for gate in range(50)]
    assert [one.delay_ns(*said(gate)) for gate in range(50)] == first
    assert [other.delay_ns(*said(gate)) for gate in range(50)] != first


def test_delay_and_jitter_add_up() -> None:
    made = receiver(delay_ms=30, jitter_ms=10)
    made.take(heard(0, (), (0,)))
    delays = [made.delay_ns(*said(gate)) or 0 for gate in range(1000)]
    assert 30_000_000 <= min(delays) < 31_000_000
    assert 39_000_000 < max(delays) <= 40_000_000


def test_bandwidth_spreads_messages_over_gates() -> None:
    """16 + 16 bytes at 6.4 kbit/s take 40 ms: one every second gate; with more than two waiting, the oldest is lost."""
    made = Transmitter(Radio(bandwidth_kbit_s=6.4, queue_max=2), GATE_NS)
    assert made.size_bytes(said(0, text="x" * 13)[1]) == 32  # 1 for the list, 1 and 14 for its values
    sent = {gate: made.send(gate * GATE_NS, [said(gate, text="x" * 13)]) for gate in range(9)}
    assert [[message.number for _, message in each] for each in sent.values()] == [
        [0], [], [1], [], [3], [], [5], [], [7],
    ]  # fmt: skip
    assert all(message.t_ns == gate * GATE_NS for gate, each in sent.items() for _, message in each)


def test_outputs_that_are_not_agent_messages_do_not_wait() -> None:
    made = Transmitter(Radio(bandwidth_kbit_s=0.1), GATE_NS)
    command = ("drone/d1/cmd/mode", object())
    assert made.send(0, [said(0), command]) == [command, said(0)]
    assert made.send(GATE_NS, [said(1), command]) == [command]


def test_a_snapshot_holds_known_links_and_waiting_messages() -> None:
    radio: dict[str, Any] = {"loss": 0.5, "bandwidth_kbit_s": 6.4}
    one, sends = receiver(**radio), Transmitter(Radio(**radio), GATE_NS)
    one.take(heard(0, (), (0,)))
    sends.send(0, [said(0, text="x" * 13), said(0, text="y" * 13)])
    again, sends_again = receiver(**radio), Transmitter(Radio(**radio), GATE_NS)
    again.restore(unpack(pack(one.snapshot())))
    sends_again.restore(unpack(pack(sends.snapshot())))
    assert Counter(again.delay_ns(*said(g)) for g in range(9)) == Counter(one.delay_ns(*said(g)) for g in range(9))
    assert [sends_again.send(t, []) for t in range(0, 5 * GATE_NS, GATE_NS)] == [
        sends.send(t, []) for t in range(0, 5 * GATE_NS, GATE_NS)
    ]
