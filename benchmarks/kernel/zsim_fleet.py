"""zsim's fleet with firmware, all sensors, noise, wind, downwash and contacts; or its compiled kernel alone (`--bare`).

Physics every 2.5 ms by fourth-order Runge-Kutta, firmware and IMU every 5 ms, one call per gate of 20 ms. The fleet
draws its noise and returns samples and truth as arrays; the bare kernel reuses the same noise and returns nothing.
"""

import argparse
from itertools import count as counting
from typing import Any

from benchmarks.grid import scenario
from benchmarks.kernel.stopwatch import Flight, serve, single
from zsim_world.fleet import kernel
from zsim_world.fleet.fleet import NOISE_GATES, Fleet

CLIMB_GATES = 300  # 6 s, by when the drones have taken off
LONG_S = 1e6  # s, simulated: longer than any measurement
CHARGE_MAH = 1e5  # 20 h of hovering: no battery runs empty during the measurements


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--bare", action="store_true")
    bare = parser.parse_args().bare
    single()
    serve(lambda count: bare_kernel(count) if bare else fleet(count))


def fleet(count: int) -> Flight:
    """Return a hovering fleet, advanced as the world advances it."""
    made = _airborne(count)

    def advance() -> Any:
        made.advance()
        return made.sampled, made.truth()

    return Flight(advance, 0.02)


def bare_kernel(count: int) -> Flight:
    """Return a hovering fleet of which only the compiled kernel is run."""
    made = _airborne(count)
    gates = counting()

    def advance() -> None:
        if next(gates) % NOISE_GATES == 0:
            made._noise.cursor[:] = 0
        kernel.advance(made._held, made._ticks)

    return Flight(advance, 0.02)


def _airborne(count: int) -> Fleet:
    made = Fleet(scenario(count, LONG_S, cluster=0, drone={"battery_mah": CHARGE_MAH}))
    for i in range(count):
        refused = made.takeoff(i)
        assert refused is None, refused
    for _ in range(CLIMB_GATES):
        made.advance()
    assert all(made.truth().position_m[:, 2] > 0.5), "not in the air"
    return made


if __name__ == "__main__":
    main()
