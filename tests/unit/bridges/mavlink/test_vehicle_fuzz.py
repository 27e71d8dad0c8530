"""Well-formed messages with arbitrary values cause no exception, and every answer can be packed."""

import math
import random
from typing import Any

import pytest
from mavlink_drone import FlownDrone
from mavlink_values import field_value

from zsim.contract import messages
from zsim.contract.flight_messages import Attitude, Velocity
from zsim_bridges.mavlink.dialect import BY_ID, Link, Parser, WireMessage

ODD = (math.nan, math.inf, -math.inf, 0.0, 1.0, -1.0, 1e30, -1e30, 400.0, 3.0)
BITS = {"B": 8, "b": 7, "H": 16, "h": 15, "I": 32, "i": 31, "Q": 64, "q": 63}
ADDRESSES = ("target_system", "target_component", "target")
COMMANDS = (16, 17, 19, 20, 21, 22, 93, 115, 176, 177, 178, 179, 185, 192, 193, 224, 246, 300, 400, 410, 511, 512)


def odd_message(rng: random.Random) -> WireMessage:
    def element(code: str) -> Any:
        if code in "fd":
            return rng.choice((*ODD, rng.uniform(-200.0, 200.0)))
        return rng.choice((0, 1, rng.getrandbits(4), rng.getrandbits(BITS[code])))

    def text(length: int) -> str:
        return rng.choice(("WPNAV_SPEED", "MPC_XY_VEL_MAX", "x" * length))

    layout = BY_ID[rng.choice(list(BY_ID))]
    values = {field.name: field_value(field, element, text, rng) for field in layout.fields}
    values |= {name: rng.choice((0, 1)) for name in ADDRESSES if name in values}
    if "command" in values:
        values["command"] = rng.choice(COMMANDS)
    return layout.kind(**values)


def fly_at_random(autopilot: str, seed: int, count: int) -> None:
    rng, drone = random.Random(seed), FlownDrone(autopilot)
    theirs, ours, parser = Link(255, 190), Link(1, 1), Parser()
    for i in range(count):
        for received in parser.feed(theirs.pack(odd_message(rng))):
            drone.vehicle.on_message(received, i * 10_000_000)
        if i % 5 == 0:
            drone.step()
        drone.vehicle.tick(i * 10_000_000)
        for message in [*drone.vehicle.take(), *drone.sent]:
            ours.pack(message)
        drone.sent.clear()
        for command in drone.commands:
            messages.encode(command)
            if isinstance(command, Velocity | Attitude):
                assert math.isfinite(command.yaw_rate_rad_s)
        if len(drone.commands) > 100:
            drone.commands.clear()
            drone._handled = 0
    assert not +parser.refused


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_a_vehicle_survives_messages_with_any_values(autopilot: str) -> None:
    fly_at_random(autopilot, 17, 3_000)


@pytest.mark.soak
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_a_vehicle_survives_many_messages_with_any_values(autopilot: str) -> None:
    fly_at_random(autopilot, 18, 200_000)
