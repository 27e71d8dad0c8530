"""The inbox: whatever the order of arrival, an agent gets the same gates with the same inputs in the same order.

The routing table, which assigns keys to readers, is tested here too.
"""

import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plain_messages import GATE_NS, estimate, imu, run_info, status

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Sightings
from zsim.contract.framing import GateMessages, key_table
from zsim.contract.messages import Baro, MessageInfo, encode
from zsim.runtime.inbox import ALWAYS_NS, GAP_MAX, NEVER_NS, GateRouter, Inbox, RoutingTable, output_hold_ns

STEP_NS = 5_000_000
STATUS = keys.status("d1")
IMU = keys.sensor("d1", "imu")

Sent = tuple[str, Any]


def gate_of(drone: str, gate: int) -> list[Sent]:
    """Return what a drone publishes in a gate: four IMU samples, a barometer sample in odd gates, and the status."""
    t_ns = gate * GATE_NS
    messages_sent: list[Sent] = []
    if gate:
        stamps = [t_ns - GATE_NS + STEP_NS * i for i in (1, 2, 3, 4)]
        messages_sent = [(keys.sensor(drone, "imu"), imu(at, 4 * (gate - 1) + i)) for i, at in enumerate(stamps)]
    if gate % 2:
        messages_sent.append(
            (keys.sensor(drone, "baro"), Baro(t_ns - STEP_NS, gate // 2, t_ns - STEP_NS, 101325.0, 1.0))
        )
    return [*messages_sent, (keys.status(drone), status(t_ns, gate, len(messages_sent) + 1))]


def flight(drones: list[str], gates: int) -> list[list[Sent]]:
    return [[sent for drone in drones for sent in gate_of(drone, gate)] for gate in range(gates)]


def canonical(messages_sent: list[Sent]) -> list[Sent]:
    return sorted(messages_sent, key=lambda sent: (sent[1].t_ns, sent[0], sent[1].seq))


def ready(inbox: Inbox) -> list[tuple[int, list[Sent]]]:
    """Take every gate that is complete."""
    taken = []
    while (t_ns := inbox.next_gate_ns()) is not None and inbox.missing(t_ns) is None:
        taken.append((t_ns, inbox.take(t_ns)))
    return taken


def feed(inbox: Inbox, arrivals: list[Sent]) -> list[tuple[int, list[Sent]]]:
    """Put messages one by one, taking every gate as soon as it is complete."""
    taken = []
    for key, message in arrivals:
        inbox.put(key, message)
        taken += ready(inbox)
    return taken


def expected(gates: list[list[Sent]]) -> list[tuple[int, list[Sent]]]:
    return [(gate * GATE_NS, canonical(messages_sent)) for gate, messages_sent in enumerate(gates)]


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 2**32), gates=st.integers(2, GAP_MAX), again=st.integers(0, 20))
def test_any_order_of_arrival_gives_the_canonical_sequence(seed: int, gates: int, again: int):
    """Gate 0 in order, then everything else shuffled, some of it twice."""
    messages_sent = flight(["d1", "d2"], gates)
    rest = [sent for gate in messages_sent[1:] for sent in gate]
    rng = random.Random(seed)
    arrivals = rest + rng.choices(rest, k=again)
    rng.shuffle(arrivals)
    inbox = Inbox([keys.status("d1"), keys.status("d2")], ["d1", "d2"])
    assert feed(inbox, [*messages_sent[0], *arrivals]) == expected(messages_sent)
    assert inbox.duplicates + inbox.late_count == again


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32), gates=st.integers(2, GAP_MAX))
def test_estimates_and_states_may_arrive_in_any_order(seed: int, gates: int):
    """A controller reads the states and estimates of three drones, none of which are counted."""
    drones = ["d1", "d2", "d3"]
    closing = [keys.status(d) for d in drones] + [keys.estimate(d) for d in drones]
    messages_sent = [
        [(keys.status(d), status(t, gate, 9)) for d in drones] + [(keys.estimate(d), estimate(t, gate)) for d in drones]
        for gate, t in ((gate, gate * GATE_NS) for gate in range(gates))
    ]
    arrivals = [sent for gate in messages_sent[1:] for sent in gate]
    random.Random(seed).shuffle(arrivals)
    assert feed(Inbox(closing), [*messages_sent[0], *arrivals]) == expected(messages_sent)


def test_samples_of_the_next_gate_do_not_stand_in_for_missing_ones():
    inbox = Inbox([STATUS], ["d1"])
    feed(inbox, gate_of("d1", 0))
    lost, *rest = gate_of("d1", 1)
    assert feed(inbox, [*rest, *gate_of("d1", 2)]) == []
    assert [t_ns for t_ns, _ in feed(inbox, [lost])] == [GATE_NS, 2 * GATE_NS]


