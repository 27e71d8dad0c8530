"""Well-formed messages with any values: no exception, and what is answered can be packed."""

import math
import random
from typing import Any, get_type_hints

import pytest
from mavlink_drone import FlownDrone

from zsim.contract import messages
from zsim.contract.flight_messages import Attitude, Velocity
from zsim_bridges.mavlink.wire.frame import Link, Parser
from zsim_bridges.mavlink.wire.wire_message import BY_ID, WireMessage

ODD = (math.nan, math.inf, -math.inf, 0.0, 1.0, -1.0, 1e30, -1e30, 400.0, 3.0)
BITS = {"uint8_t": 8, "int8_t": 7, "uint16_t": 16, "int16_t": 15, "uint32_t": 32, "int32_t": 31, "uint64_t": 64}
ADDRESSES = ("target_system", "target_component", "target")
COMMANDS = (16, 17, 19, 20, 21, 22, 93, 115, 176, 177, 178, 179, 185, 192, 193, 224, 246, 300, 400, 410, 511, 512)


def odd_element(c_type: str, rng: random.Random) -> Any:
    if c_type in ("float", "double"):
        return rng.choice((*ODD, rng.uniform(-200.0, 200.0)))
    return rng.choice((0, 1, rng.getrandbits(4), rng.getrandbits(BITS.get(c_type, 63))))


def odd_value(name: str, c_type: str, rng: random.Random) -> Any:
    element, _, length = c_type.rstrip("]").partition("[")
    if name in ADDRESSES:
        return rng.choice((0, 1))
    if name == "command":
        return rng.choice(COMMANDS)
    if element == "char":
        return rng.choice(("WPNAV_SPEED", "MPC_XY_VEL_MAX", "x" * int(length)))
    if not length:
        return odd_element(element, rng)
    if element == "uint8_t":
        return rng.randbytes(int(length))
    return tuple(odd_element(element, rng) for _ in range(int(length)))


def odd_message(rng: random.Random) -> WireMessage:
    kind = BY_ID[rng.choice(list(BY_ID))].kind
    hints = get_type_hints(kind, include_extras=True)
    values = (odd_value(name, hints[name].__metadata__[0], rng) for name in kind.__struct_fields__)
    return kind(*values)


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
def test_any_values_are_survived(autopilot: str) -> None:
    fly_at_random(autopilot, 17, 3_000)


@pytest.mark.soak
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_any_values_are_survived_for_long(autopilot: str) -> None:
    fly_at_random(autopilot, 18, 200_000)
