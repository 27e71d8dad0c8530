"""The history: last values for who asks, the last seconds for who must catch up, and never more than its share."""

from zsim import keys
from zsim_world.history import KEEP_NS, History

SECOND_NS = 1_000_000_000
IMU = keys.sensor("d1", "imu")


def clock(history: History, t_ns: int) -> None:
    history.add(keys.CLOCK, b"tick", t_ns)


def test_the_last_value_of_a_key_is_answered():
    history = History()
    history.add("drone/d1/truth", b"old", 0)
    history.add("drone/d1/truth", b"new", 1)
    assert history.last("drone/d1/truth") == [("drone/d1/truth", b"new")]
    assert history.last("drone/d2/truth") == []


def test_the_last_values_of_an_expression_are_answered():
    history = History()
    for key in ("drone/d1/truth", "drone/d2/truth", "drone/d1/estimate", "clock"):
        history.add(key, key.encode(), 0)
    assert sorted(history.last("drone/*/truth")) == [
        ("drone/d1/truth", b"drone/d1/truth"),
        ("drone/d2/truth", b"drone/d2/truth"),
    ]
    assert len(history.last("**")) == 4


def test_the_last_value_outlives_what_a_replay_brings():
    history = History()
    history.add("drone/d1/truth", b"x", 0)
    clock(history, 100 * SECOND_NS)
    assert history.last("drone/d1/truth") == [("drone/d1/truth", b"x")]
    assert list(history.since(-1, ["drone/**"])) == []


def test_a_replay_brings_what_was_stamped_later_in_order_of_arrival():
    history = History()
    for t_ns in (1, 3, 2, 4):
        history.add(IMU, b"%d" % t_ns, t_ns)
        history.add("drone/d2/truth", b"other", t_ns)
    assert [payload for _, payload in history.since(1, ["drone/d1/**"])] == [b"3", b"2", b"4"]
    assert list(history.since(4, ["**"])) == []
    assert list(history.since(-1, [])) == []


def test_a_message_that_several_expressions_take_comes_once():
    history = History()
    history.add(IMU, b"x", 5)
    assert list(history.since(0, ["drone/**", "**", IMU])) == [(IMU, b"x")]


def test_what_is_older_than_the_window_is_forgotten():
    history = History()
    for second in range(20):
        clock(history, second * SECOND_NS)
        history.add(IMU, b"%d" % second, second * SECOND_NS)
    kept = [int(payload) for _, payload in history.since(-1, [IMU])]
    assert kept == list(range(19 - KEEP_NS // SECOND_NS, 20))


def test_a_sender_s_stamp_does_not_push_out_what_others_said():
    history = History()
    clock(history, 10 * SECOND_NS)
    history.add(IMU, b"mine", 10 * SECOND_NS)
    history.add("drone/d1/cmd/mode", b"from the future", 2**63 - 1)
    clock(history, 11 * SECOND_NS)
    assert [payload for _, payload in history.since(0, [IMU])] == [b"mine"]


def test_a_sender_s_stamp_does_not_keep_its_message_for_ever():
    history = History()
    history.add("drone/d1/cmd/mode", b"from the future", 2**63 - 1)
    clock(history, 100 * SECOND_NS)
    assert list(history.since(-1, ["drone/**"])) == []


def test_memory_is_bounded_while_time_stands_still():
    history = History(keep_bytes=1000)
    for number in range(100):
        history.add(IMU, b"%0100d" % number, 0)
    assert [int(payload) for _, payload in history.since(-1, [IMU])] == list(range(90, 100))
