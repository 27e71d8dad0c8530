"""When the next gate may come: by the wall clock, or pipelined where agents may lag several gates behind.

Pipelining: many gates at once cost every process fewer wake-ups. Time is delayed until the slowest agent has nearly
caught up; then gates follow one another until its done is required again. No agent idles meanwhile: the first of
these gates comes while agents still work on the last ones before it.
"""

from zsim_world.run.barrier import Participant
from zsim_world.run.coordinator import Coordinator
from zsim_world.run.run_clock import RunClock

LAG_GATES = 2  # that the slowest agent may still have before it when a series of gates begins
GATES_SENT = 3  # at once; more keep agents waiting that could work
DELAY_MAX_NS = 50_000_000  # wall time that a gate is delayed at most; a slow agent then has all the gates that it may
STOOD_STILL_NS = 1_000_000_000  # wall time by which a gate is late where time stood still rather than being slow


class Pacer:
    """Computes when gates are due by the wall clock.

    Args:
        clock: of the run, with the rate to pace at.
    """

    def __init__(self, clock: RunClock) -> None:
        self._clock = clock
        self._pace = (0.0, 0)  # rate, and jumps of time before it; its start by either clock:
        self._start_wall_ns = 0
        self._start_sim_ns = 0

    def due_ns(self, wall_ns: int) -> int:
        """Return the wall time of the next gate; the pace starts anew when the rate changes or time stood still."""
        clock = self._clock
        if clock.rate <= 0 or clock.state != "running":
            self._pace = (0.0, 0)
            return wall_ns
        if self._pace != (clock.rate, clock.jumps):
            self._pace = (clock.rate, clock.jumps)
            self._start_wall_ns, self._start_sim_ns = wall_ns, clock.next_ns
        due_ns = self._start_wall_ns + round((clock.next_ns - self._start_sim_ns) / clock.rate)
        if clock.mode == "lockstep" and wall_ns - due_ns > STOOD_STILL_NS:
            self.restart()
        return due_ns

    def restart(self) -> None:
        """Let the pace start anew with the next gate, which is due at once."""
        self._pace = (0.0, 0)


class Pipelining:
    """Decides when to delay a gate so that several come at once.

    Args:
        world: in lockstep, as fast as it can; any other is never delayed.
    """

    def __init__(self, world: Coordinator) -> None:
        self._world = world
        self._clock = world.clock
        self._continues = True
        self._delayed_wall_ns = 0
        self._gates = 0
        self._ahead_ns = max(0, self._clock.delay_ns - LAG_GATES * self._clock.gate_ns)

    @property
    def _enabled(self) -> bool:
        """Tell whether agents may lag, and no wall clock paces the gates."""
        return self._ahead_ns > 0 and self._clock.mode == "lockstep" and self._clock.rate <= 0

    def delays(self, wall_ns: int) -> bool:
        """Tell whether to wait although the next gate may come."""
        if self._continues or not self._enabled:
            return False
        late = wall_ns - self._delayed_wall_ns > DELAY_MAX_NS
        self._continues = late or not self._world.blocking(self._ahead_ns)
        return not self._continues

    def continues(self) -> bool:
        """Tell, after a gate, whether the next one comes at once, so that both can be sent together."""
        self._gates = (self._gates + 1) % GATES_SENT
        return self._gates > 0 and self._continues and self._enabled and self._world.may_advance()

    def pause(self, wall_ns: int) -> None:
        """Note that the next gate may not come yet."""
        if self._continues:
            self._continues, self._delayed_wall_ns = False, wall_ns

    def blocking(self) -> list[Participant]:
        """Return whose dones are waited for: those without which time stands, or else those that delay it."""
        return self._world.blocking() or self._world.blocking(self._ahead_ns)
