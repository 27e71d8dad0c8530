"""From what an aircraft is to do to AT commands. Pure.

REF says take off or land and is repeated for as long as it is meant; PCMD is sent every 30 ms; both with numbers that
go up. Source: AR.Drone Developer Guide SDK 2.0, chapter 6.
"""

from collections.abc import Iterator

from zsim.math.frames import heading
from zsim_bridges.ardrone.drive.tilt_control import TiltControl
from zsim_bridges.ardrone.wire import at_commands
from zsim_bridges.ardrone.wire.at_commands import Command, Pcmd
from zsim_bridges.vehicle_links.aircraft_state import AircraftPose
from zsim_bridges.vehicle_links.failsafe import Demand

PERIOD_NS = 30_000_000  # Developer Guide 6.3: at most 30 ms between commands
CHANGED_NS = 15_000_000  # chosen: less than a gate, in which a controller commands once
PULSE_NS = 90_000_000  # chosen: three datagrams have the emergency bit, of which two may be lost
PULSES_NS = 400_000_000  # chosen: longer than a pulse takes to show in navdata, since another one would take it back
HOVER = 0  # flag of a PCMD: hold the place


class FlightCommands:
    """What is sent to one aircraft.

    Args:
        control: its velocity loop.
    """

    def __init__(self, control: TiltControl) -> None:
        self._control = control
        self._sent_ns = -PERIOD_NS
        self._last: Demand | None = None
        self._rose_ns = -PULSES_NS  # when the emergency bit did last

    def advance(self, now_ns: int, demand: Demand, emergency: bool, pose: AircraftPose | None) -> Iterator[Command]:
        """Yield the commands that are due, without their numbers; none where nothing is demanded.

        Args:
            emergency: whether the aircraft is in its emergency.
            pose: of the aircraft.
        """
        if now_ns - self._sent_ns < (PERIOD_NS if demand == self._last else CHANGED_NS):
            return
        self._last, self._sent_ns = demand, now_ns
        match demand.action:
            case "none":
                return
            case "kill":
                yield self._toggle(now_ns, due=not emergency)
            case "land":
                yield at_commands.ref(0, takes_off=False)
                yield Pcmd(0, HOVER, 0.0, 0.0, 0.0, 0.0)
            case "reset":
                yield self._toggle(now_ns, due=emergency)
            case _ if emergency:
                return
            case _:
                yield at_commands.ref(0, takes_off=True)
                yield self._pcmd(now_ns, demand, pose)

    def _toggle(self, now_ns: int, due: bool) -> Command:
        """Return the next REF of a pulse of the emergency bit, which the aircraft takes at its rise."""
        if due and now_ns - self._rose_ns >= PULSES_NS:
            self._rose_ns = now_ns
        return at_commands.ref(0, takes_off=False, emergency=now_ns - self._rose_ns < PULSE_NS)

    def _pcmd(self, now_ns: int, demand: Demand, pose: AircraftPose | None) -> Command:
        if demand.action != "fly" or pose is None:
            self._control.reset()
            return Pcmd(0, HOVER, 0.0, 0.0, 0.0, 0.0)
        yaw_rad, yaw_rate = float(heading(pose.q_WB)), demand.yaw_rate_rad_s
        shares = self._control.shares(now_ns, demand.velocity_m_s, pose.velocity_m_s, yaw_rad, yaw_rate)
        return Pcmd(0, at_commands.PROGRESSIVE, -shares.left, -shares.forward, shares.up, -shares.yaw_left)
