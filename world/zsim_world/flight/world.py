"""The world of a run: integrates all drones, owns simulated time, judges commands. No session, no clock.

What it shares with a replay, first of all who takes part and who is waited for, is in `zsim_world.flight.coordinator`.
"""

from collections.abc import Callable
from typing import Any

from zsim import CONTRACT, __version__
from zsim.contract import batch, keys, messages
from zsim.contract.fingerprint import fingerprint
from zsim.runtime.agent import Output
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_world.fleet.fleet import DivergedError, Fleet
from zsim_world.fleet.publication import GatePublication, TruthDigest
from zsim_world.flight.command_intake import CommandDesk
from zsim_world.flight.commander import Commanders
from zsim_world.flight.control_requests import Requests
from zsim_world.flight.coordinator import Hub
from zsim_world.flight.fault_injector import FaultDesk


class World(Hub):
    """One run.

    Args:
        scenario: resolved.
        mode: "lockstep" or "realtime".
        rate: simulated per wall seconds to pace at; 0 = as fast as possible.
        wall_ns: monotonic wall time.
        run_id: given by a launcher, and by tests that compare records.

    Attributes:
        faults: that are injected.
        ended: why the run is over, None while it goes on.
        diverged: what is to be raised once everybody has been told the end, None for a state that stayed finite.
    """

    def __init__(
        self,
        scenario: Scenario,
        mode: str = "lockstep",
        rate: float = 0.0,
        wall_ns: Callable[[], int] = lambda: 0,
        run_id: str | None = None,
    ) -> None:
        super().__init__(scenario, mode, rate, wall_ns, run_id, scenario.expected())
        self.fleet = Fleet(scenario)
        self._publication = GatePublication(self.fleet)
        self.index = {name: i for i, name in enumerate(self.names)}
        self.commanders = Commanders(self.names)
        self.faults = FaultDesk(self)
        self._desk = CommandDesk(self)
        self._requests = Requests(self)
        self._hash = TruthDigest(self.fleet.count)
        self._measured.apart(self.fleet.closest_m())

    @property
    def now_ns(self) -> int:
        """Return the newest gate; 0 before the start too."""
        return self.fleet.t_ns

    def info(self) -> messages.Info:
        """Return the message of `world/info`."""
        s, env = self.scenario, self.scenario.environment
        text = scenario_file.to_text(s)
        return messages.Info(
            t_ns=0,
            seq=0,
            contract=CONTRACT,
            run_id=self.run_id,
            federation=s.federation,
            mode="lockstep" if self.mode == "lockstep" else "realtime",
            rate=self.rate,
            gate_ns=self.gate_ns,
            physics_dt_ns=round(s.time.physics_dt_ms * 1e6),
            command_delay_ns=self.delay_ns,
            seed=s.seed,
            origin=messages.Origin(env.latitude_deg, env.longitude_deg, env.height_m),
            drones=tuple(messages.DroneInfo(d.name, d.model) for d in s.drones),
            clusters=tuple(messages.ClusterInfo(c.name, tuple(c.drones)) for c in s.clusters),
            scenario=text,
            scenario_sha256=scenario_file.sha256(text),
            version=__version__,
            fingerprint=fingerprint(),
        )

    # What arrives

    def _command(self, drone: str, kind: str, message: Any) -> bool:
        return self._desk.take(drone, kind, message)

    def _leave_drones(self, name: str) -> None:
        for drone in self.commanders.gone(name):
            self.fleet.release(drone)
            self.event("release", self.fleet.names[drone], f"{name} flies it no longer", source=name)

    # Time

    def advance(self, wall_ns: int) -> None:
        """Go to the next gate (or publish gate 0) and put all its messages into the outbox.

        A state that is no longer finite ends the run at the gate before; see `diverged`.
        """
        if self.state == "waiting":
            self.state = "running"
        elif not self._integrate():
            return
        self._publish_gate(wall_ns)
        if self.now_ns >= self.last_ns:
            self.stop("the scenario's duration is over")

    def _integrate(self) -> bool:
        """Integrate one gate; return whether the state is still finite."""
        if self.mode == "realtime":
            self._measured.deadlines_of(self.barrier.participants.values(), self.now_ns - self.delay_ns)
        self._desk.apply(self.now_ns)
        self.faults.apply(self.now_ns)
        try:
            self.fleet.advance()
        except DivergedError as error:
            self.diverged = error
            self.event("diverged", error.drone, str(error))
            self.stop(str(error))
            return False
        self.steps_allowed = max(0, self.steps_allowed - 1)
        self._measured.apart(self.fleet.closest_m())
        self._tell_collisions()
        return True

    def _tell_collisions(self) -> None:
        for i, j in self.fleet.collisions():
            pair = f"{self.fleet.names[i]} and {self.fleet.names[j]}"
            self.event("collision", self.fleet.names[i], f"{pair} collide", other=self.fleet.names[j])
        for i, m in self.fleet.bumps():
            name, other = self.fleet.names[i], self.scenario.environment.obstacles[m].name
            self.event("collision", name, f"{name} runs into {other}", other=other)

    def _publish_gate(self, wall_ns: int) -> None:
        self._hash.add(self.now_ns, self.fleet.bodies.state)
        self.outbox.append((batch.GATE, self._publication.gate(self.commanders.holders())))
        self._measured.gate(self.now_ns, wall_ns)
        self.tell_clock()

    def result(self) -> dict[str, Any]:
        """Return what the run measured of itself."""
        return {
            "reason": self.ended,
            "last_ns": self.now_ns,
            **self._measured.result(self.barrier.participants.values()),
            "refused": self.refused,
            "truth_sha256": self._hash.hexdigest(),
        }

    def views(self, seq: int) -> list[Output]:
        return [Output(keys.VIEW_DRONES, self.view(seq))]

    def view(self, seq: int) -> messages.ViewDrones:
        """Return the compact state for eyes."""
        truth = self.fleet.truth()
        drones, commanders = [], self.commanders.holders()
        for i, name in enumerate(self.fleet.names):
            state, battery_percent, _ = self.fleet.status(i)
            pose = (tuple(truth.position_m[i].tolist()), tuple(truth.orientation_wxyz[i].tolist()))
            rotors = tuple(truth.rotor_rad_s[i, : self.fleet.rotors[i]].tolist())
            drones.append(messages.DroneView(name, *pose, rotors, state, battery_percent, commanders[i]))
        wind = tuple(tuple(row) for row in self.fleet.wind_m_s.tolist())
        return messages.ViewDrones(self.now_ns, seq, tuple(drones), wind)