def test_the_first_gate_of_a_late_joiner_is_not_counted():
    inbox = Inbox([STATUS], ["d1"])
    *_, sample, last = gate_of("d1", 7)
    assert feed(inbox, [sample, last]) == [(7 * GATE_NS, [sample, last])]
    lost, *rest = gate_of("d1", 8)
    assert feed(inbox, rest) == []
    assert [t_ns for t_ns, _ in feed(inbox, [lost])] == [8 * GATE_NS]


def test_the_very_first_gate_is_counted_in_full():
    inbox = Inbox([STATUS], ["d1"])
    first = (IMU, imu(0, 0))
    assert feed(inbox, [(STATUS, status(0, 0, 2))]) == []
    assert feed(inbox, [first]) == [(0, [first, (STATUS, status(0, 0, 2))])]


def test_a_warm_start_counts_its_next_gate_in_full():
    inbox = Inbox([STATUS], ["d1"])
    inbox.start_after(7 * GATE_NS)
    assert not inbox.put(*gate_of("d1", 7)[-1])
    lost, *rest = gate_of("d1", 8)
    assert feed(inbox, rest) == []
    assert [t_ns for t_ns, _ in feed(inbox, [lost])] == [8 * GATE_NS]


def test_a_replay_fills_a_gap_without_duplicates():
    inbox = Inbox([STATUS], ["d1"])
    messages_sent = flight(["d1"], 6)
    taken = feed(inbox, [*messages_sent[0], *messages_sent[1]])
    taken += feed(inbox, [*messages_sent[2][:2], *messages_sent[5]])
    assert inbox.next_gate_ns() == 2 * GATE_NS
    taken += feed(inbox, [sent for gate in messages_sent[1:] for sent in gate])
    assert taken == expected(messages_sent)
    assert inbox.late_count == len(messages_sent[1]) + len(messages_sent[5])
    assert inbox.duplicates == 2


def test_a_completely_lost_gate_is_detected_as_a_gap():
    inbox = Inbox([STATUS], ["d1"])
    messages_sent = flight(["d1"], 4)
    feed(inbox, messages_sent[0])
    assert feed(inbox, messages_sent[3]) == []
    assert inbox.next_gate_ns() == GATE_NS
    assert inbox.latest_gate_ns() == 3 * GATE_NS
    assert inbox.missing(GATE_NS) == STATUS
    assert inbox.lost(GATE_NS) == STATUS
    assert [t_ns for t_ns, _ in feed(inbox, [*messages_sent[2], *messages_sent[1]])] == [
        GATE_NS,
        2 * GATE_NS,
        3 * GATE_NS,
    ]


def test_an_abandoned_gap_is_skipped():
    inbox = Inbox([STATUS], ["d1"])
    messages_sent = flight(["d1"], 4)
    feed(inbox, [*messages_sent[0], *messages_sent[3]])
    assert inbox.take(GATE_NS) == []
    assert inbox.next_gate_ns() == 3 * GATE_NS


def test_a_gap_too_long_for_a_replay_is_a_jump():
    inbox = Inbox([STATUS])
    feed(inbox, gate_of("d1", 0)[-1:])
    far = GAP_MAX + 2
    assert [t_ns for t_ns, _ in feed(inbox, gate_of("d1", far)[-1:])] == [far * GATE_NS]


def test_the_longest_gap_that_a_replay_can_fill_is_detected() -> None:
    inbox = Inbox([STATUS])
    feed(inbox, gate_of("d1", 0)[-1:])
    assert feed(inbox, gate_of("d1", GAP_MAX + 1)[-1:]) == []
    assert inbox.next_gate_ns() == GATE_NS


def test_a_gap_is_detected_by_the_numbers_of_bundled_gates() -> None:
    inbox = Inbox([STATUS])
    for gate in (0, 2):
        t_ns = gate * GATE_NS
        pair = (STATUS, encode(status(t_ns, gate, 1)))
        inbox.put(keys.GATE, GateMessages.of(t_ns, gate, key_table(["d1"]), [pair]))
    assert [t_ns for t_ns, _ in ready(inbox)] == [0]
    assert inbox.next_gate_ns() == GATE_NS


