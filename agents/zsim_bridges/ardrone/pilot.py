"""The effect of a pilot's REF and PCMD: modes, repeated until obeyed, and a setpoint as long as it holds.

Source: AR.Drone Developer Guide SDK 2.0, 6.6; what clients of it send.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from zsim.contract.flight_messages import Status
from zsim.math import elementary as el
from zsim.vehicles.vehicle import Limits
from zsim_bridges.ardrone import at_commands
from zsim_bridges.ardrone.at_commands import Pcmd, PcmdMag, Ref
from zsim_bridges.ardrone.configuration import Configuration
from zsim_bridges.vehicle_links.drone_link import CommandSender, ModeName

AGAIN_NS = 500_000_000  # ns, chosen: a mode that is not entered is asked for again, as the pilot's REF is repeated
ASKED_MAX = 3  # times that a mode is asked for before it is given up, chosen
PER_GATE = 3  # setpoints that are sent at once within a gate, chosen: the world takes one at each
AIRBORNE = ("hovering", "flying")
IN_THE_AIR = ("taking_off", *AIRBORNE)
REPEAT_NS = 100_000_000  # ns; a commander that is silent for 0.5 s counts as dead, scenario `silence.hover_s`
NO_ALTITUDE_LIMIT_MM = 100_000  # altitude_max that means none (ARDroneLib)
CLIMB_1_S = 1.5  # 1/s, as the firmware nears its own greatest height
CALIBRATION_YAW_RAD_S = 1.0  # rad/s, chosen: a turn takes 6 s, as on the aircraft


class TiltSetpoint(NamedTuple):
    """A PCMD within its limits: shares of the largest tilt, climb and yaw rate.

    Attributes:
        hover: in place, whatever the shares are.
        right, back, up, clockwise: in [-1, 1].
        pilot_heading_rad: clockwise from north, if right and back are those of the pilot, not of the drone.
    """

    hover: bool
    right: float = 0.0
    back: float = 0.0
    up: float = 0.0
    clockwise: float = 0.0
    pilot_heading_rad: float | None = None


HOVER = TiltSetpoint(hover=True)


class Pilot:
    """The pilot of one drone.

    Attributes:
        setpoint: that is flown; None for none.
        has_flown: whether the flight is this pilot's; stopped_by_pilot: whether the emergency is.
    """

    def __init__(
        self, sender: CommandSender, setpoints: "SetpointSender", source: str, refuse: Callable[[str], None]
    ) -> None:
        self._sender = sender
        self._setpoints = setpoints
        self._source = source
        self._refuse = refuse
        self._status: Status | None = None
        self._held_take_off = self._held_emergency = False  # bits of the last REF
        self._mode: ModeName | None = None  # that is to be entered
        self._mode_ns, self._mode_count = 0, 0
        self.setpoint: TiltSetpoint | None = None
        self._sent_ns: int | None = None  # when the setpoint was last sent; None while it is new
        self._gate_ns, self._gate_count = -1, 0
        self._psi_rad: float | None = None  # of the last PCMD_MAG
        self._calibrated_ns: int | None = None  # until then it turns
        self.has_flown = False
        self.stopped_by_pilot = False

    @property
    def calibrates(self) -> bool:
        """Whether it turns to calibrate its magnetometer."""
        return self._calibrated_ns is not None

    @property
    def state(self) -> str:
        return self._status.state if self._status else "landed"

    @property
    def _now_ns(self) -> int:
        return self._status.t_ns if self._status else 0

    def flown_by(self) -> str | None:
        """Return the name of another process that flies the drone."""
        commander = self._status.commander if self._status else None
        return None if commander in (None, self._source) else commander

    def _is_refused(self, name: str) -> bool:
        """Return whether a command is not obeyed, and count it."""
        if self._status is None:
            self._refuse(f"{name} is not obeyed: the drone has sent no status yet")
        elif other := self.flown_by():
            self._refuse(f"{name} is not obeyed: {other} flies the drone")
        else:
            return False
        return True

    # Commands

    def on_ref(self, ref: Ref) -> None:
        """Take off or land, and toggle the emergency.

        The bits are levels that a pilot's program repeats; a take-off and the toggle follow from their rise.
        """
        rises = ref.takes_off and not self._held_take_off
        toggles = ref.emergency and not self._held_emergency
        self._held_take_off, self._held_emergency = ref.takes_off, ref.emergency
        if not (rises or toggles or (not ref.takes_off and self.state in IN_THE_AIR)):
            if not ref.takes_off and self._mode == "takeoff":  # withdrawn
                if self._mode_count:  # it is under way, and is followed by a landing
                    self._sender.mode(self._now_ns, "land")
                self._mode = None
            return
        if self._is_refused("REF"):
            return
        if toggles:
            self._ask("reset" if self.state == "emergency" else "emergency")
        elif self._mode in ("emergency", "reset"):
            return
        elif rises and self.state in ("landed", "landing"):
            self._ask("takeoff")
        elif not ref.takes_off and self._mode != "land":
            self._ask("land")

    def on_pcmd(self, pcmd: Pcmd | PcmdMag) -> None:
        """Fly it from now on, until another PCMD."""
        if isinstance(pcmd, PcmdMag):
            self._psi_rad = math.pi * share(pcmd.psi)
        if self.state not in IN_THE_AIR or self._mode in ("land", "emergency") or self._is_refused("PCMD"):
            return
        setpoint = HOVER
        if pcmd.flag & at_commands.PROGRESSIVE:
            heading_rad = self._psi_rad if pcmd.flag & at_commands.ABSOLUTE else None
            shares = map(share, (pcmd.roll, pcmd.pitch, pcmd.gaz, pcmd.yaw))
            setpoint = TiltSetpoint(False, *shares, pilot_heading_rad=heading_rad)
        elif self.calibrates:
            return
        self._calibrated_ns = None
        self._follow(setpoint)

    def calibrate(self) -> None:
        """Turn once, in place."""
        if self.state not in AIRBORNE:
            self._refuse(f"CALIB is not obeyed: the drone is {self.state}; must be in the air")
        elif not self._is_refused("CALIB"):
            self._follow(HOVER)
            self._calibrated_ns = self._now_ns + self._setpoints.turn_ns

    def on_lost(self) -> None:
        """Hover in place: the pilot's program is silent; its next REF counts as its first."""
        self._held_take_off = self._held_emergency = False
        if self._is_own_flight():
            self._calibrated_ns = None
            self._follow(HOVER)

    def land(self) -> None:
        """Land, since the pilot's program remains silent."""
        if self._is_own_flight() and self._mode != "land":
            self._ask("land")

    def _is_own_flight(self) -> bool:
        return self.state in IN_THE_AIR and self.has_flown and not self.flown_by()

    # Gates

    def on_status(self, status: Status) -> None:
        self._status = status
        if status.state == "emergency" and self._mode == "takeoff":
            self._mode = None
        if status.state != "emergency" and self._mode != "emergency":
            self.stopped_by_pilot = False
        if status.state in ("landed", "emergency", "landing"):
            self.setpoint = self._calibrated_ns = None
        if status.state in ("landed", "emergency") and self._mode != "takeoff":
            self.has_flown = False
        if self._mode is not None:
            self._pursue(self._mode)
        if self._calibrated_ns is not None and status.t_ns >= self._calibrated_ns:
            self._calibrated_ns, self._sent_ns = None, None
        if self.flown_by():
            self.setpoint = None
        self._send_due()

    def _ask(self, mode: ModeName) -> None:
        self._mode, self._mode_count = mode, 0
        self.setpoint = self._calibrated_ns = None
        self.stopped_by_pilot = mode == "emergency"
        self._pursue(mode)

    def _pursue(self, mode: ModeName) -> None:
        """Request a mode until it is entered, abandoned, or no longer possible."""
        entered = {
            "takeoff": self.state in (*IN_THE_AIR, "emergency"),
            "land": self.state not in IN_THE_AIR,
            "emergency": self.state == "emergency",
            "reset": self.state != "emergency",
        }
        if entered[mode]:
            self._mode = None
        elif mode == "takeoff" and self.state != "landed":
            return  # it lands first
        elif not self._mode_count or self._now_ns - self._mode_ns >= AGAIN_NS:
            if self._mode_count == ASKED_MAX:
                self._mode = None
                return
            self._mode_ns, self._mode_count = self._now_ns, self._mode_count + 1
            self.has_flown = self.has_flown or mode == "takeoff"
            self._sender.mode(self._now_ns, mode)

    def _follow(self, setpoint: TiltSetpoint) -> None:
        """Set the setpoint, and send it at once if it differs from the last one."""
        if setpoint != self.setpoint:
            self.setpoint, self._sent_ns = setpoint, None
        self._send_due()

    def _send_due(self) -> None:
        if self.setpoint is None or self.state not in AIRBORNE:
            return
        now_ns = self._now_ns
        if now_ns != self._gate_ns:
            self._gate_ns, self._gate_count = now_ns, 0
        is_due = self._sent_ns is None or now_ns - self._sent_ns >= self._setpoints.repeat_ns(self.setpoint)
        if is_due and self._gate_count < PER_GATE:
            self._sent_ns, self._gate_count, self.has_flown = now_ns, self._gate_count + 1, True
            if self.calibrates:
                self._setpoints.send_turn(now_ns)
            else:
                self._setpoints.send(now_ns, self.setpoint)


