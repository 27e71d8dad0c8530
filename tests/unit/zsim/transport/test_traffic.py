"""What passes the hub: batches taken apart once, and what cannot be read is counted."""

from typing import Any

import pytest
from fake_link import FakeLink

from zsim.contract import keys
from zsim.contract.framing import GateMessages, encode_batch, key_table
from zsim.transport.session import ReceivedSample
from zsim.transport.traffic import Traffic, samples

DRONES = ["d1"]
GATE = GateMessages.of(20, 1, key_table(DRONES), [(keys.truth("d1"), b"truth"), (keys.status("d1"), b"status")])


def passed(*payloads: bytes) -> tuple[list[Any], int]:
    """Return what arrives of some batches, and how often something was refused."""
    refusals: list[None] = []
    link: Any = FakeLink()
    traffic = Traffic(link, key_table(DRONES), lambda: refusals.append(None))
    for payload in payloads:
        link.deliver(keys.BATCH, payload)
    return list(traffic.drain()), len(refusals)


def test_messages_and_gates_come_in_the_order_in_which_they_passed() -> None:
    arrived, refused = passed(encode_batch([("clock", b"1"), (keys.GATE, GATE.pack()), ("my/own", b"2")]))
    assert arrived[0] == ReceivedSample("clock", b"1")
    assert arrived[1].pairs == GATE.pairs
    assert list(samples(arrived))[1:] == [*GATE.pairs, ("my/own", b"2")]
    assert refused == 0


@pytest.mark.parametrize("garbage", [b"", b"\xc1", encode_batch([(keys.GATE, b"\xc1")])])
def test_what_cannot_be_read_is_counted_and_the_rest_comes(garbage: bytes) -> None:
    arrived, refused = passed(garbage, encode_batch([("clock", b"1")]))
    assert (arrived, refused) == ([ReceivedSample("clock", b"1")], 1)


def test_a_reader_can_be_woken() -> None:
    link: Any = FakeLink()
    traffic = Traffic(link, key_table(DRONES))
    traffic.wake()
    assert traffic.receive() == []