def test_lost_returns_only_a_key_that_will_not_arrive():
    estimates = keys.estimate("d1")
    inbox = Inbox([STATUS, estimates])
    inbox.put(STATUS, status(0, 0, 1))
    assert inbox.missing(0) == estimates
    assert inbox.lost(0) is None
    inbox.put(STATUS, status(GATE_NS, 1, 1))
    assert inbox.lost(0) is None
    inbox.put(estimates, estimate(GATE_NS, 1))
    assert inbox.lost(0) == estimates


def test_a_dropped_publisher_is_not_waited_for_until_it_is_back():
    other = keys.estimate("d2")
    inbox = Inbox([STATUS, other])
    assert feed(inbox, [(STATUS, status(0, 0, 1))]) == []
    inbox.expect(other, NEVER_NS)
    assert [t_ns for t_ns, _ in ready(inbox)] == [0]
    inbox.expect(other, from_ns=2 * GATE_NS)
    assert [t_ns for t_ns, _ in feed(inbox, [(STATUS, status(GATE_NS, 1, 1))])] == [GATE_NS]
    assert feed(inbox, [(STATUS, status(2 * GATE_NS, 2, 1))]) == []
    assert inbox.missing(2 * GATE_NS) == other
    inbox.expect(other, NEVER_NS)
    inbox.expect(other, ALWAYS_NS)
    assert inbox.missing(2 * GATE_NS) == other


def test_samples_of_a_dropped_drone_are_not_waited_for():
    inbox = Inbox([STATUS], ["d1"])
    feed(inbox, gate_of("d1", 0))
    _, *rest = gate_of("d1", 1)
    assert feed(inbox, rest) == []
    inbox.expect(STATUS, NEVER_NS)
    assert [t_ns for t_ns, _ in ready(inbox)] == [GATE_NS]


def test_duplicate_and_late_messages_are_counted_and_refused():
    inbox = Inbox([STATUS], ["d1"])
    messages_sent = gate_of("d1", 0)
    assert inbox.put(*messages_sent[0])
    assert not inbox.put(*messages_sent[0])
    assert inbox.duplicates == 1
    inbox.take(0)
    assert not inbox.put(*messages_sent[0])
    assert inbox.late_count == 1
    assert inbox.next_gate_ns() is None


def test_a_different_number_or_time_makes_a_different_message():
    inbox = Inbox([STATUS])
    for t_ns, seq in ((5, 0), (6, 0), (5, 1)):
        assert inbox.put(IMU, imu(t_ns, seq))
    assert [message for _, message in inbox.take(10)] == [imu(5, 0), imu(5, 1), imu(6, 0)]


def test_a_long_backlog_is_processed_in_order():
    messages_sent = flight(["d1"], 300)
    inbox = Inbox([STATUS], ["d1"])
    for gate in messages_sent:
        for key, message in gate:
            inbox.put(key, message)
    assert inbox.latest_gate_ns() == 299 * GATE_NS
    assert ready(inbox) == expected(messages_sent)


def test_a_late_message_comes_once_with_the_next_gate_in_realtime():
    a, b = keys.estimate("d1"), keys.estimate("d2")
    inbox = Inbox([a, b], keep_late=True)
    for gate in (1, 2, 3, 4):
        inbox.put(a, estimate(gate * GATE_NS, gate))
    inbox.put(b, estimate(GATE_NS, 1))
    assert [key for key, _ in inbox.take(GATE_NS)] == [a, b]
    inbox.take(2 * GATE_NS)
    assert inbox.put(b, estimate(2 * GATE_NS, 2))
    assert inbox.put(b, estimate(2 * GATE_NS, 2))
    assert [(key, message.seq) for key, message in inbox.take(3 * GATE_NS)] == [(b, 2), (a, 3)]
    assert not inbox.put(b, estimate(2 * GATE_NS, 2))
    assert not inbox.put(b, estimate(GATE_NS, 1))
    assert [(key, message.seq) for key, message in inbox.take(4 * GATE_NS)] == [(a, 4)]
    assert inbox.late_count == 4


def test_late_messages_outside_gates_come_with_the_next_gate_in_lockstep():
    found = keys.detections("d1")
    inbox = Inbox([STATUS], uncounted=[found])
    for gate in (1, 2, 3):
        inbox.put(STATUS, status(gate * GATE_NS, gate, 1))
    inbox.take(2 * GATE_NS)
    late = [Sightings(t_ns=gate * GATE_NS, seq=gate, t_sample_ns=0, camera="front") for gate in (2, 1)]
    assert all(inbox.put(found, each) for each in late)
    assert [(key, message.seq) for key, message in inbox.take(3 * GATE_NS)] == [(found, 1), (found, 2), (STATUS, 3)]
    assert inbox.take(4 * GATE_NS) == []


