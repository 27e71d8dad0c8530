"""What a scenario's `vehicle:` section gives to all its drones, put under what each says of itself."""

from typing import Annotated, Any

from msgspec import UNSET, Meta, Struct, UnsetType

from zsim.schema.checker import faults
from zsim.schema.quantities import NonNegative, Positive
from zsim.vehicles.vehicle import Aerodynamics, Arm, Limits, Mass, RotorLag, TakeoffHeight


class SharedVehicle(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The fields of a drone that are of its vehicle; what is unset is the model's."""

    model: str | UnsetType = UNSET
    mass_kg: Mass | UnsetType = UNSET
    inertia_kg_m2: tuple[Positive, Positive, Positive] | UnsetType = UNSET
    arm_m: Arm | UnsetType = UNSET
    thrust_n_s2: Positive | UnsetType = UNSET
    torque_nm_s2: Positive | UnsetType = UNSET
    rotor_time_constant_s: RotorLag | UnsetType = UNSET
    rotor_min_rad_s: NonNegative | UnsetType = UNSET
    rotor_max_rad_s: Positive | UnsetType = UNSET
    drag_n_s_m: NonNegative | UnsetType = UNSET
    battery_mah: Positive | UnsetType = UNSET
    battery_percent: Annotated[float, Meta(ge=0, le=100)] | UnsetType = UNSET
    takeoff_height_m: TakeoffHeight | UnsetType = UNSET
    limits: Limits | UnsetType = UNSET
    aerodynamics: Aerodynamics | UnsetType = UNSET


def shared(document: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a document's `vehicle:` that its drones may take; faulty ones are shown there alone."""
    section = document.get("vehicle")
    if not isinstance(section, dict):
        return {}
    faulty = {path.partition(".")[0].partition("[")[0] for path, _ in faults(section, SharedVehicle)}
    return {name: value for name, value in section.items() if name not in faulty}


def upon(fields: dict[str, Any], drone: Any) -> Any:
    """Return a drone's entry with the shared fields that it does not give; those of sections are taken one by one."""
    if not isinstance(drone, dict):
        return drone
    both = {**fields, **drone}
    for name in ("limits", "aerodynamics"):
        of_all, own = fields.get(name), drone.get(name)
        if isinstance(of_all, dict) and isinstance(own, dict):
            both[name] = {**of_all, **own}
    return both
