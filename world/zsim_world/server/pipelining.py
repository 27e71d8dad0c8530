"""Gates in bursts: where agents may lag several gates behind, many gates at once cost every process fewer wake-ups.

Time is held back until the slowest has nearly caught up; then gates follow one another until it is needed again.
Nobody starves meanwhile: the first gate of a burst comes while the last ones of the former are worked on.
"""

from zsim_world.flight.barrier import Participant
from zsim_world.flight.coordinator import Hub

LAG_GATES = 2  # that the slowest may still have before it when a burst begins
GATES_SENT = 3  # at once; more keep agents waiting that could work
HOLD_NS = 50_000_000  # wall time that a gate is held back at most; a slow agent then has all the gates that it may


class Burst:
    """Tells when to hold back.

    Args:
        world: in lockstep, as fast as it can.
    """

    def __init__(self, world: Hub) -> None:
        self._world = world
        self._goes_on = True
        self._since_wall_ns = 0
        self._gates = 0
        self._ahead_ns = max(0, world.delay_ns - LAG_GATES * world.gate_ns)

    @property
    def _free(self) -> bool:
        """Tell whether agents may lag, and no wall clock paces the gates."""
        return self._ahead_ns > 0 and self._world.mode == "lockstep" and self._world.rate <= 0

    def holds_back(self, wall_ns: int) -> bool:
        """Tell whether to wait although the next gate may come."""
        world = self._world
        if self._goes_on or not self._free:
            return False
        self._goes_on = not world.owing(self._ahead_ns) or wall_ns - self._since_wall_ns > HOLD_NS
        return not self._goes_on

    def goes_on(self) -> bool:
        """Tell, after a gate, whether the next one comes at once, so that what is said can be sent together."""
        world = self._world
        self._gates = (self._gates + 1) % GATES_SENT
        return self._gates > 0 and self._goes_on and self._free and world.may_advance()

    def end(self, wall_ns: int) -> None:
        """Note that the next gate may not come yet."""
        if self._goes_on:
            self._goes_on, self._since_wall_ns = False, wall_ns

    def owing(self) -> list[Participant]:
        """Return whose dones are waited for: those without which time stands, or else those that hold it back."""
        return self._world.owing() or self._world.owing(self._ahead_ns)
