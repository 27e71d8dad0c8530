"""The health of a process: due once per second of wall time, with percentiles of its newest steps."""

import os
import sys

import pytest

from zsim.runtime.membership import STEPS_KEPT, HealthMeter, resident_bytes


class WallClock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_health_is_due_once_per_second_of_wall_time():
    clock = WallClock()
    meter = HealthMeter("estimator", clock)
    assert not meter.due()
    clock.now_s += 0.999
    assert not meter.due()
    clock.now_s += 0.001
    assert meter.due()
    assert not meter.due()
    clock.now_s += 10.0
    assert meter.due()
    assert not meter.due()


def test_a_health_message_has_identity_and_counts():
    meter = HealthMeter("estimator", WallClock())
    meter.received, meter.refused, meter.dropped, meter.lag_ns = 9, 3, 2, 40
    message = meter.message(7, 1)
    assert (message.t_ns, message.seq, message.role, message.pid) == (7, 1, "estimator", os.getpid())
    assert (message.received, message.refused, message.dropped, message.lag_ns) == (9, 3, 2, 40)
    assert message.step_us == {"p50": 0.0, "p99": 0.0}


def test_percentiles_are_of_the_newest_steps():
    meter = HealthMeter("estimator", WallClock())
    for _ in range(STEPS_KEPT):
        meter.step(10**9)
    for step_us in range(STEPS_KEPT):
        meter.step(step_us * 1000)
    found = meter.message(0, 0).step_us
    assert found == pytest.approx({"p50": 500.0, "p99": 990.0})


@pytest.mark.skipif(sys.platform != "linux", reason="read from /proc")
def test_resident_bytes_measures_this_process():
    before = resident_bytes()
    held = bytearray(64 << 20)
    held[::4096] = b"x" * len(held[::4096])
    assert resident_bytes() - before > 32 << 20
