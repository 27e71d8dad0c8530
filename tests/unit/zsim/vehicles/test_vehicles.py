"""Vehicles as data: stock ones are sound, and what is none is refused with one line."""

import math
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from zsim.errors import DocumentError, ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import VEHICLE_NUMBERS
from zsim.vehicles import ardrone2, vehicle_catalogue
from zsim.vehicles.vehicle import Rotor, Vehicle, allocation, cross_layout, lift_shares, mixing


def document(**drone: Any) -> dict[str, Any]:
    return {"name": "t", "duration_s": 1, "drones": [{"name": "a", "position_m": [0, 0, 0], **drone}]}


def fault_of(**drone: Any) -> str:
    with pytest.raises(ScenarioError) as raised:
        scenario_file.resolve(document(**drone))
    (line,) = raised.value.faults
    return line


@pytest.mark.parametrize("model", vehicle_catalogue.STOCK)
def test_a_stock_vehicle_gives_a_drone_its_numbers(model: str):
    vehicle = vehicle_catalogue.vehicle_of(model)
    drone = scenario_file.resolve(document(model=model)).drones[0]
    assert {name: getattr(drone, name) for name in VEHICLE_NUMBERS} == {
        name: getattr(vehicle, name) for name in VEHICLE_NUMBERS
    }
    assert drone.limits == vehicle.limits
    assert drone.sensors.preset == vehicle.sensor_preset


@pytest.mark.parametrize("model", vehicle_catalogue.STOCK)
def test_every_number_of_a_stock_vehicle_has_its_source_or_reason(model: str):
    text = Path(str(getattr(vehicle_catalogue, model).__file__)).read_text()
    numbers = [line for line in text.splitlines() if re.match(r"\s+\w+=\(?-?[\d.]", line)]
    assert len(numbers) > 30
    assert [line for line in numbers if "#" not in line] == []


def test_a_drone_overrides_its_vehicle_field_by_field():
    drone = scenario_file.resolve(document(model="crazyflie2", mass_kg=0.035, limits={"tilt_deg": 12})).drones[0]
    assert (drone.mass_kg, drone.arm_m) == (0.035, 0.0397)
    assert (drone.limits.tilt_deg, drone.limits.horizontal_speed_m_s) == (12.0, 2.0)


def test_a_module_of_the_users_is_a_model():
    drone = scenario_file.resolve(document(model="hexacopter")).drones[0]
    assert drone.thrust_n_s2 == pytest.approx(8.048e-6 * 2 / 3)


def test_a_resolved_scenario_names_a_module_that_nobody_imports():
    text = scenario_file.to_text(scenario_file.resolve(document(model="hexacopter")))
    other = scenario_file.from_text(text.replace("hexacopter", "not_here.at_all"))
    assert other.drones[0].model == "not_here.at_all"


def test_a_fault_names_a_rotor_that_the_vehicle_has():
    fault = {"kind": "rotor_stuck", "target": "a", "at_s": 1, "rotor": "rotor3"}
    assert scenario_file.resolve(document(model="hexacopter") | {"faults": [fault]}).faults
    resolved = scenario_file.to_text(scenario_file.resolve(document(model="hexacopter") | {"faults": [fault]}))
    assert scenario_file.from_text(resolved.replace("hexacopter", "not_here.at_all")).faults  # by an agent
    for model, rotor in (("hexacopter", "front_left"), ("ardrone2", "rotor3"), ("crazyflie2", "rotor3")):
        with pytest.raises(ScenarioError) as error:
            scenario_file.resolve(document(model=model) | {"faults": [fault | {"rotor": rotor}]})
        (line,) = error.value.faults
        names = vehicle_catalogue.vehicle_of(model).rotor_names
        for part in ("faults[0].rotor", repr(rotor), ", ".join((*names, "all"))):
            assert part in line


