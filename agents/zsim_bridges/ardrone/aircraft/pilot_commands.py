"""What a pilot's REF and PCMD make a drone do: one-shot modes until they are obeyed, a setpoint as long as it holds.

Source: AR.Drone Developer Guide SDK 2.0, 6.6; what clients of it send.
"""

import math
from collections.abc import Callable

from zsim.contract.flight_messages import Status
from zsim_bridges.ardrone.aircraft.setpoint_sender import SetpointSender, TiltSetpoint, share
from zsim_bridges.ardrone.wire import at_commands
from zsim_bridges.ardrone.wire.at_commands import Pcmd, PcmdMag, Ref
from zsim_bridges.vehicle_links.command_sender import CommandSender, ModeName

AGAIN_NS = 500_000_000  # ns, chosen: a mode that is not entered is asked for again, as the pilot's REF is repeated
ASKED_MAX = 3  # times that a mode is asked for before it is given up, chosen
PER_GATE = 3  # setpoints that are sent at once within a gate, chosen: the world takes one at each
AIRBORNE = ("hovering", "flying")
IN_THE_AIR = ("taking_off", *AIRBORNE)


class PilotCommands:
    """The pilot of one drone.

    Args:
        sender: of modes to it.
        setpoints: sends what it is to fly.
        source: name under which both are sent.
        refuse: counts a command that is not obeyed, with the reason.

    Attributes:
        has_flown: whether the flight is this pilot's.
        stopped_by_pilot: whether the emergency is.
    """

    def __init__(
        self,
        sender: CommandSender,
        setpoints: SetpointSender,
        source: str,
        refuse: Callable[[str], None],
    ) -> None:
        self._sender = sender
        self._setpoints = setpoints
        self._source = source
        self._refuse = refuse
        self._status: Status | None = None
        self._held_take_off = self._held_emergency = False  # bits of the last REF
        self._mode: ModeName | None = None  # that is to be entered
        self._mode_ns, self._mode_count = 0, 0
        self._setpoint: TiltSetpoint | None = None
        self._sent_ns: int | None = None  # when the setpoint was sent last; None while it is new
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
    def setpoint(self) -> TiltSetpoint | None:
        return self._setpoint

    @property
    def _now_ns(self) -> int:
        return self._status.t_ns if self._status else 0

    def flown_by(self) -> str | None:
        """Return the name of another process that flies the drone."""
        commander = self._status.commander if self._status else None
        return None if commander in (None, self._source) else commander

    def _is_refused(self, name: str) -> bool:
        """Tell whether a command is not obeyed, and count it."""
        if self._status is None:
            self._refuse(f"{name} is not obeyed: the drone has sent no status yet")
        elif other := self.flown_by():
            self._refuse(f"{name} is not obeyed: {other} flies the drone")
        else:
            return False
        return True

    def on_ref(self, ref: Ref) -> None:
        """Take off or land, and toggle the emergency.

        The bits are levels that a pilot's program repeats; a take-off and the toggle follow from their rise.
        """
        rises = ref.takes_off and not self._held_take_off
        toggles = ref.emergency and not self._held_emergency
        self._held_take_off, self._held_emergency = ref.takes_off, ref.emergency
        if not (rises or toggles or (not ref.takes_off and self.state in IN_THE_AIR)):
            if not ref.takes_off and self._mode == "takeoff":
                self._withdraw()
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

    def _withdraw(self) -> None:
        """Take back a take-off; one that is on its way is followed by a landing."""
        if self._mode_count:
            self._sender.mode(self._now_ns, "land")
        self._mode = None

    def on_pcmd(self, pcmd: Pcmd | PcmdMag) -> None:
        """Fly it from now on, until another PCMD."""
        if isinstance(pcmd, PcmdMag):
            self._psi_rad = math.pi * share(pcmd.psi)
        if self.state not in IN_THE_AIR or self._mode in ("land", "emergency") or self._is_refused("PCMD"):
            return
        setpoint = self._setpoint_of(pcmd)
        if self.calibrates and setpoint.hover:
            return
        self._calibrated_ns = None
        self._follow(setpoint)

    def _setpoint_of(self, pcmd: Pcmd | PcmdMag) -> TiltSetpoint:
        if not pcmd.flag & at_commands.PROGRESSIVE:
            return TiltSetpoint(hover=True)
        absolute = bool(pcmd.flag & at_commands.ABSOLUTE)
        shares = map(share, (pcmd.roll, pcmd.pitch, pcmd.gaz, pcmd.yaw))
        return TiltSetpoint(False, *shares, pilot_heading_rad=self._psi_rad if absolute else None)

    def calibrate(self) -> None:
        """Turn once, in place."""
        if self.state not in AIRBORNE:
            self._refuse(f"CALIB is not obeyed: the drone is {self.state}; must be in the air")
        elif not self._is_refused("CALIB"):
            self._follow(TiltSetpoint(hover=True))
            self._calibrated_ns = self._now_ns + self._setpoints.turn_ns

    def hover(self) -> None:
        """Hover in place: the pilot's program is silent."""
        if self.state in IN_THE_AIR and self.has_flown and not self.flown_by():
            self._calibrated_ns = None
            self._follow(TiltSetpoint(hover=True))

    def land(self) -> None:
        """Land: the pilot's program stays silent."""
        if self.state in IN_THE_AIR and self.has_flown and not self.flown_by() and self._mode != "land":
            self._ask("land")

    def reset_bits(self) -> None:
        """Take the next REF of a pilot's program for its first."""
        self._held_take_off = self._held_emergency = False

    def on_status(self, status: Status) -> None:
        """Do what is due at a gate."""
        self._status = status
        if status.state == "emergency" and self._mode == "takeoff":
            self._mode = None
        if status.state != "emergency" and self._mode != "emergency":
            self.stopped_by_pilot = False
        if status.state in ("landed", "emergency", "landing"):
            self._setpoint = self._calibrated_ns = None
        if status.state in ("landed", "emergency") and self._mode != "takeoff":
            self.has_flown = False
        if self._mode is not None:
            self._pursue(self._mode)
        if self.calibrates and status.t_ns >= (self._calibrated_ns or 0):
            self._calibrated_ns, self._sent_ns = None, None
        if self.flown_by():
            self._setpoint = None
        self._send_due()

    def _ask(self, mode: ModeName) -> None:
        self._mode, self._mode_count = mode, 0
        self._setpoint = self._calibrated_ns = None
        self.stopped_by_pilot = mode == "emergency"
        self._pursue(mode)

    def _pursue(self, mode: ModeName) -> None:
        """Ask for a mode until it is entered, given up, or no longer possible."""
        if self._is_entered(mode):
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

    def _is_entered(self, mode: ModeName) -> bool:
        if mode == "takeoff":
            return self.state in (*IN_THE_AIR, "emergency")
        if mode == "land":
            return self.state not in IN_THE_AIR
        return (self.state == "emergency") == (mode == "emergency")

    def _follow(self, setpoint: TiltSetpoint) -> None:
        """Take a setpoint, and send it at once if it is another one."""
        if setpoint != self._setpoint:
            self._setpoint, self._sent_ns = setpoint, None
        self._send_due()

    def _send_due(self) -> None:
        if self._setpoint is None or self.state not in AIRBORNE:
            return
        now_ns = self._now_ns
        if now_ns != self._gate_ns:
            self._gate_ns, self._gate_count = now_ns, 0
        is_late = self._sent_ns is None or now_ns - self._sent_ns >= self._setpoints.repeat_ns(self._setpoint)
        if is_late and self._gate_count < PER_GATE:
            self._sent_ns, self._gate_count, self.has_flown = now_ns, self._gate_count + 1, True
            if self.calibrates:
                self._setpoints.send_turn(now_ns)
            else:
                self._setpoints.send(now_ns, self._setpoint)
