"""What telemetry is made from, with what several messages need computed once a gate."""

from functools import cached_property

from zsim.math.rotation import Vector
from zsim.scenario.scenario import Drone
from zsim.vehicles.vehicle_catalogue import vehicle_of
from zsim_bridges.mavlink.autopilot.ned_axes import ned
from zsim_bridges.mavlink.autopilot.personality import Personality
from zsim_bridges.mavlink.autopilot.vehicle_state import VehicleState
from zsim_bridges.mavlink.flight.vehicle_fence import BREACH_NONE
from zsim_bridges.mavlink.flight.vehicle_flight import Flight


class TelemetrySource:
    """State, flight and personality of a vehicle, at one gate.

    Attributes:
        state, flight, personality: of the vehicle.
        cells: of its battery; voltage_v: nominal, of all of them.
        breach: the fence that it is beyond; breaches: how often so far; breach_ns: since when.
    """

    def __init__(self, drone: Drone, state: VehicleState, flight: Flight, personality: Personality) -> None:
        self.state = state
        self.flight = flight
        self.personality = personality
        self.voltage_v = vehicle_of(drone.model).battery.voltage_v
        self.capacity_mah = drone.battery_mah
        self.breach = BREACH_NONE
        self.breaches = 0
        self.breach_ns = 0

    def advance(self) -> None:
        """Forget what was computed for the gate before."""
        for name in ("rpy_ned_rad", "place", "position_ned_m", "velocity_ned_m_s", "home_place"):
            self.__dict__.pop(name, None)

    @property
    def boot_ms(self) -> int:
        """Time since the start [ms]: simulated."""
        return self.state.t_ns // 1_000_000 & 0xFFFFFFFF

    @property
    def boot_us(self) -> int:
        return self.state.t_ns // 1000

    @property
    def battery_percent(self) -> float:
        return self.state.status.battery_percent if self.state.status else 0.0

    @cached_property
    def rpy_ned_rad(self) -> Vector:
        return self.state.rpy_ned_rad

    @cached_property
    def place(self) -> Vector:
        """Latitude [deg], longitude [deg], height [m]."""
        return self.state.to_global(self.state.position_m)

    @cached_property
    def home_place(self) -> Vector:
        """The place of home."""
        return self.state.to_global(self.state.home_m or self.state.position_m)

    @cached_property
    def position_ned_m(self) -> Vector:
        return ned(self.state.position_m)

    @cached_property
    def velocity_ned_m_s(self) -> Vector:
        return ned(self.state.velocity_m_s)


def int16(value: float) -> int:
    """Return a whole number that fits into a field of 16 bits."""
    return max(-32767, min(32767, round(value)))
