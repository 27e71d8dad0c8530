"""Fly a drone with the unmodified ardrone-sdk, which starts the video first: take off, move, hover, land."""

import json
import sys
import time
from collections.abc import Callable

import ardrone

LANDED, FLYING, HOVERING = 2, 3, 4  # upper half of ctrl_state
PERIOD_S, LATE_S = 0.05, 100.0


def main(host: str) -> None:
    """Fly, and print a line of JSON for each stage."""
    drone = ardrone.ARDrone(host)
    try:
        _until(lambda: "demo" in drone.navdata)
        drone.takeoff()  # sent once, as its users do
        _until(lambda: _state(drone) == HOVERING)
        print(json.dumps({"event": "hovering", "altitude_mm": drone.navdata["demo"]["altitude"]}), flush=True)
        drone.set_speed(0.5)
        drone.move_forward()  # sent once; the drone moves on until another command
        _until(lambda: drone.navdata["demo"]["vx"] > 700.0)
        print(json.dumps({"event": "flying", "theta": drone.navdata["demo"]["theta"]}), flush=True)
        drone.hover()
        _until(lambda: _state(drone) == HOVERING and abs(drone.navdata["demo"]["vx"]) < 200.0)
        drone.land()
        _until(lambda: _state(drone) == LANDED)
        print(json.dumps({"event": "landed", "fly": drone.navdata["state"]["fly"]}), flush=True)
    finally:
        drone.halt()


def _state(drone: ardrone.ARDrone) -> int:
    return drone.navdata["demo"]["ctrl_state"] >> 16


def _until(reached: Callable[[], bool]) -> None:
    until_s = time.monotonic() + LATE_S
    while not reached():
        if time.monotonic() > until_s:
            raise SystemExit("too late")
        time.sleep(PERIOD_S)


if __name__ == "__main__":
    main(sys.argv[1])
