"""Whether setpoints keep coming."""

from zsim_bridges.mavlink.autopilot.personality import Settings
from zsim_bridges.mavlink.autopilot.vehicle_state import VehicleState


class SetpointStream:
    """The setpoints of a client, timed by simulated time."""

    def __init__(self, settings: Settings, state: VehicleState) -> None:
        self._settings = settings
        self._state = state
        self._newest_ns: int | None = None

    def note(self) -> None:
        """Note that one has come."""
        self._newest_ns = self._state.t_ns

    @property
    def is_silent(self) -> bool:
        """Whether none has come for too long, or ever."""
        silence_ns = self._settings["stream_s"] * 1e9
        return self._newest_ns is None or self._state.t_ns - self._newest_ns > silence_ns
