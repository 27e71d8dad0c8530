"""Traffic through the hub and its replay: batches are unpacked once, and unreadable payloads are counted."""

from typing import Any

import pytest
from fake_link import UNANSWERED, FakeLink
from refused import refused

from zsim.contract import keys
from zsim.contract.framing import GateMessages, decode_batch, encode_batch, key_table, pairs_of
from zsim.contract.run_messages import ControlAnswer
from zsim.errors import DecodeError, NoWorldError
from zsim.transport.session import ReceivedSample
from zsim.transport.traffic import Traffic, replay, samples

DRONES = ["d1"]
GATE = GateMessages.of(20, 1, key_table(DRONES), [(keys.truth("d1"), b"truth"), (keys.status("d1"), b"status")])


def passed(*payloads: bytes) -> tuple[list[Any], int]:
    """Return what arrives from these batches, and the number of refusals."""
    refusals: list[None] = []
    link: Any = FakeLink()
    traffic = Traffic(link, key_table(DRONES), lambda: refusals.append(None))
    for payload in payloads:
        link.deliver(keys.BATCH, payload)
    return list(traffic.drain()), len(refusals)


def test_messages_and_gates_arrive_in_the_order_they_were_sent() -> None:
    arrived, refused = passed(encode_batch([("clock", b"1"), (keys.GATE, GATE.pack()), ("my/own", b"2")]))
    assert arrived[0] == ReceivedSample("clock", b"1")
    assert arrived[1].pairs == GATE.pairs
    assert list(samples(arrived))[1:] == [*GATE.pairs, ("my/own", b"2")]
    assert refused == 0


@pytest.mark.parametrize("garbage", [b"", b"\xc1", encode_batch([(keys.GATE, b"\xc1")])])
def test_unreadable_payloads_are_counted_and_the_rest_arrives(garbage: bytes) -> None:
    arrived, refused = passed(garbage, encode_batch([("clock", b"1")]))
    assert (arrived, refused) == ([ReceivedSample("clock", b"1")], 1)


def test_a_reader_can_be_woken() -> None:
    link: Any = FakeLink()
    traffic = Traffic(link, key_table(DRONES))
    traffic.wake()
    assert traffic.receive() == []


# The pages of a replay


def pages(link: FakeLink, *answers: ControlAnswer) -> list[tuple[str, bytes]]:
    left = iter(answers)
    link.on_request = lambda key, args: next(left)
    return list(replay(link, "quiet.one", 7, ["**"], 1.0))  # type: ignore[arg-type]


def test_a_replay_continues_until_the_last_page():
    link = FakeLink()
    first, second = ControlAnswer(True, result=[["a", b"1"]], more=41), ControlAnswer(True, result=[["b", b"2"]])
    assert pages(link, first, second) == [("a", b"1"), ("b", b"2")]
    assert link.requests == [
        (keys.replay("quiet.one"), {"from_ns": 7, "keys": ["**"], "page": page}) for page in (0, 41)
    ]


NO_PAIRS = [None, 7, "text", [1], [["a"]], [["a", "dGV4dA=="]], [["a", b"1", b"2"]], {"a": b"1"}, [[b"a", b"1"]]]


@pytest.mark.parametrize("result", NO_PAIRS)
def test_a_result_that_is_not_a_list_of_pairs_is_refused(result: Any):
    with refused(DecodeError, "list", "[key, payload]"):
        pairs_of(result)
    with refused(NoWorldError, "replay"):
        pages(FakeLink(), ControlAnswer(True, result=result))


def test_a_missing_answer_is_reported():
    with pytest.raises(NoWorldError, match="nobody answered"):
        pages(FakeLink(), UNANSWERED)


@pytest.mark.parametrize("payload", [b"\x91\x92\xa1\xff\xc4\x00", b"\x91" * 5000 + b"\xc0", b"\xc1", b""])
def test_an_invalid_batch_is_refused(payload: bytes):
    with refused(DecodeError, "@batch", "list"):
        decode_batch(payload)
