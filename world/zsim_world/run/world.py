"""The world of a flight: integrates the simulated drones, owns simulated time, applies commands and faults.

It has neither a session nor a wall clock. `zsim_world.run.coordinator` contains the part common to flights and replays.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar

from msgspec import UNSET

from zsim import CONTRACT, __version__
from zsim.contract import keys, messages
from zsim.contract.fingerprint import TruthHash, fingerprint
from zsim.contract.flight_messages import DroneView, Status, ViewDrones
from zsim.contract.keys import SIGHTINGS
from zsim.contract.snapshot import PART, Saved, State, saved_state
from zsim.errors import UserCodeError
from zsim.runtime.agent import Output
from zsim.scenario import scenario_file
from zsim.scenario.roles import WORLD, check_pace, expected_processes
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim.sensors.sensor_catalogue import declarations
from zsim_world.fleet.fleet import DivergedError, ExternalDrones, Fleet
from zsim_world.fleet.publication import GatePublication
from zsim_world.fleet.radio import RadioChannel
from zsim_world.physics.fleet_arrays import STATE
from zsim_world.run.commands import CommandIntake
from zsim_world.run.coordinator import Coordinator
from zsim_world.run.faults import FaultInjector

DURATION_OVER = "the scenario's duration is over"  # why a run of full length ended


class World(Coordinator):
    """One flight.

    Args:
        mode: "lockstep" or "realtime".
        rate: real-time factor, simulated seconds per wall second; 0: as fast as possible.
        run_id: set by a launcher, and by tests that compare records; None: random.
        changed: overrides of the scenario file as `a.b.c=value`; None if unknown.

    Raises:
        ScenarioError: the scenario has external drones and the mode is "lockstep".

    Attributes:
        drivers: drivers of the external drones.
        queue: pending commands and the commander of each drone.
        faults: injected faults.
        truth_hash: hash of the true states up to now.
    """

    SAVED: ClassVar[Saved] = {
        "requests": int,
        "left_early": list[str],
        "clock": PART,
        "outbox": PART,
        "budgets": PART,
        "barrier": PART,
        "statistics": PART,
        "fleet": PART,
        "queue": PART,
        "faults": PART,
        "_publication": PART,
        "drivers": PART,
    }

    def __init__(
        self,
        scenario: Scenario,
        mode: str = "lockstep",
        rate: float = 0.0,
        wall_ns: Callable[[], int] = lambda: 0,
        run_id: str | None = None,
        changed: Sequence[str] | None = None,
    ) -> None:
        check_pace(scenario, mode)
        super().__init__(scenario, mode, rate, wall_ns, run_id, expected_processes(scenario))
        if scenario.own_messages():  # agents read at a gate what others published at the previous one
            self.clock.ahead_ns = 0
        self._changed = UNSET if changed is None else tuple(changed)
        self.fleet = Fleet(scenario)
        self.drivers = ExternalDrones(self.fleet)
        self.external = self.drivers.names
        self.unpaced = frozenset(f"estimator.{drone}" for drone in self.external)
        self._simulated = [i for i in range(self.fleet.count) if i not in self.drivers]
        self.faults = FaultInjector(self, self.fleet.impairment)
        self._intake = CommandIntake(self, self.fleet, self.drivers, self.faults.of_links)
        self.queue = self._intake.queue
        self._operations |= {**self._intake.operations(), **self.faults.operations()}
        self._publication = GatePublication(self.fleet)
        self._radio = RadioChannel(scenario, self.fleet.scene) if scenario.radio_of_agents else None
        self.truth_hash = TruthHash(len(self._simulated))
        self._last_ns = round(scenario.duration_s * 1e9) // self.clock.gate_ns * self.clock.gate_ns
        self.statistics.closest_m = self.fleet.closest_m

    def info(self) -> messages.Info:
        """Return the message of `world/info`."""
        s, env = self.scenario, self.scenario.environment
        text, declared = scenario_file.to_text(s), declarations(s.drones)
        user_sensors = tuple(messages.SensorInfo(name, each.message, each.fields) for name, each in declared.items())
        return messages.Info(
            t_ns=0,
            seq=0,
            contract=CONTRACT,
            run_id=self.run_id,
            federation=s.federation,
            mode="lockstep" if self.clock.mode == "lockstep" else "realtime",
            rate=self.clock.rate,
            gate_ns=self.clock.gate_ns,
            physics_dt_ns=round(s.time.physics_dt_ms * 1e6),
            command_delay_ns=self.clock.delay_ns,
            seed=s.seed,
            origin=messages.Origin(env.latitude_deg, env.longitude_deg, env.height_m),
            drones=tuple(
                messages.DroneInfo(d.name, d.model, self.fleet.rotor_info(i), "external" if d.is_external else UNSET)
                for i, d in enumerate(s.drones)
            ),
            clusters=tuple(messages.ClusterInfo(c.name, tuple(c.drones)) for c in s.clusters),
            scenario=text,
            scenario_sha256=scenario_file.sha256(text),
            version=__version__,
            fingerprint=fingerprint(),
            user_sensors=user_sensors or UNSET,
            sightings=SIGHTINGS in self.fleet.extra_sensors or UNSET,
            scanners=tuple(name for name in self.fleet.extra_sensors if name != SIGHTINGS) or UNSET,
            module_folders=tuple(map(str, plugin.folders())) if s.own_code() else UNSET,
            changed=self._changed,
            user_messages=tuple(s.own_messages()) or UNSET,
        )

    # State

    def checkpoint(self) -> State:
        """Return the state, without the truth hash, from which the run continues with the same bits.

        The outbox must be empty.
        """
        self.truth_hash.flush()
        return saved_state(self)

    def keep_truth(self, copy: Callable[[memoryview], object], hashed: Iterable[bytes] = ()) -> None:
        """Copy all further input of the truth hash to `copy`; `hashed` is its input so far."""
        self.truth_hash.resume(hashed, copy)

    # Inputs

    def _handle_command(self, drone: str, kind: str, message: Any) -> bool:
        return self._intake.accept(drone, kind, message)

    def accept_from_driver(self, drone: str, message: Any) -> str | None:
        former, refusal = self.drivers.status(self.names.index(drone)), self.drivers.take(drone, message, self.now_ns)
        stopped = isinstance(message, Status) and message.state == "emergency"
        if refusal is None and stopped and former and former.state not in ("landed", "emergency"):
            self.outbox.notice("emergency", drone, f"the driver of {drone} reports an emergency", {"cause": "driver"})
        return refusal

    def release_drones(self, name: str) -> None:
        self._intake.release_all(name)

    # Time

    def advance(self, wall_ns: int) -> None:
        """Advance to the next gate, or publish gate 0, and put all its messages into the outbox.

        Commands and faults are applied before the fleet is integrated. A state that has diverged, or a user's sensor
        that fails, ends the run at the previous gate and sets `failure`.
        """
        clock, fleet, statistics, now_ns = self.clock, self.fleet, self.statistics, self.clock.now_ns
        is_first = clock.state == "waiting"
        if is_first:
            clock.start(fleet.t_ns)
        else:
            if clock.mode == "realtime":
                paced = [p for p in self.barrier.participants.values() if not p.served_names <= self.unpaced]
                statistics.deadlines(paced, clock.required_ns)
                self.barrier.give_up_late()
            self._intake.apply(now_ns)
            self.faults.apply(now_ns)
            self.drivers.lead()
        try:
            if not is_first:
                fleet.advance()
            gate = self._publication.gate(self.queue.commanders()) if self._simulated else None
        except (DivergedError, UserCodeError) as error:
            self.failure = error
            if isinstance(error, DivergedError):
                self.outbox.event("diverged", error.drone, str(error), {})
            else:
                self.outbox.event("failure", WORLD, str(error), {"on_death": "end"})
            clock.complete(str(error))
            return
        if not is_first:
            clock.advance(fleet.t_ns)
            statistics.closest_m = min(statistics.closest_m, fleet.closest_m)
            self._publish_incidents()
        state = fleet.bodies.state
        self.truth_hash.add(clock.now_ns, state[self._simulated] if self.external else state)
        if self._radio is not None:  # before the gate, since agents start work when the gate arrives
            position_m, seq = state[:, STATE.p_WB : STATE.p_WB + 3], self.outbox.next_seq(keys.RADIO)
            acting = self.faults.of_links(clock.now_ns)
            self.outbox.put(keys.RADIO, self._radio.links(clock.now_ns, seq, position_m, acting))
        if gate is not None:
            self.outbox.put(keys.GATE, gate)
        statistics.gate(clock.now_ns, wall_ns)
        self.outbox.put(keys.CLOCK, self.clock_message(self.missed(wall_ns)))
        if clock.now_ns >= self._last_ns:
            clock.complete(DURATION_OVER)

    def _publish_incidents(self) -> None:
        for i, j in self.fleet.collisions:
            name, other = self.names[i], self.names[j]
            self.outbox.notice("collision", name, f"{name} and {other} collide", {"other": other})
        for i, m in self.fleet.bumps():
            name, other = self.names[i], self.fleet.object_names[m]
            self.outbox.notice("collision", name, f"{name} runs into {other}", {"other": other})
        for each in self.fleet.incidents():
            data = {**each.data, "commander": self.queue.commanders()[each.drone]}
            self.outbox.notice(each.kind, self.names[each.drone], each.text, data)

    def result(self) -> dict[str, Any]:
        """Return the statistics of the run so far."""
        return {
            "reason": self.ended,
            "last_ns": self.now_ns,
            **self.statistics.result(self.barrier.participants.values()),
            "refused": self.outbox.refusals.count,
            "requests": self.requests,
            "requests_refused": self.outbox.refused_requests.count,
            "events_left_out": self.outbox.left_out,
            "truth_sha256": self.truth_hash.hexdigest(),
        }

    def views(self, seq: int) -> list[Output]:
        return [Output(keys.VIEW_DRONES, self.view(seq))]

    def view(self, seq: int) -> ViewDrones:
        """Return the compact state of all drones."""
        truth = self.fleet.truth()
        drones, commanders = [], self.queue.commanders()
        for i, name in enumerate(self.names):
            state, battery_percent, _ = self.fleet.status(i)
            if status := self.drivers.status(i):
                state, battery_percent = status.state, status.battery_percent
            pose = (tuple(truth.position_m[i].tolist()), tuple(truth.orientation_wxyz[i].tolist()))
            rotors = tuple(truth.rotor_rad_s[i, : self.fleet.rotors[i]].tolist())
            drones.append(DroneView(name, *pose, rotors, state, battery_percent, commanders[i]))
        wind = tuple(tuple(row) for row in self.fleet.wind_m_s.tolist())
        return ViewDrones(self.now_ns, seq, tuple(drones), wind)
