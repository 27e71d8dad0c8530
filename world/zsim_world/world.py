"""The world of a run: integrates all drones, owns simulated time, judges commands. No session, no clock.

A runner hands it what arrives (`handle`, `died`, `control`), asks whether it may go on (`may_advance`), lets it
go on (`advance`), and publishes what it puts into the outbox. Wall times are passed in.
"""

import uuid
from collections.abc import Callable
from typing import Any

from zsim import CONTRACT, __version__, batch, keys, messages, scenario_file
from zsim.death import on_death
from zsim.fingerprint import fingerprint
from zsim.scenario import Scenario
from zsim_world.barrier import Barrier, Participant
from zsim_world.command_desk import CommandDesk
from zsim_world.commander import Commanders
from zsim_world.fleet import DivergedError, Fleet
from zsim_world.publication import Publication
from zsim_world.requests import Requests, brief
from zsim_world.statistics import Measurements
from zsim_world.truth_hash import TruthHash

Said = tuple[str, Any]  # key and message; or batch.GATE and the Bundle of what the drones say at a gate
REFUSALS_TOLD = 20  # events per source and reason; what follows is counted only


class World:
    """One run.

    Args:
        scenario: resolved.
        mode: "lockstep" or "realtime".
        rate: simulated per wall seconds to pace at; 0 = as fast as possible.
        wall_ns: monotonic wall time.
        run_id: given by a launcher, and by tests that compare records.

    Attributes:
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
        self.scenario = scenario
        self.mode = mode
        self.rate = rate
        self.run_id = run_id or uuid.uuid4().hex[:12]
        self.gate_ns = round(scenario.time.gate_ms * 1e6)
        self.delay_ns = scenario.time.command_delay_gates * self.gate_ns
        self.last_ns = round(scenario.duration_s * 1e9) // self.gate_ns * self.gate_ns
        self.outbox: list[Said] = []
        self.state = "waiting"
        self.ended: str | None = None
        self.diverged: DivergedError | None = None
        self.refused = 0
        self._wall_ns = wall_ns
        self._start_wall_ns = wall_ns()
        self.fleet = Fleet(scenario)
        self._publication = Publication(self.fleet)
        self.index = {name: i for i, name in enumerate(self.fleet.names)}
        self.barrier = Barrier(self.run_id, self.gate_ns, expected(scenario))
        self.commanders = Commanders(self.fleet.names)
        self._desk = CommandDesk(self)
        self._requests = Requests(self)
        self._hash = TruthHash(self.fleet.count)
        self._measured = Measurements(self.fleet.closest_m())
        self.steps_allowed = 0
        self._told: dict[tuple[str, str], int] = {}
        self._seq: dict[str, int] = {}

    @property
    def now_ns(self) -> int:
        """Return the newest gate; 0 before the start too."""
        return self.fleet.t_ns

    @property
    def next_ns(self) -> int:
        """Return the gate that a newcomer is first waited for."""
        return 0 if self.state == "waiting" else self.now_ns + self.gate_ns

    def info(self) -> messages.Info:
        """Return the message of `world/info`."""
        s, env = self.scenario, self.scenario.environment
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
            scenario=scenario_file.to_text(s),
            scenario_sha256=scenario_file.sha256(s),
            version=__version__,
            fingerprint=fingerprint(),
        )

    # What arrives

    def handle(self, key: str, message: Any, wall_ns: int) -> None:
        """Take one message that a participant or anyone else published."""
        kind, name, what = keys.parts(key)
        if kind == "process" and what == "done":
            self._on_done(name, message, wall_ns)
        elif kind == "drone" and what.startswith("cmd/"):
            self.barrier.received(message.source)
            if self._desk.take(name, what[4:], message):
                self._measured.ages.arrived(message.t_ns, wall_ns)
        elif kind == "process" and what == "join":
            self._on_join(name, message, wall_ns)
        elif kind == "process" and what == "bye":
            self._on_bye(name, message)

    def output_of(self, source: str) -> None:
        """Count an output (estimate, cluster state) of a participant."""
        self.barrier.received(source)

    def _on_done(self, name: str, message: messages.Done, wall_ns: int) -> None:
        reason = self.barrier.done(name, message, self.now_ns, wall_ns)
        if reason:
            self.refuse(name, f"process/{name}/done", reason)

    def _on_join(self, name: str, message: messages.Join, wall_ns: int) -> None:
        former, replaced = self.barrier.participants.get(name), self.barrier.replaced(name, message)
        reason = self.barrier.join(name, message, self.next_ns, wall_ns)
        if reason:
            self.refuse(name, f"process/{name}/join", reason)
            return
        again = former is not None and former.incarnation != message.incarnation
        kind = ("superseded" if former.alive else "restart") if former and again else "join"
        joined = self.barrier.participants[name]
        data: dict[str, Any] = {
            "incarnation": message.incarnation,
            "host": message.host,
            "pid": message.pid,
            "from_ns": joined.from_ns,
            "done_ns": joined.done_ns,
            **({"serves": message.serves} if message.serves else {}),
        }
        if former is not None and again:
            data["former_pid"] = former.pid
        self.event(kind, name, f"{name} on {message.host} (pid {message.pid})", source=name, **data)
        for dead in replaced:
            self._leave_drones(dead.name)
        self._warn_fingerprint(name, message)
        self._warn_doubled(name)

    def _warn_doubled(self, name: str) -> None:
        for other, both in self.barrier.doubles(name).items():
            text = f"{name} and {other} both do the work of {', '.join(sorted(both))}; end one of them"
            self.event("doubled", name, text, other=other)

    def _warn_fingerprint(self, name: str, message: messages.Join) -> None:
        if message.fingerprint and message.fingerprint != fingerprint():
            text = f"{name} on {message.host} computes with another numeric fingerprint; the same bits are not promised"
            self.event("fingerprint", name, text, found=message.fingerprint, expected=fingerprint())

    def _on_bye(self, name: str, message: messages.Bye) -> None:
        participant = self.barrier.remove(name)
        if participant is not None:
            self.event("leave", name, f"{name} left: {message.reason}", source=name, reason=message.reason)
            self._leave_drones(name)
            if self.state == "waiting":
                self._expect_again(name, *participant.serves)
            if participant.role == "recorder" and not self.ended:
                self.stop(f"the recorder left: {message.reason}")

    def _expect_again(self, *names: str) -> None:
        for name in names:
            if name in expected(self.scenario):
                self.barrier.expect(name)

    def died(self, name: str, wall_ns: int) -> None:
        """Take the death of a process: its token is gone without a bye."""
        participant = self.barrier.died(name, wall_ns)
        if participant is None:
            return
        stand_in = self.barrier.stand_in(name)
        what = "drop" if stand_in else on_death(self.scenario.processes.on_death, name, participant.role)
        then = f"{stand_in.name} does its work" if stand_in else f"on_death: {what}"
        text = f"{name} on {participant.host} (pid {participant.pid}) died; {then}"
        self.event("death", name, text, host=participant.host, pid=participant.pid, on_death=what)
        if self.mode == "realtime" or what == "drop":
            self._leave_drones(name)
        if what == "drop":
            self.barrier.remove(name)
        if what == "drop" and stand_in is None:
            self.event("drop", name, f"{name} is waited for no longer", from_ns=self.now_ns)
        if what == "end":
            self.stop(f"{name} died")

    def _leave_drones(self, name: str) -> None:
        for drone in self.commanders.gone(name):
            self.fleet.release(drone)
            self.event("release", self.fleet.names[drone], f"{name} flies it no longer", source=name)

    def refuse(self, source: str, subject: str, reason: str) -> None:
        """Count a refusal, and tell it while it is not told too often."""
        self.refused += 1
        told = self._told.get((source, subject), 0)
        self._told[source, subject] = told + 1
        if told < REFUSALS_TOLD:
            last = " (further ones are counted only)" if told == REFUSALS_TOLD - 1 else ""
            self.event("refused", subject, f"{subject}: {reason}{last}", source=source, reason=reason)
        if len(self._told) > 10_000:
            self._told.clear()

    # Requests

    def control(self, request: messages.ControlRequest) -> messages.ControlAnswer:
        """Answer a request on `world/control`; every one is an event."""
        answer = self._requests.answer(request)
        op, source = request.op[:40], request.source if keys.PROCESS_NAME.fullmatch(request.source) else ""
        text = f"{source or 'somebody'} asks {op}: {'done' if answer.ok else answer.error}"
        self.event("control", op, text, source=source, args=brief(request.args), ok=answer.ok)
        return answer

    def stop(self, reason: str) -> None:
        """End the run after the present gate; of several reasons the first is told."""
        if self.ended is None:
            self.ended = reason

    # Time

    def may_advance(self) -> bool:
        """Tell whether nothing but pacing keeps the world from the next gate."""
        if self.ended is not None:
            return False
        if self.state == "waiting":
            return not self.barrier.absent()
        if self.state == "paused" and self.steps_allowed == 0:
            return False
        return self.mode == "realtime" or not self.barrier.blocking(self.now_ns - self.delay_ns)

    def owing(self, ahead_ns: int = 0) -> list[Participant]:
        """Return who owes a done without which the world cannot go on, or could not after so much more time."""
        return self.barrier.blocking(self.now_ns - self.delay_ns + ahead_ns)

    def waiting_for(self, wall_ns: int) -> tuple[messages.Waiting, ...]:
        """Return whom the world waits for now."""
        if self.mode == "realtime" and self.state != "waiting":
            return tuple(
                messages.Waiting(p.name, p.host, (wall_ns - p.since_wall_ns) / 1e9)
                for p in self.barrier.participants.values()
                if not p.alive
            )
        return self.barrier.waiting_for(self.now_ns - self.delay_ns, wall_ns, self._start_wall_ns)

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

    def missed_own_deadline(self) -> None:
        """Count a gate that the world itself published more than a gate late."""
        self._measured.own_misses += 1

    def _tell_collisions(self) -> None:
        for i, j in self.fleet.collisions():
            pair = f"{self.fleet.names[i]} and {self.fleet.names[j]}"
            self.event("collision", self.fleet.names[i], f"{pair} collide", other=self.fleet.names[j])

    def _publish_gate(self, wall_ns: int) -> None:
        self._hash.add(self.now_ns, self.fleet.bodies.state)
        self.outbox.append((batch.GATE, self._publication.gate(self.commanders.holders())))
        self._measured.gate(self.now_ns, wall_ns)
        self.tell_clock()

    def tell_clock(self, waiting_for: tuple[messages.Waiting, ...] = ()) -> None:
        """Put a `clock` into the outbox."""
        clock = messages.Clock(
            t_ns=self.now_ns,
            seq=self._next_seq(keys.CLOCK),
            run_id=self.run_id,
            step=self.now_ns // self.gate_ns,
            state=self.state,  # type: ignore[arg-type]
            rate=round(self._measured.rate.now(), 3),
            waiting_for=waiting_for,
        )
        self.outbox.append((keys.CLOCK, clock))

    def tell_end(self, wall_ns: int) -> None:
        """Put the last words of the run into the outbox: event `end`, clock `stopped`."""
        self.ended = self.ended or "ended"
        self.event("end", "world", self.ended, **self.result())
        self.state = "stopped"
        self.tell_clock()

    def result(self) -> dict[str, Any]:
        """Return what the run measured of itself."""
        return {
            "reason": self.ended,
            "last_ns": self.now_ns,
            **self._measured.result(self.now_ns, self.barrier.participants.values()),
            "refused": self.refused,
            "truth_sha256": self._hash.hexdigest(),
        }

    def view(self, seq: int) -> messages.ViewDrones:
        """Return the compact state for eyes."""
        truth = self.fleet.truth()
        drones = []
        for i, name in enumerate(self.fleet.names):
            state, battery_percent, _ = self.fleet.status(i)
            pose = (tuple(truth.position_m[i].tolist()), tuple(truth.orientation_wxyz[i].tolist()))
            rotors = tuple(truth.rotor_rad_s[i].tolist())
            drones.append(messages.DroneView(name, *pose, rotors, state, battery_percent))
        wind = tuple(tuple(row) for row in self.fleet.wind_m_s.tolist())
        return messages.ViewDrones(self.now_ns, seq, tuple(drones), wind)

    def event(self, kind: str, subject: str, text: str, source: str = "world", **data: Any) -> None:
        """Put an event into the outbox."""
        message = messages.Event(self.now_ns, self._next_seq(keys.EVENT), kind, source, subject, text, data)
        self.outbox.append((keys.EVENT, message))

    def take_outbox(self) -> list[Said]:
        """Return what is to be published, in order, and forget it."""
        outbox, self.outbox = self.outbox, []
        return outbox

    def _next_seq(self, key: str) -> int:
        count = self._seq.get(key, 0)
        self._seq[key] = count + 1
        return count


def expected(scenario: Scenario) -> list[str]:
    """Return the names of the processes without which a run does not start."""
    if scenario.processes.expect is not None:
        return list(scenario.processes.expect)
    estimators = [f"estimator.{drone.name}" for drone in scenario.drones]
    return estimators + [f"controller.{cluster.name}" for cluster in scenario.clusters]
