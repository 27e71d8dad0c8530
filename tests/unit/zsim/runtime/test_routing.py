"""Who reads which key, and what of a gate's messages goes to whom: as comparing every expression would say."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsim.contract import keys
from zsim.contract.flight_messages import Status
from zsim.contract.framing import GateMessages, key_table
from zsim.contract.messages import Baro, encode
from zsim.runtime.inbox import GateRouter, RoutingTable, one_by_one

GATE_NS = 20_000_000
DRONES = ("d1", "d2", "d3")
CHUNKS = st.sampled_from(["a", "b", "ab", "@a"])
KEYS = st.lists(CHUNKS, min_size=1, max_size=4).map("/".join)
EXPRESSIONS = st.lists(st.one_of(CHUNKS, st.sampled_from(["*", "**", "a$*"])), min_size=1, max_size=4).map("/".join)


@given(readers=st.lists(st.lists(EXPRESSIONS, max_size=3), max_size=4), key=KEYS)
def test_it_says_what_comparing_each_expression_says(readers: list[list[str]], key: str) -> None:
    wanted = [place for place, own in enumerate(readers) if any(keys.matches(each, key) for each in own)]
    table = RoutingTable(readers)
    assert list(table.readers(key)) == wanted
    assert table.readers(key) is table.readers(key)


def test_readers_of_any_of_some_keys_are_named_once() -> None:
    table = RoutingTable([["drone/*/truth"], ["clock"], ["drone/d1/*"], ["**"]])
    assert table.readers_of_any([keys.truth("d1"), keys.truth("d2")]) == (0, 2, 3)


def gate(*pairs: tuple[str, bytes]) -> GateMessages:
    return GateMessages.of(GATE_NS, 1, key_table(DRONES), pairs)


def status(drone: str) -> tuple[str, bytes]:
    return keys.status(drone), encode(Status(GATE_NS, 1, "flying", 90.0, False, None, 2))


def baro(drone: str, t_ns: int = GATE_NS) -> tuple[str, bytes]:
    return keys.sensor(drone, "baro"), encode(Baro(t_ns, 1, t_ns, 101_325.0, 1.0))


def test_each_reader_gets_what_it_reads_of_a_gate_decoded_once() -> None:
    router = GateRouter(RoutingTable([["drone/*/sensor/status"], [keys.status("d2")], []]))
    routed = list(router.split(gate(baro("d1"), status("d1"), baro("d2"), status("d2"))))
    assert [(key, readers) for readers, key, _ in routed] == [(keys.status("d1"), (0,)), (keys.status("d2"), (0, 1))]
    assert routed[0][2].count == 2


def test_what_is_no_message_of_its_key_is_left_out() -> None:
    router = GateRouter(RoutingTable([["**"]]))
    assert [key for _, key, _ in router.split(gate((keys.status("d1"), b"\xc1"), status("d2")))] == [keys.status("d2")]


@pytest.mark.parametrize("place", [-1, 24, 2**62])
def test_keys_outside_of_the_table_are_not_followed(place: int) -> None:
    whole = gate(status("d1"), status("d2"))
    bad = GateMessages(GATE_NS, 1, whole.table, np.full(2, place), whole.stamps, whole.ends, whole.buffer)
    assert list(GateRouter(RoutingTable([["**"]])).split(bad)) == []


def test_messages_of_a_gate_come_among_the_others_in_canonical_order() -> None:
    other = (keys.estimate("d1"), Status(GATE_NS, 1, "flying", 90.0, False, None, 1))
    router = GateRouter(RoutingTable([["**"]]))
    inputs = [(keys.GATE, gate(status("d2"), baro("d1"), baro("d3", GATE_NS - 1))), other]
    names = [keys.sensor("d3", "baro"), keys.estimate("d1"), keys.sensor("d1", "baro"), keys.status("d2")]
    assert [key for key, _ in one_by_one(inputs, router)] == names
    assert one_by_one([other], router) == [other]