def test_replayed_messages_of_a_bundled_gate_are_dropped():
    singly = gate_of("d1", 1)
    whole = GateMessages.of(GATE_NS, 1, key_table(["d1"]), [(key, messages.encode(each)) for key, each in singly])
    inbox = Inbox((STATUS, keys.estimate("d1")), ("d1",))
    for key, message in [(keys.gate("d1"), whole), *singly, (keys.estimate("d1"), estimate(GATE_NS, 0))]:
        inbox.put(key, message)
    assert inbox.missing(GATE_NS) is None
    assert sorted(key for key, _ in inbox.take(GATE_NS)) == sorted([keys.gate("d1"), keys.estimate("d1")])


# Publishers that may skip gates, such as drivers of external drones

SPARSE = (keys.status("d3"), keys.estimate("d3"))
CLOSING = (keys.status("d1"), keys.estimate("d1"), *SPARSE)


def closed_by(drone: str, gate: int, seq: int | None = None) -> list[Sent]:
    t_ns, number = gate * GATE_NS, gate if seq is None else seq
    return [(keys.status(drone), status(t_ns, number, 9)), (keys.estimate(drone), estimate(t_ns, number))]


def sparse_inbox(gates: int) -> Inbox:
    """Return the inbox of a controller of d1 and the external d3 after this many gates of both."""
    inbox = Inbox(CLOSING, keep_late=True, sparse=SPARSE)
    for gate in range(gates):
        for sent in closed_by("d3", gate) + closed_by("d1", gate):
            inbox.put(*sent)
        assert inbox.missing(gate * GATE_NS) is None
        inbox.take(gate * GATE_NS)
    return inbox


def put_all(inbox: Inbox, messages_sent: list[Sent]) -> None:
    for sent in messages_sent:
        inbox.put(*sent)


def test_a_sparse_publisher_that_skips_no_gate_is_waited_for():
    inbox = sparse_inbox(3)
    put_all(inbox, closed_by("d1", 3))
    assert inbox.missing(3 * GATE_NS) in SPARSE
    assert inbox.last_missing() in SPARSE
    put_all(inbox, closed_by("d3", 3))
    assert inbox.missing(3 * GATE_NS) is None


def test_a_publisher_that_skipped_is_awaited_after_two_gates_in_a_row():
    inbox = sparse_inbox(3)
    put_all(inbox, closed_by("d1", 3))
    inbox.take(3 * GATE_NS)  # abandoned, since the next gate has arrived
    for gate in range(4, 8):
        put_all(inbox, closed_by("d1", gate))
        assert inbox.missing(gate * GATE_NS) is None
        inbox.take(gate * GATE_NS)
    waited = []
    for gate in range(8, 12):  # d3 is back, each time later than d1
        put_all(inbox, closed_by("d1", gate))
        waited.append(inbox.missing(gate * GATE_NS) is not None)
        if not waited[-1]:
            taken = inbox.take(gate * GATE_NS)
            assert any(keys.thing(key) == "d3" for key, _ in taken) == (gate > 8)
        put_all(inbox, closed_by("d3", gate, seq=gate - 8))
        if waited[-1]:
            assert inbox.missing(gate * GATE_NS) is None
            inbox.take(gate * GATE_NS)
    assert waited == [False, False, True, True]


