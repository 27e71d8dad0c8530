"""An AR.Drone without sockets or a run: a test plays its inputs, and its outputs are kept."""

import math
from typing import Any

import msgspec

from zsim.contract import flight_messages, messages
from zsim.contract.flight_messages import DroneState
from zsim.scenario import scenario_file
from zsim.schema.quantities import G_M_S2
from zsim_bridges.ardrone import at_commands, navdata
from zsim_bridges.ardrone.aircraft import Aircraft, AircraftOutputs
from zsim_bridges.ardrone.at_commands import Command
from zsim_bridges.ardrone.navdata import Navdata

GATE_NS = 20_000_000
SOURCE = "ardrone.main"
PILOT = ("127.0.0.1", 40_000)
SCENARIO = """
name: one
duration_s: 10
drones: [{name: drone1, position_m: [0, 0, 0]%s}]
"""
HOVER = (0.0, 0.0, 0.0, 0.0, True)


class PlayedAircraft:
    """An aircraft, the gates of its run, and its pilot's program."""

    def __init__(self, more: str = "") -> None:
        scenario = scenario_file.resolve(msgspec.yaml.decode((SCENARIO % more).encode()))
        self.sent: list[tuple[str, Any]] = []
        self.datagrams: list[bytes] = []
        self.control: list[bytes] = []
        self.refusals: list[str] = []
        outlets = AircraftOutputs(
            lambda key, message: self.sent.append((key.removeprefix("drone/drone1/cmd/"), message)),
            lambda datagram, _: self.datagrams.append(datagram),
            self.control.append,
            self.refusals.append,
        )
        self.aircraft = Aircraft(scenario.drones[0], SOURCE, GATE_NS, outlets)
        self.gate = 0
        self.state: DroneState = "landed"
        self.commander: str | None = None
        self.battery_percent = 90.0
        self._sequence = 0

    @property
    def now_ns(self) -> int:
        return self.gate * GATE_NS

    def gates(self, count: int = 1, state: DroneState | None = None) -> None:
        """Let gates pass with the drone in a state, by default the last one."""
        self.state = state or self.state
        for _ in range(count):
            self.gate += 1
            for k in (3, 2, 1, 0):
                t_ns = self.now_ns - 5_000_000 * k
                self.aircraft.update(messages.Imu(t_ns, 0, t_ns, (0.0, 0.0, G_M_S2), (0.0, 0.0, 0.0)))
            status = (self.state, self.battery_percent, False, self.commander, 5)
            self.aircraft.update(flight_messages.Status(self.now_ns, 0, *status))

    def flown_gates(self, count: int, state: DroneState | None = None) -> None:
        """Let gates pass while the pilot's program resets the watchdog."""
        for _ in range(count):
            self.at(at_commands.ResetWatchdog(0))
            self.gates(1, state)

    def at(self, *commands: Command) -> None:
        """Send AT commands with consecutive sequence numbers."""
        for command in commands:
            self._sequence += 1
            self.aircraft.on_at(at_commands.format_command(command._replace(sequence=self._sequence)))

    def ref(self, takes_off: bool, emergency: bool = False) -> None:
        """Send a REF."""
        self.at(at_commands.ref(0, takes_off, emergency))

    def pcmd(self, roll: float = 0.0, pitch: float = 0.0, gaz: float = 0.0, yaw: float = 0.0, flag: int = 1) -> None:
        """Send a PCMD."""
        self.at(at_commands.Pcmd(0, flag, roll, pitch, gaz, yaw))

    def config(self, key: str, value: str) -> None:
        """Set an entry of the configuration."""
        self.at(at_commands.Config(0, key, value))

    def listen(self) -> None:
        """Request navdata."""
        self.aircraft.on_navdata_request(navdata.REQUEST_UNICAST, PILOT)

    def modes(self) -> list[str]:
        """Return the modes requested of the drone, and clear `sent`."""
        sent, self.sent = self.sent, []
        return [message.mode for kind, message in sent if kind == "mode"]

    def tilts(self) -> list[tuple[float, float, float, float, bool]]:
        """Return the shares sent to the drone (forward, left, up, yaw left, hover), and clear `sent`."""
        sent, self.sent = self.sent, []
        return [(m.forward, m.left, m.up, m.yaw_left, m.hover) for kind, m in sent if kind == "ardrone"]

    def packet(self) -> Navdata:
        """Return the latest navdata packet."""
        return navdata.unpack(self.datagrams[-1])

    def airborne(self) -> "PlayedAircraft":
        """Take off, and clear `sent`."""
        self.gates()
        self.ref(takes_off=True)
        self.gates(1, "taking_off")
        self.gates(1, "hovering")
        self.commander = SOURCE
        self.sent.clear()
        return self


def tilt_share(degrees: float, limit_deg: float = 20.0) -> float:
    """Return the share of the maximum tilt for which zsim's firmware tilts by an angle."""
    return math.tan(math.radians(degrees)) / math.tan(math.radians(limit_deg))