class SetpointSender:
    """Sends setpoints to one drone: shares of the firmware's limits, below a height, in the drone's frame.

    Args:
        limits: the values of zsim's shares of 1.
        configuration: has the values of the pilot's shares of 1.

    Attributes:
        altitude_m, heading_rad: over the ground, and clockwise from magnetic north, to be kept up to date.
        turn_ns: time of a whole turn of the calibration.
    """

    def __init__(self, sender: CommandSender, limits: Limits, configuration: Configuration) -> None:
        self._sender = sender
        self._configuration = configuration
        self._tilt_slope = el.tan(math.radians(limits.tilt_deg))
        self._climb_m_s, self._yaw_rad_s = limits.vertical_speed_m_s, math.radians(limits.yaw_rate_deg_s)
        self._turn_rad_s = min(CALIBRATION_YAW_RAD_S, self._yaw_rad_s)
        self.turn_ns = round(2e9 * math.pi / self._turn_rad_s)
        self.altitude_m = 0.0
        self.heading_rad = 0.0

    def repeat_ns(self, setpoint: TiltSetpoint) -> int:
        """Return after how long a setpoint is sent again; at every gate if it depends on height or heading."""
        if setpoint.pilot_heading_rad is not None:
            return 0
        climb_m_s = self._configuration.number("control:control_vz_max") / 1e3 if setpoint.up > 0.0 else -math.inf
        return 0 if self._climb_left_m_s() < climb_m_s else REPEAT_NS

    def send(self, t_ns: int, setpoint: TiltSetpoint) -> None:
        if setpoint.hover:
            self._sender.tilt(t_ns, 0.0, 0.0, 0.0, 0.0, hover=True)
            return
        number = self._configuration.number
        right, back = setpoint.right, setpoint.back
        if setpoint.pilot_heading_rad is not None:
            turn = setpoint.pilot_heading_rad - self.heading_rad
            sine, cosine = el.sin(turn), el.cos(turn)
            right, back = cosine * right - sine * back, sine * right + cosine * back
        tilt_rad = number("control:euler_angle_max")
        right, back = (share(el.tan(part * tilt_rad) / self._tilt_slope) for part in (right, back))
        climb_m_s = min(setpoint.up * number("control:control_vz_max") / 1e3, self._climb_left_m_s())
        yaw_left = share(-setpoint.clockwise * number("control:control_yaw") / self._yaw_rad_s)
        self._sender.tilt(t_ns, -back, -right, share(climb_m_s / self._climb_m_s), yaw_left, hover=False)

    def send_turn(self, t_ns: int) -> None:
        self._sender.velocity(t_ns, (0.0, 0.0, 0.0), -self._turn_rad_s)

    def _climb_left_m_s(self) -> float:
        """Return how fast it may climb below altitude_max."""
        highest_mm = self._configuration.number("control:altitude_max")
        if highest_mm >= NO_ALTITUDE_LIMIT_MM:
            return math.inf
        return CLIMB_1_S * (highest_mm / 1e3 - self.altitude_m)


def share(value: float) -> float:
    """Return a share of a limit, clipped to [-1, 1]."""
    return min(1.0, max(-1.0, value))
