"""In which states a drone takes which commands: the same for simulated and external ones. Pure."""

from typing import get_args

from zsim.contract.flight_messages import DroneState

_ALL: frozenset[DroneState] = frozenset(get_args(DroneState))
_RULES: dict[str, tuple[str, frozenset[DroneState]]] = {
    "takeoff": ("a take-off needs it landed", frozenset({"landed"})),
    "land": ("a landing needs it in the air", _ALL - {"landed", "emergency"}),
    "emergency": ("", _ALL),
    "reset": ("a reset needs an emergency", frozenset({"emergency"})),
}
_SETPOINT = ("a setpoint needs it hovering or flying", frozenset[DroneState]({"hovering", "flying"}))


def state_refusal(name: str, state: str, asked: str) -> str | None:
    """Return why a drone does not take a command in its state, None if it does.

    Args:
        name: of the drone.
        asked: mode that it is to enter, or any other word for a setpoint.
    """
    need, states = _RULES.get(asked, _SETPOINT)
    return None if state in states else f"{name} is {state}; {need}"
