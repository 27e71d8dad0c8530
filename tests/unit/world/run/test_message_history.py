"""The history: last values, replays, bounded memory, and missing outputs of a participant."""

import pytest
from msgspec import Struct
from small_world import events_of, small_world

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Velocity
from zsim.contract.run_messages import Clock, Done
from zsim.runtime.membership import HealthMeter
from zsim.transport.session import ReceivedSample
from zsim_world.run.inputs import KEEP_NS, MessageHistory, Run, Taken

SECOND_NS = 1_000_000_000
IMU = keys.sensor("d1", "imu")
VELOCITY = keys.command("d1", "velocity")


def since(history: MessageHistory, from_ns: int, expressions: list[str]) -> list[tuple[str, bytes]]:
    """Return all pages of messages with a later time stamp."""
    messages, start = [], 0
    while start is not None:
        passed, start = history.page(from_ns, lambda key: any(keys.matches(e, key) for e in expressions), start)
        messages += passed
    return messages


def clock(history: MessageHistory, t_ns: int) -> None:
    history.add(keys.CLOCK, b"tick", t_ns)


def test_the_last_values_of_an_expression_are_returned_however_old():
    history = MessageHistory()
    for payload in (b"old", b"new"):
        for key in ("drone/d1/truth", "drone/d2/truth", "drone/d1/estimate"):
            history.add(key, payload, 0)
    clock(history, 100 * SECOND_NS)
    assert history.last("drone/d1/truth") == [("drone/d1/truth", b"new")]
    assert sorted(history.last("drone/*/truth")) == [("drone/d1/truth", b"new"), ("drone/d2/truth", b"new")]
    assert len(history.last("**")) == 4
    assert history.last("drone/d3/truth") == since(history, -1, ["drone/**"]) == []


def test_a_replay_returns_later_messages_in_order_of_arrival():
    history = MessageHistory()
    for t_ns in (1, 3, 2, 4):
        history.add(IMU, b"%d" % t_ns, t_ns)
        history.add("drone/d2/truth", b"other", t_ns)
    assert [payload for _, payload in since(history, 1, ["drone/d1/**"])] == [b"3", b"2", b"4"]
    assert since(history, 4, ["**"]) == since(history, -1, []) == []
    assert len(since(history, 3, ["drone/**", "**", IMU])) == 2  # each message once