def test_a_publisher_at_every_second_gate_is_delivered_but_not_awaited():
    inbox = sparse_inbox(0)
    brought = []
    for gate in range(12):
        put_all(inbox, closed_by("d1", gate))
        assert inbox.missing(gate * GATE_NS) is None
        brought += [message.t_ns for key, message in inbox.take(gate * GATE_NS) if key == SPARSE[1]]
        if gate % 2 == 0:
            put_all(inbox, closed_by("d3", gate, seq=gate // 2))
    assert brought == [gate * GATE_NS for gate in range(0, 11, 2)]


def test_a_status_that_restarts_its_numbers_leaves_no_gap():
    inbox = Inbox([keys.status("d3")], ["d3"], keep_late=True, sparse=[keys.status("d3")])
    assert inbox.may_skip
    for gate, seq in ((4, 7), (9, 8), (11, 0), (12, 1)):
        inbox.put(keys.status("d3"), status(gate * GATE_NS, seq, 1))
        assert inbox.next_gate_ns() == gate * GATE_NS
        assert inbox.missing(gate * GATE_NS) is None
        inbox.take(gate * GATE_NS)


def test_a_gate_of_the_world_does_not_close_it_for_an_external_drone():
    d1, d3 = keys.status("d1"), keys.status("d3")
    table = key_table(["d1", "d3"])
    inbox = Inbox([d1, d3], ["d1", "d3"], keep_late=True, sparse=[d3])
    for gate in range(3):
        t_ns = gate * GATE_NS
        of_world = [(d1, messages.encode(status(t_ns, gate, 1)))]
        inbox.put(keys.GATE, GateMessages.of(t_ns, gate, table, of_world))
        assert inbox.missing(t_ns) == (d3 if gate == 2 else None)
        if gate < 2:
            inbox.take(t_ns)
        inbox.put(d3, status(t_ns, gate, 1))
    assert inbox.missing(2 * GATE_NS) is None


# Which reader reads which key, and which messages of a gate it receives


DRONES = ("d1", "d2", "d3")
CHUNKS = st.sampled_from(["a", "b", "ab", "@a"])
KEYS = st.lists(CHUNKS, min_size=1, max_size=4).map("/".join)
EXPRESSIONS = st.lists(st.one_of(CHUNKS, st.sampled_from(["*", "**", "a$*"])), min_size=1, max_size=4).map("/".join)


@given(readers=st.lists(st.lists(EXPRESSIONS, max_size=3), max_size=4), key=KEYS)
def test_the_routing_table_agrees_with_matching_each_expression(readers: list[list[str]], key: str) -> None:
    wanted = [place for place, own in enumerate(readers) if any(keys.matches(each, key) for each in own)]
    table = RoutingTable(readers)
    assert list(table.readers(key)) == wanted
    assert table.readers(key) is table.readers(key)


def test_readers_of_several_keys_are_listed_once() -> None:
    table = RoutingTable([["drone/*/truth"], ["clock"], ["drone/d1/*"], ["**"]])
    assert table.readers_of_any([keys.truth("d1"), keys.truth("d2")]) == (0, 2, 3)


def gate_messages(*pairs: tuple[str, bytes]) -> GateMessages:
    return GateMessages.of(GATE_NS, 1, key_table(DRONES), pairs)


def status_pair(drone: str) -> tuple[str, bytes]:
    return keys.status(drone), encode(status(GATE_NS, 1, 2))


def baro_pair(drone: str, t_ns: int = GATE_NS) -> tuple[str, bytes]:
    return keys.sensor(drone, "baro"), encode(Baro(t_ns, 1, t_ns, 101_325.0, 1.0))


def test_a_gate_is_decoded_once_and_split_among_its_readers() -> None:
    router = GateRouter(RoutingTable([["drone/*/sensor/status"], [keys.status("d2")], []]))
    routed = list(router.split(gate_messages(baro_pair("d1"), status_pair("d1"), baro_pair("d2"), status_pair("d2"))))
    assert [(key, readers) for readers, key, _ in routed] == [(keys.status("d1"), (0,)), (keys.status("d2"), (0, 1))]
    assert routed[0][2].count == 2


def test_undecodable_messages_of_a_gate_are_left_out() -> None:
    router = GateRouter(RoutingTable([["**"]]))
    assert [key for _, key, _ in router.split(gate_messages((keys.status("d1"), b"\xc1"), status_pair("d2")))] == [
        keys.status("d2")
    ]


@pytest.mark.parametrize("place", [-1, 24, 2**62])
def test_key_indices_outside_the_table_are_ignored(place: int) -> None:
    whole = gate_messages(status_pair("d1"), status_pair("d2"))
    bad = GateMessages(GATE_NS, 1, whole.table, np.full(2, place), whole.stamps, whole.ends, whole.buffer)
    assert list(GateRouter(RoutingTable([["**"]])).split(bad)) == []


def test_messages_of_a_gate_are_merged_in_canonical_order() -> None:
    other = (keys.estimate("d1"), status(GATE_NS, 1))
    router = GateRouter(RoutingTable([["**"]]))
    inputs = [(keys.GATE, gate_messages(status_pair("d2"), baro_pair("d1"), baro_pair("d3", GATE_NS - 1))), other]
    names = [keys.sensor("d3", "baro"), keys.estimate("d1"), keys.sensor("d1", "baro"), keys.status("d2")]
    assert [key for key, _ in router.one_by_one(inputs)] == names
    assert router.one_by_one([other]) == [other]


@pytest.mark.parametrize(
    ("more", "gates"),
    [({"user_messages": (MessageInfo("bidder/*/bid", "Bid", {}),)}, 1), ({}, 2), ({"mode": "realtime"}, 0)],
)
def test_outputs_of_others_are_held_until_all_agents_have_published(more: dict[str, Any], gates: int):
    info = run_info(command_delay_ns=GATE_NS, **more)
    assert output_hold_ns(info) == gates * GATE_NS
