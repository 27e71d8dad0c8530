"""Who takes part in a replay, and what of the record is not played since they publish it anew."""

from collections.abc import Iterable

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraImage, CameraInfo, Sightings
from zsim.record import Recorded
from zsim.scenario.scenario import Scenario
from zsim_world.flight.barrier import Participant
from zsim_world.playback.recorded_gates import author

OF_CAMERAS = {CameraImage: "camera", CameraInfo: "camera", Sightings: "detector"}  # roles that publish these


class LiveProcesses:
    """The processes that take part at a gate.

    A camera or detector counts by the drones that it declares, whatever its name is; one that declares none, as a
    program of the user's own may, by its name.

    Args:
        scenario: of the record.
        participants: alive.

    Attributes:
        names: of the processes whose work they do.
    """

    def __init__(self, scenario: Scenario, participants: Iterable[Participant]) -> None:
        served = [each.served_names for each in participants]
        self._cameras = {drone.name: drone.sensors.cameras() for drone in scenario.drones}
        self._by_name = {name for names in served if not any(map(self._is_of_cameras, names)) for name in names}
        self.names = {name for names in served for name in names}

    def _is_of_cameras(self, name: str) -> bool:
        role, _, drone = name.partition(".")
        return role in OF_CAMERAS.values() and drone in self._cameras

    def replace(self, recorded: Recorded) -> bool:
        """Tell whether one of them publishes a message of its own in place of one on record."""
        role = OF_CAMERAS.get(messages.type_of(recorded.key))
        if role is None:
            return bool(self.names) and author(recorded) in self.names
        if f"{role}.{keys.thing(recorded.key)}" in self.names and self._is_drawn(recorded.key):
            return True
        return bool(self._by_name) and author(recorded) in self._by_name

    def _is_drawn(self, key: str) -> bool:
        """Tell whether a camera is one that the scenario gives its drone, if it gives it any."""
        _, drone, what = keys.parts(key)
        cameras, camera = self._cameras.get(drone), what.removeprefix("camera/").removesuffix("/info")
        return not cameras or camera == what or camera in cameras