@pytest.mark.parametrize("model", ["ardrone_9", "no_such.module", "3d", "a/b"])
def test_an_unknown_model_is_a_line_with_drone_value_and_what_is_allowed(model: str):
    line = fault_of(model=model)
    for part in ("drones[0].model", repr(model), "ardrone2, crazyflie2", "(drone 'a')"):
        assert part in line


@pytest.mark.parametrize(("value", "found"), [(None, "no VEHICLE"), (3, "'int'")])
def test_a_module_without_a_vehicle_is_refused(monkeypatch: pytest.MonkeyPatch, value: Any, found: str):
    module = ModuleType("my_plane")
    if value is not None:
        module.__dict__["VEHICLE"] = value
    monkeypatch.setitem(__import__("sys").modules, "my_plane", module)
    assert found in fault_of(model="my_plane")


def test_faulty_parameters_are_named(monkeypatch: pytest.MonkeyPatch):
    module = ModuleType("my_brick")
    module.__dict__["VEHICLE"] = replace(ardrone2.VEHICLE, mass_kg=-1.0)
    monkeypatch.setitem(__import__("sys").modules, "my_brick", module)
    with pytest.raises(DocumentError) as raised:
        vehicle_catalogue.vehicle_of("my_brick", "a.yaml: drones[0].model")
    (line,) = raised.value.faults
    assert line.startswith("a.yaml: drones[0].model is 'my_brick'")
    assert "VEHICLE.mass_kg is -1.0" in line


def with_rotors(*rotors: Rotor) -> Vehicle:
    arm_m = max(math.hypot(rotor.x_m, rotor.y_m) for rotor in rotors)
    return replace(ardrone2.VEHICLE, arm_m=arm_m, rotors=rotors)


def test_an_arm_that_is_not_that_of_the_rotors_is_refused():
    with pytest.raises(ValueError, match=r"arm_m is 0\.25\b.* 0\.1785 m"):
        replace(ardrone2.VEHICLE, arm_m=0.25)


@pytest.mark.parametrize(
    "rotors",
    [
        cross_layout(0.2)[:3],
        (*cross_layout(0.2)[:3], cross_layout(0.2)[0]),
        (*cross_layout(0.2)[:3], replace(cross_layout(0.2)[3], x_m=0.5)),
        tuple(replace(rotor, y_m=0.0) for rotor in cross_layout(0.2)),
    ],
    ids=["three", "one twice", "off the centre", "in a line"],
)
def test_rotors_that_cannot_hold_it_level_are_refused(rotors: tuple[Rotor, ...]):
    with pytest.raises(ValueError, match="rotors"):
        with_rotors(*rotors)


def test_mixing_inverts_the_allocation_and_adds_no_thrust():
    own = [vehicle_catalogue.vehicle_of(name) for name in ("hexacopter", "iris")]
    for vehicle in (*vehicle_catalogue.STOCK.values(), *own):
        np.testing.assert_allclose(allocation(vehicle) @ mixing(vehicle), np.eye(3), atol=1e-9)
        np.testing.assert_allclose(mixing(vehicle).sum(axis=0), 0.0, atol=1e-9)


def test_the_lift_is_shared_so_that_nothing_turns():
    """Two arms of one length and two of half of it: the near ones bear twice as much, 4/3 of the mean."""
    rotors = [replace(each, x_m=each.x_m * (1.0 if each.x_m > 0 else 0.5)) for each in cross_layout(0.2)]
    vehicle = with_rotors(*rotors)
    np.testing.assert_allclose(lift_shares(vehicle), [2 / 3, 2 / 3, 4 / 3, 4 / 3], rtol=1e-9)
    np.testing.assert_array_equal(lift_shares(ardrone2.VEHICLE), 1.0)


def test_a_centre_of_mass_almost_under_the_front_rotors_is_refused():
    rotors = [replace(each, x_m=each.x_m * (0.1 if each.x_m > 0 else 1.0)) for each in cross_layout(0.2)]
    with pytest.raises(ValueError, match=r"rear_right\b.* 0\.18 .*>= 0\.2"):
        with_rotors(*rotors)