def test_messages_older_than_the_window_are_forgotten():
    history = MessageHistory()
    for second in range(20):
        clock(history, second * SECOND_NS)
        history.add(IMU, b"%d" % second, second * SECOND_NS)
    kept = [int(payload) for _, payload in since(history, -1, [IMU])]
    assert kept == list(range(19 - KEEP_NS // SECOND_NS, 20))


def test_a_message_from_the_future_neither_evicts_others_nor_stays_forever():
    history = MessageHistory()
    clock(history, 10 * SECOND_NS)
    history.add(IMU, b"mine", 10 * SECOND_NS)
    history.add("drone/d1/cmd/mode", b"from the future", 2**63 - 1)
    clock(history, 11 * SECOND_NS)
    assert [payload for _, payload in since(history, 0, [IMU])] == [b"mine"]
    clock(history, 100 * SECOND_NS)
    assert since(history, -1, ["drone/**"]) == []


def test_memory_is_bounded_while_time_stands_still():
    history = MessageHistory(keep_bytes=1000)
    for number in range(100):
        history.add(IMU, b"%0100d" % number, 0)
    assert [int(payload) for _, payload in since(history, -1, [IMU])] == list(range(90, 100))


def test_foreign_messages_evict_no_others_and_have_room_of_their_own(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("zsim_world.run.inputs.FOREIGN_BYTES", 250)
    history = MessageHistory(keep_bytes=1000)
    history.add(IMU, b"first", 0)
    for number in range(100):
        history.add_foreign("lab/camera", b"%0100d" % number)
    assert [key for key, _ in since(history, -1, ["**"])] == [IMU, "lab/camera", "lab/camera"]
    clock(history, 2 * KEEP_NS)
    history.add_foreign("lab/camera", b"new")
    assert since(history, -1, ["lab/**"]) == [("lab/camera", b"new")]


def test_pages_return_everything_once_and_in_order():
    history = MessageHistory(page_bytes=10)
    published = [(IMU, bytes([number]) * (number % 5 + 1)) for number in range(50)]
    published += [(IMU, b"x" * 30), (IMU, b"y")]  # longer than a page
    for number, (key, payload) in enumerate(published):
        history.add(key, payload, number)
        history.add("drone/d2/truth", b"another's", number)
    assert since(history, -1, [IMU]) == published
    first, _ = history.page(-1, lambda key: key == IMU)
    assert sum(len(payload) for _, payload in first) <= 10
    assert first == published[: len(first)]


def test_a_page_continues_the_last_one_even_if_old_messages_are_dropped():
    history = MessageHistory(keep_bytes=20, page_bytes=4)
    for number in range(20):
        history.add(IMU, bytes([number]), number)
    passed, more = history.page(-1, lambda key: True)
    for number in range(20, 22):
        history.add(IMU, bytes([number]), number)
    assert more is not None
    assert [payload[0] for _, payload in (*passed, *history.page(-1, lambda key: True, more)[0])] == [*range(8)]


# Lost outputs


def command(t_ns: int, seq: int, source: str = "a.b", speed: float = 0.0) -> Velocity:
    return Velocity(t_ns, seq, source, (speed, 0.0, 0.0), 0.0)


def kept(*outputs: Struct, key: str = VELOCITY) -> list[list[object]]:
    return [[key, messages.encode(output)] for output in outputs]


def history_of(*came: Velocity) -> MessageHistory:
    made = MessageHistory()
    for each in came:
        made.add(VELOCITY, messages.encode(each), each.t_ns)
    return made


def samples(*outputs: Velocity) -> list[ReceivedSample]:
    return [ReceivedSample(VELOCITY, messages.encode(output)) for output in outputs]


ONE, TWO, THREE = (command(t_ns, t_ns) for t_ns in (1, 2, 3))


@pytest.mark.parametrize(
    ("came", "has_kept", "done_ns", "lost"),
    [
        ((TWO,), (ONE, TWO, THREE), 3, (ONE, THREE)),
        ((), (TWO, THREE), 2, (TWO,)),  # the next done will count the other
        ((), (ONE, ONE), 1, (ONE,)),
        ((command(1, 1, "c.d"),), (ONE,), 1, (ONE,)),
        ((command(1, 2),), (ONE,), 1, (ONE,)),
    ],
    ids=["some", "on its way", "kept twice", "another source's", "of another number"],
)
def test_outputs_that_have_not_arrived_are_found(
    came: tuple[Velocity, ...], has_kept: tuple[Velocity, ...], done_ns: int, lost: tuple[Velocity, ...]
):
    assert history_of(*came).lost_outputs(kept(*has_kept), done_ns) == samples(*lost)


def test_only_readable_outputs_are_accepted():
    done = kept(Done(1, 1, "r", 1, 1, 0), key="process/a.b/done")
    assert (
        history_of().lost_outputs([*done, [VELOCITY, b"\xc1"], [keys.estimate("d1"), b"\x80"], ["of/mine", b""]], 1)
        == []
    )


@pytest.mark.parametrize("payload", [b"\xc1", messages.encode(Clock(0, 9, "run1", 0, "running", 1.0))])
@pytest.mark.parametrize("key", [keys.CLOCK, keys.EVENT, keys.INFO, keys.sensor("d1", "status")])
def test_a_message_posing_as_the_world_s_is_refused_and_not_replayed(key: str, payload: bytes):
    """A process that rejoins takes replayed messages to be the world's."""
    run = Run(small_world(), HealthMeter("world"))
    run.world.take_outbox()
    run.enter(Taken(0, (key, payload)))
    assert [each.kind for each in events_of(run.world)] == ["refused"]
    assert (run.health.refused, run.history.passed, since(run.history, -1, ["**"])) == (1, [], [])
