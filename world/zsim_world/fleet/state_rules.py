"""In which states a drone takes which commands: the same for simulated and external ones. Pure."""

from zsim.contract.flight_messages import DroneState
from zsim_world.vehicles import firmware

_ALL = frozenset(firmware.MODES)
_RULES: dict[str, tuple[str, frozenset[DroneState]]] = {
    "takeoff": ("a take-off needs it landed", frozenset({"landed"})),
    "land": ("a landing needs it in the air", _ALL - {"landed", "emergency"}),
    "emergency": ("", _ALL),
    "reset": ("a reset needs an emergency", frozenset({"emergency"})),
}
_SETPOINT = ("a setpoint needs it hovering or flying", frozenset[DroneState]({"hovering", "flying"}))


def state_refusal(name: str, state: DroneState, asked: str) -> str | None:
    """Return why a drone does not take a command in its state, None if it does.

    Args:
        name: of the drone.
        asked: mode that it is to enter, or any other word for a setpoint.
    """
    need, states = _RULES.get(asked, _SETPOINT)
    return None if state in states else f"{name} is {state}; {need}"
