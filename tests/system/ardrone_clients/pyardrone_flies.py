"""Fly a drone with the unmodified pyardrone, and print its navdata and pictures: take off, climb, turn, hover, land."""

import json
import os
import sys
import threading
import time

from pyardrone import ARDrone, at

LANDED, FLYING, HOVERING = 2, 3, 4  # upper half of ctrl_state
PERIOD_S, LATE_S = 0.03, 100.0
BLACK = 20  # mean pixel value up to which a picture counts as black


def main(host: str) -> None:
    """Fly, and print a line of JSON for each stage."""
    drone = ARDrone(host=host)
    drone.navdata_ready.wait()
    drone.send(at.CONFIG("general:navdata_demo", "TRUE"))
    _until(drone, lambda: hasattr(drone.navdata, "demo"))
    _show(drone, "connected")
    _until(drone, lambda: _state(drone) == HOVERING, drone.takeoff)
    _show(drone, "hovering")
    _until(drone, lambda: drone.navdata.demo.altitude > 1400, lambda: drone.move(up=1))
    psi = drone.navdata.demo.psi
    _until(drone, lambda: _turned(drone.navdata.demo.psi - psi) > 60e3, lambda: drone.move(cw=1))
    _show(drone, "turned")
    _until(drone, lambda: _state(drone) == HOVERING, drone.hover)
    _until(drone, lambda: drone.video_ready.is_set() and drone.frame is not None and drone.frame.mean() > BLACK)
    print(json.dumps({"event": "picture", "shape": drone.frame.shape}), flush=True)
    _until(drone, lambda: _state(drone) == LANDED, drone.land)
    _show(drone, "landed")
    sys.stdout.flush()
    os._exit(0)  # its video threads never end


def _turned(angle_mdeg: float) -> float:
    return (angle_mdeg + 180e3) % 360e3 - 180e3


def _state(drone: ARDrone) -> int:
    return drone.navdata.demo.ctrl_state >> 16


def _until(drone: ARDrone, reached, act=lambda: None) -> None:
    """Repeat a command, as pilots' programs do, until a condition holds."""
    until_s = time.monotonic() + LATE_S
    while not reached():
        if time.monotonic() > until_s:
            print(json.dumps({"event": "late", "state": str(drone.navdata)[:500]}), flush=True)
            os._exit(1)
        act()
        time.sleep(PERIOD_S)


def _show(drone: ARDrone, event: str) -> None:
    demo = drone.navdata.demo
    seen = {"state": demo.ctrl_state >> 16, "altitude_mm": demo.altitude, "battery": demo.vbat_flying_percentage}
    print(json.dumps({"event": event, "fly_mask": bool(drone.state.fly_mask), **seen}), flush=True)


threading.excepthook = lambda args: print(json.dumps({"event": "thread died", "text": repr(args)}), flush=True)
main(sys.argv[1])
