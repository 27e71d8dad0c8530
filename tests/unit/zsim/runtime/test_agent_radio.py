"""Both ends of the agents' radio: what is sent at which gate, what is received, when."""

import math
from collections import Counter
from typing import Any

import pytest

from zsim.contract.agent_messages import AgentMessage
from zsim.contract.messages import DroneInfo, Info, Origin, register_messages
from zsim.contract.run_messages import RadioLinks
from zsim.contract.snapshot import pack, unpack
from zsim.runtime.agent_radio import Receiver, Transmitter
from zsim.scenario.scenario import Radio

GATE_NS = 20_000_000
INFO = Info(
    0, 0, 1, "r", "zsim", "lockstep", 0.0, GATE_NS, 2_500_000, GATE_NS, 7, Origin(0, 0, 0),
    tuple(DroneInfo(name, "ardrone2") for name in ("d1", "d2")), (), "", "", "", "",
)  # fmt: skip


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
    return Receiver(INFO, Radio(**radio), name)


def links(gate: int, *hears: tuple[int, ...], reception: tuple[tuple[float, ...], ...] = ()) -> RadioLinks:
    return RadioLinks(gate * GATE_NS, gate, hears, reception)


def test_the_links_at_the_time_of_sending_count() -> None:
    made = receiver()
    assert made.delay_ns(*said(0)) is None  # no links known
    made.take(links(1, (), (0,)))
    made.take(links(2, (), ()))
    assert [made.delay_ns(*said(gate)) for gate in (0, 1, 2, 3)] == [None, 0, None, None]


def test_what_comes_from_the_same_drone_or_a_wired_station_passes_no_radio() -> None:
    made = receiver(loss=1.0)
    made.take(links(0, (), ()))
    assert made.delay_ns(*said(0, "d2")) == 0
    assert made.delay_ns(*said(0, "main")) == 0
    placed = receiver(station_m=(0.0, 0.0, 0.0))
    placed.take(links(0, (), (2,), ()))
    assert placed.delay_ns(*said(0, "main")) == 0
    placed.take(links(1, (), (0,), ()))
    assert placed.delay_ns(*said(1, "main")) is None


def test_loss_and_reception_multiply() -> None:
    made = receiver(loss=0.2)
    made.take(links(0, (), (0,), reception=((), (0.5,))))
    received = sum(made.delay_ns(*said(gate)) == 0 for gate in range(4000))
    assert received / 4000 == pytest.approx(0.4, abs=4 * math.sqrt(0.24 / 4000))


def test_draws_are_of_each_receiver_and_message() -> None:
    one, other = receiver(loss=0.5), receiver("watch.d2", loss=0.5)
    for made in (one, other):
        made.take(links(0, (), (0,)))
    first = [one.delay_ns(*said(gate)) for gate in range(50)]
    assert [one.delay_ns(*said(gate)) for gate in range(50)] == first
    assert [other.delay_ns(*said(gate)) for gate in range(50)] != first


def test_delay_and_jitter_add_up() -> None:
    made = receiver(delay_ms=30, jitter_ms=10)
    made.take(links(0, (), (0,)))
    delays = [made.delay_ns(*said(gate)) or 0 for gate in range(1000)]
    assert 30_000_000 <= min(delays) < 31_000_000
    assert 39_000_000 < max(delays) <= 40_000_000


def test_bandwidth_spreads_messages_over_gates() -> None:
    """16 + 16 bytes at 6.4 kbit/s take 40 ms: one at every second gate; beyond two waiting, the oldest is lost."""
    made = Transmitter(Radio(bandwidth_kbit_s=6.4, queue_max=2), GATE_NS)
    assert made.size_bytes(said(0, text="x" * 13)[1]) == 32  # 1 for the list, 1 and 14 for its values
    sent = {gate: made.send(gate * GATE_NS, [said(gate, text="x" * 13)]) for gate in range(9)}
    assert [[message.number for _, message in each] for each in sent.values()] == [
        [0], [], [1], [], [3], [], [5], [], [7],
    ]  # fmt: skip
    assert all(message.t_ns == gate * GATE_NS for gate, each in sent.items() for _, message in each)


def test_what_is_no_message_waits_for_none() -> None:
    made = Transmitter(Radio(bandwidth_kbit_s=0.1), GATE_NS)
    command = ("drone/d1/cmd/mode", object())
    assert made.send(0, [said(0), command]) == [command, said(0)]
    assert made.send(GATE_NS, [said(1), command]) == [command]


def test_a_snapshot_has_what_is_known_and_what_waits() -> None:
    radio: dict[str, Any] = {"loss": 0.5, "bandwidth_kbit_s": 6.4}
    one, sends = receiver(**radio), Transmitter(Radio(**radio), GATE_NS)
    one.take(links(0, (), (0,)))
    sends.send(0, [said(0, text="x" * 13), said(0, text="y" * 13)])
    again, sends_again = receiver(**radio), Transmitter(Radio(**radio), GATE_NS)
    again.restore(unpack(pack(one.snapshot())))
    sends_again.restore(unpack(pack(sends.snapshot())))
    assert Counter(again.delay_ns(*said(g)) for g in range(9)) == Counter(one.delay_ns(*said(g)) for g in range(9))
    assert [sends_again.send(t, []) for t in range(0, 5 * GATE_NS, GATE_NS)] == [
        sends.send(t, []) for t in range(0, 5 * GATE_NS, GATE_NS)
    ]
