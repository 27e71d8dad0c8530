"""How many pictures a second a page is sent."""

FEW_DRONES = 20  # drones from which on pictures come half as often
RATE_HZ, RATE_LOW_HZ = 20.0, 10.0
FAST_RATE = 4.0  # x real time; from then on the rate is halved, too: the run needs the processors


def picture_rate_hz(drones: int, rate: float) -> float:
    """Return how many pictures a second suit so many drones, and a run that goes so many times as fast as real time."""
    return RATE_LOW_HZ if drones >= FEW_DRONES or rate >= FAST_RATE else RATE_HZ
