"""A MAVLink vehicle and its drone without a run: a test plays the inputs, and all messages sent are kept."""

from typing import Any, TypeVar

from zsim.contract import flight_messages
from zsim.contract.messages import Origin
from zsim.scenario import scenario_file
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import Received, WireMessage
from zsim_bridges.mavlink.mavlink_vehicle import MavlinkVehicle, Options
from zsim_bridges.mavlink.personality import PERSONALITIES
from zsim_bridges.vehicle_links.drone_link import CommandSender

GATE_NS = 20_000_000
ORIGIN = Origin(latitude_deg=47.4, longitude_deg=8.5, height_m=400.0)
SCENARIO = """
name: one
duration_s: 10
sensors: {preset: paper}
drones:
  - {name: drone1, position_m: [0, 0, 0]}
"""
OWN = "mavlink.main"
UNIQUE_ID = 2**63 + 1
M = TypeVar("M", bound=WireMessage)


class FlownDrone:
    """A MAVLink vehicle and its drone, which follows commands without delay."""

    def __init__(self, autopilot: str = "px4", scenario: str = SCENARIO) -> None:
        self.commands: list[Any] = []
        sender = CommandSender("drone1", OWN, lambda _, command: self.commands.append(command))
        (drone,) = scenario_file.from_text(scenario).drones
        self.vehicle = MavlinkVehicle(
            drone, ORIGIN, sender, Options(1, PERSONALITIES[autopilot], "normal", OWN, UNIQUE_ID)
        )
        self.sent: list[WireMessage] = []
        self.state = "landed"
        self.position = [0.0, 0.0, 0.0]
        self.battery_percent = 90.0
        self.commander: str | None = None
        self.t_ns = 0
        self._handled = 0
        self._velocity = (0.0, 0.0, 0.0)
        self.silent: set[str] = set()
        self.step()

    def step(self, gates: int = 1) -> None:
        """Let time pass; the drone carries out its commands."""
        for _ in range(gates):
            self.t_ns += GATE_NS
            self._obey()
            self._move()
            self._publish()
            self.vehicle.step()
            self.sent += self.vehicle.take()

    def until(self, true: Any, gates: int = 5000) -> None:
        """Let time pass until a condition holds."""
        for _ in range(gates):
            if true():
                return
            self.step()
        raise AssertionError(f"not within {gates} gates; {self.state} at {self.position}, {self.vehicle.flight.mode}")

    def receive(self, message: WireMessage, system: int = 255) -> None:
        """Receive a message from a client."""
        self.vehicle.on_message(Received(message, system, 190, 0, False), self.t_ns)
        self.sent += self.vehicle.take()

    def command(self, command: int, *params: float) -> int:
        """Receive COMMAND_LONG from a client; return the result of its acknowledgement."""
        seven = (*params, *(0.0,) * (7 - len(params)))
        self.receive(dialect.CommandLong(1, 1, command, 0, *seven))
        return self.all(dialect.CommandAck)[-1].result

    def all(self, kind: type[M]) -> list[M]:
        """Return the messages of a type sent so far."""
        return [message for message in self.sent if isinstance(message, kind)]

    def texts(self) -> list[str]:
        return [message.text for message in self.all(dialect.Statustext)]

    def _obey(self) -> None:
        for command in self.commands[self._handled :]:
            if isinstance(command, flight_messages.Mode):
                self._change(command.mode)
            elif self.state in ("hovering", "flying"):
                self.commander = OWN
                self.state = "flying"
                self._velocity = getattr(command, "velocity_m_s", (0.0, 0.0, 0.0))
        self._handled = len(self.commands)

    def _change(self, mode: str) -> None:
        self._velocity = (0.0, 0.0, 0.0)
        if mode == "takeoff" and self.state == "landed":
            self.state = "taking_off"
        elif mode == "land" and self.state in ("hovering", "flying"):
            self.state = "landing"
        elif mode == "emergency":
            self.state = "emergency"
        elif mode == "reset":
            self.state = "landed"

    def _move(self) -> None:
        dt = GATE_NS * 1e-9
        if self.state == "taking_off":
            self.position[2] += dt
            self.state = "hovering" if self.position[2] >= 1.0 else self.state
        elif self.state in ("landing", "emergency"):
            self.position[2] = max(0.0, self.position[2] - dt)
            if self.state == "landing" and self.position[2] == 0.0:
                self.state, self.commander = "landed", self.commander
        for k in range(3):
            self.position[k] += dt * self._velocity[k]

    def _publish(self) -> None:
        state, t = self.vehicle.state, (self.t_ns, 0)
        x, y, z = self.position
        rest = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
        state.update("truth", flight_messages.Truth(*t, (x, y, z), self._velocity, (1.0, 0.0, 0.0, 0.0), *rest))
        for name, message in samples(self.t_ns).items():
            if name not in self.silent:
                state.update(name, message)
        status = (self.state, self.battery_percent, False, self.commander, 1)
        state.update("status", flight_messages.Status(*t, *status))  # type: ignore[arg-type]


def samples(t_ns: int) -> dict[str, Any]:
    """Return a sample of each sensor, by the sensor's name."""
    from zsim.contract import messages

    t = (t_ns, 0, t_ns)
    return {
        "imu": messages.Imu(*t, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)),
        "mag": messages.Mag(*t, (20.0, 0.0, -40.0)),
        "baro": messages.Baro(*t, 96_000.0, 400.0),
        "sonar": messages.Sonar(*t, 1.0, True),
        "flow": messages.Flow(*t, (0.0, 0.0, 0.0), 1.0),
        "gps": messages.Gps(*t, 47.4, 8.5, 400.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 2.0, 3, 10),
    }
