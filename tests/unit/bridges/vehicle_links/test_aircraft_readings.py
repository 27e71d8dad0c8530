"""The clock of an aircraft by its least delayed messages, and the loss of its stream."""

import random

import pytest

from zsim_bridges.vehicle_links.vehicle_session import ClockOffset, StreamLoss

MS = 1_000_000


def test_the_least_delayed_message_counts():
    offset, draw = ClockOffset(), random.Random(1)
    for k in range(500):
        sent_ns = k * 20 * MS
        offset.add(sent_ns - 7_000 * MS, sent_ns + round(draw.expovariate(1 / (5 * MS))))
    assert 0 <= offset.offset_ns - 7_000 * MS < 0.2 * MS
    assert offset.to_local(0) == offset.offset_ns
    assert offset.to_remote(offset.to_local(123)) == 123


def test_a_clock_that_is_set_is_followed_within_a_window():
    offset = ClockOffset()
    offset.add(0, 10 * MS)
    offset.add(100 * MS, 10_110 * MS)
    assert offset.offset_ns == 10_010 * MS


def test_half_a_round_trip_is_the_way_of_the_fastest():
    offset = ClockOffset()
    offset.add(0, 30 * MS)
    for duration_ms in (50, 20, 40):
        offset.add_round_trip(duration_ms * MS, 100 * MS)
    assert offset.round_trip_ms == 20
    assert offset.offset_ns == 20 * MS


@pytest.mark.parametrize("known", [False, True])
def test_it_is_known_from_the_first_message_on(known: bool):
    offset = ClockOffset()
    if known:
        offset.add(5, 5)
    assert (offset.ahead_ms is not None) is known
    assert offset.offset_ns == 0


def test_the_share_that_is_lost_is_counted_over_the_wrap():
    draw, loss = random.Random(3), StreamLoss(256)
    for number in range(4000):
        if draw.random() > 0.1:
            loss.add(number % 256)
    assert loss.percent == pytest.approx(10, abs=2.5)
    assert not loss.add(3999 % 256)
