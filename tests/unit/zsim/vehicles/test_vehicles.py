"""Vehicles as data: stock ones are valid, and an invalid one is refused in one line."""

import math
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from refused import faults_of, has_terms

from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import VEHICLE_NUMBERS
from zsim.vehicles import ardrone2, crazyflie2
from zsim.vehicles.vehicle import MODELS, Rotor, Vehicle, allocation, cross_layout, lift_shares, mixing, vehicle_of


def document(**drone: Any) -> dict[str, Any]:
    return {"name": "t", "duration_s": 1, "drones": [{"name": "a", "position_m": [0, 0, 0], **drone}]}


STOCK = {"ardrone2": ardrone2, "crazyflie2": crazyflie2}


def fault_of(**drone: Any) -> str:
    (line,) = faults_of(document(**drone))
    return line


@pytest.mark.parametrize("model", MODELS)
def test_a_drone_takes_the_values_of_its_stock_vehicle(model: str):
    vehicle = vehicle_of(model)
    drone = scenario_file.resolve(document(model=model)).drones[0]
    assert {name: getattr(drone, name) for name in VEHICLE_NUMBERS} == {
        name: getattr(vehicle, name) for name in VEHICLE_NUMBERS
    }
    assert drone.limits == vehicle.limits
    assert drone.sensors.preset == vehicle.sensor_preset


@pytest.mark.parametrize("model", MODELS)
def test_every_value_of_a_stock_vehicle_has_a_source_or_reason(model: str):
    text = Path(str(STOCK[model].__file__)).read_text()
    numbers = [line for line in text.splitlines() if re.match(r"\s+\w+=\(?-?[\d.]", line)]
    assert len(numbers) > 30
    assert [line for line in numbers if "#" not in line] == []


def test_a_drone_overrides_its_vehicle_field_by_field():
    drone = scenario_file.resolve(document(model="crazyflie2", mass_kg=0.035, limits={"tilt_deg": 12})).drones[0]
    assert (drone.mass_kg, drone.arm_m) == (0.035, 0.0397)
    assert (drone.limits.tilt_deg, drone.limits.horizontal_speed_m_s) == (12.0, 2.0)


def test_a_resolved_scenario_is_read_without_the_module_of_its_model():
    hexacopter = scenario_file.resolve(document(model="hexacopter"))
    assert hexacopter.drones[0].thrust_n_s2 == pytest.approx(8.048e-6 * 2 / 3)
    text = scenario_file.to_text(hexacopter)
    other = scenario_file.from_text(text.replace("hexacopter", "not_here.at_all"))
    assert other.drones[0].model == "not_here.at_all"


def test_a_rotor_fault_must_name_a_rotor_of_the_vehicle():
    fault = {"kind": "rotor_stuck", "target": "a", "at_s": 1, "rotor": "rotor3"}
    assert scenario_file.resolve(document(model="hexacopter") | {"faults": [fault]}).faults
    resolved = scenario_file.to_text(scenario_file.resolve(document(model="hexacopter") | {"faults": [fault]}))
    assert scenario_file.from_text(resolved.replace("hexacopter", "not_here.at_all")).faults  # as read by an agent
    for model, rotor in (("hexacopter", "front_left"), ("ardrone2", "rotor3"), ("crazyflie2", "rotor3")):
        with pytest.raises(ScenarioError) as error:
            scenario_file.resolve(document(model=model) | {"faults": [fault | {"rotor": rotor}]})
        (line,) = error.value.faults
        names = vehicle_of(model).rotor_names
        for part in ("faults[0].rotor", repr(rotor), ", ".join((*names, "all"))):
            assert part in line


@pytest.mark.parametrize("model", ["ardrone_9", "no_such.module", "3d", "a/b"])
def test_an_unknown_model_is_reported_with_drone_value_and_known_models(model: str):
    line = fault_of(model=model)
    for part in ("drones[0].model", repr(model), "ardrone2, crazyflie2", "(drone 'a')"):
        assert part in line


@pytest.mark.parametrize(
    ("contents", "found"),
    [
        ({}, "no VEHICLE"),
        ({"VEHICLE": 3}, "'int'"),
        ({"VEHICLE": replace(ardrone2.VEHICLE, mass_kg=-1.0)}, "VEHICLE.mass_kg is -1.0"),
    ],
)
def test_a_module_without_a_valid_vehicle_is_refused(monkeypatch: pytest.MonkeyPatch, contents: Any, found: str):
    module = ModuleType("my_plane")
    vars(module).update(contents)
    monkeypatch.setitem(sys.modules, "my_plane", module)
    line = fault_of(model="my_plane")
    assert has_terms(line, "drones[0].model", "'my_plane'")
    assert found in line
    vehicle_of.cache_clear()


def with_rotors(*rotors: Rotor) -> Vehicle:
    arm_m = max(math.hypot(rotor.x_m, rotor.y_m) for rotor in rotors)
    return replace(ardrone2.VEHICLE, arm_m=arm_m, rotors=rotors)


CROSS = cross_layout(0.2)


@pytest.mark.parametrize(
    ("rotors", "text"),
    [
        (CROSS[:3], "rotors"),
        ((*CROSS[:3], CROSS[0]), "rotors"),
        ((*CROSS[:3], replace(CROSS[3], x_m=0.5)), "rotors"),
        (tuple(replace(rotor, y_m=0.0) for rotor in CROSS), "rotors"),
        (tuple(replace(r, x_m=r.x_m * (0.1 if r.x_m > 0 else 1.0)) for r in CROSS), r"rear_right\b.* 0\.18 .*>= 0\.2"),
    ],
    ids=["three", "one twice", "off the centre", "in a line", "mass almost under the front"],
)
def test_rotors_that_cannot_hold_a_vehicle_level_are_refused(rotors: tuple[Rotor, ...], text: str):
    with pytest.raises(ValueError, match=text):
        with_rotors(*rotors)
    with pytest.raises(ValueError, match=r"arm_m is 0\.25\b.* 0\.1785 m"):
        replace(ardrone2.VEHICLE, arm_m=0.25)


def test_mixing_inverts_the_allocation_and_adds_no_thrust():
    for vehicle in map(vehicle_of, (*MODELS, "hexacopter", "iris")):
        np.testing.assert_allclose(allocation(vehicle) @ mixing(vehicle), np.eye(3), atol=1e-9)
        np.testing.assert_allclose(mixing(vehicle).sum(axis=0), 0.0, atol=1e-9)


def test_the_lift_is_shared_without_a_moment():
    """Two arms are half as long as the other two: their rotors carry twice as much, 4/3 of the mean."""
    rotors = [replace(each, x_m=each.x_m * (1.0 if each.x_m > 0 else 0.5)) for each in cross_layout(0.2)]
    vehicle = with_rotors(*rotors)
    np.testing.assert_allclose(lift_shares(vehicle), [2 / 3, 2 / 3, 4 / 3, 4 / 3], rtol=1e-9)
    np.testing.assert_array_equal(lift_shares(ardrone2.VEHICLE), 1.0)
