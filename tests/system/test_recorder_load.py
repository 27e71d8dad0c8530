"""The recorder with all messages of 50 drones: none is missing by the `seq` of each key."""

import pytest

from benchmarks.recorder import DRONES, Flown, fly

RATES_HZ = (
    200 + 5 + 25 + 25 + 25 + 15 + 4 * 50
)  # per drone: sensors, then status, truth, estimate and command at every gate
SHARE = 0.6  # minimum share of these messages: commands begin only with the flight


def complete(flown: Flown, seconds: float) -> None:
    """Check that no message is missing."""
    assert flown.faults == {}
    assert flown.missing == 0
    assert flown.sim_s == pytest.approx(seconds)
    assert flown.messages > SHARE * RATES_HZ * DRONES * seconds


@pytest.mark.soak
def test_five_seconds_at_full_speed_are_recorded_without_a_gap(compiled: None) -> None:
    complete(fly(DRONES, 5.0), 5.0)


@pytest.mark.soak
@pytest.mark.parametrize("options", [(), ("--realtime",)], ids=["lockstep", "realtime"])
def test_two_minutes_are_recorded_without_a_gap(compiled: None, options: tuple[str, ...]) -> None:
    flown = fly(DRONES, 120.0, *options)
    print(
        f"\n{' '.join(options) or 'lockstep'}: {100 * flown.cpu_s / flown.wall_s:.0f} % of a core, "
        f"{flown.timed_messages / flown.wall_s:.0f} messages/s, {flown.timed_bytes / flown.wall_s / 1e6:.1f} MB/s"
    )
    complete(flown, 120.0)
