"""The setpoints that a vehicle sends to its drone: at once while few are sent, and never more than the world takes."""

from zsim_bridges.mavlink.flight.position_guidance import Steering, TiltTarget
from zsim_bridges.vehicle_links.command_sender import CommandSender, ModeName

BURST = 500  # commands at once: half of what the world records of a source that is not in the lockstep
REPEAT_NS = 100_000_000  # ns; the firmware takes a commander that is silent for 0.5 s for dead


class CommandOutput:
    """Sends setpoints and modes to one drone.

    The world takes one command of a source more with each gate, so each gate allows one here.

    Attributes:
        now_ns: simulated time of the newest gate.
    """

    def __init__(self, sender: CommandSender) -> None:
        self._sender = sender
        self._allowed = BURST
        self._sent_ns = -REPEAT_NS
        self.now_ns = 0

    def advance(self, t_ns: int) -> None:
        """Follow the gates."""
        self.now_ns = t_ns
        self._allowed = min(BURST, self._allowed + 1)

    @property
    def is_due(self) -> bool:
        """Whether a setpoint that has not changed is to be repeated."""
        return self.now_ns - self._sent_ns >= REPEAT_NS

    @property
    def has_room(self) -> bool:
        """Whether more than the repetitions of a setpoint can be sent now."""
        return self._allowed > BURST // 10

    def mode(self, mode: ModeName) -> None:
        """Take off, land, stop the rotors, or leave the emergency."""
        self._allowed -= 1
        self._sender.mode(self.now_ns, mode)

    def steer(self, steering: Steering) -> None:
        """Fly a velocity."""
        self._note()
        frame = "heading" if steering.along_heading else "world"
        self._sender.velocity(self.now_ns, steering.velocity_m_s, steering.yaw_rate_rad_s, frame)

    def tilt(self, target: TiltTarget) -> None:
        """Hold a tilt and a thrust."""
        self._note()
        self._sender.attitude(self.now_ns, target.q_WB, target.thrust_n, target.yaw_rate_rad_s)

    def _note(self) -> None:
        self._sent_ns = self.now_ns
        self._allowed -= 1
