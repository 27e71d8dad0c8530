"""Places and mixing of a cross of four are constants of the code: those of its vehicles, and of no others."""

from typing import Literal

import numpy as np
import pytest
from msgspec.structs import replace
from vehicle_rows import one_drone

from zsim.vehicles.vehicle import Rotor, Vehicle
from zsim.vehicles.vehicle_catalogue import STOCK, vehicle_of
from zsim_world.physics.fleet_arrays import CROSS_ROTORS, ROTOR, mixed, of, place, rotor_slots


def plus() -> Vehicle:
    """Return a vehicle with rotors ahead, on the right, behind and on the left."""
    ends: tuple[tuple[str, float, float, Literal[-1, 1]], ...] = (
        ("ahead", 1.0, 0.0, 1), ("right", 0.0, -1.0, -1), ("behind", -1.0, 0.0, 1), ("left", 0.0, 1.0, -1)
    )  # fmt: skip
    vehicle = STOCK["ardrone2"]
    arm_m = vehicle.arm_m
    rotors = tuple(Rotor(name=name, x_m=arm_m * x, y_m=arm_m * y, turn=turn) for name, x, y, turn in ends)
    return replace(vehicle, rotors=rotors)


@pytest.mark.parametrize("model", STOCK)
def test_the_constants_are_those_of_the_stock_vehicles(model: str):
    _, rotors = one_drone(model=model)
    assert len(rotors.each) == CROSS_ROTORS
    for r in rotors.each:
        assert place(rotors, r) == tuple(of(rotors, group, r) for group in (ROTOR.x, ROTOR.y, ROTOR.turn))
        groups = (ROTOR.roll, ROTOR.pitch, ROTOR.yaw, ROTOR.yaw_inverse)
        assert mixed(rotors, r) == tuple(of(rotors, group, r) for group in groups)


def test_other_vehicles_have_places_of_their_own():
    stock = list(STOCK.values())
    assert rotor_slots(stock) == CROSS_ROTORS
    assert rotor_slots([*stock, plus()]) == CROSS_ROTORS + 1
    assert rotor_slots([*stock, vehicle_of("hexacopter")]) == 6
    _, rotors = one_drone(model="hexacopter")
    assert np.array(place(rotors, 0)).tolist() == [of(rotors, group, 0) for group in (ROTOR.x, ROTOR.y, ROTOR.turn)]
