"""Commands from arrival to firmware: checked, delayed by their link, queued, applied, published as events.

The first source to send a setpoint to a drone without a commander becomes its commander, until it releases the drone,
leaves or dies, or another source acquires the drone. Commands that take effect at the same time are ordered by
(priority of the source, source, seq): the last one wins.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from operator import itemgetter
from typing import Any, ClassVar, NamedTuple

import msgspec

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Ardrone
from zsim.contract.run_messages import PRIORITY_MAX, ControlRequest, Fault
from zsim.contract.snapshot import Saved
from zsim.runtime.links import NEVER, RADIO, WORLD, distance_between, drone_of, joins, position_of, total_delay_ns
from zsim_world.fleet.fleet import ExternalDrones, Fleet
from zsim_world.run.coordinator import Coordinator
from zsim_world.run.outbox import Refusal, too_many
from zsim_world.run.run_clock import Operation, number, refused_argument

MISSION_STATES = ("active", "finished", "aborted")
MISSION_ITEMS_MAX, MISSION_REASON_MAX = 1_000_000, 80  # far more items than autopilots store; one line of text
PROGRAM = 0  # priority of a program, by the contract
RECENT_PER_DRONE = 32  # commands remembered to recognise duplicates; a rejoin repeats those of two gates


class CommandIntake:
    """Accepts commands as they arrive and passes them to the fleet when they take effect.

    Args:
        run: the run whose participants send commands.
        drivers: drivers of the fleet's external drones.
        faults_at: returns the link and radio faults that act at a gate.

    Attributes:
        queue: pending commands and the commander of each drone.
    """

    def __init__(
        self, run: Coordinator, fleet: Fleet, drivers: ExternalDrones, faults_at: Callable[[int], Sequence[Fault]]
    ) -> None:
        self._scenario, self._clock, self._barrier, self._outbox = run.scenario, run.clock, run.barrier, run.outbox
        self._budgets = run.budgets
        self._fleet = fleet
        self._drivers = drivers
        self._faults_at = faults_at
        self.queue = CommandQueue(fleet.names)
        self._index = {name: i for i, name in enumerate(fleet.names)}
        self._drones = frozenset(drone.name for drone in run.scenario.drones)
        self._cluster_of = {drone: cluster.name for cluster in run.scenario.clusters for drone in cluster.drones}

    def accept(self, drone: str, kind: str, message: Any) -> bool:
        """Queue a command, or refuse it; return False for a duplicate."""
        source = message.source
        gating = self._barrier.is_gating(source)  # the name of such a source was checked when it joined
        if not gating and not keys.PROCESS_NAME.fullmatch(source):
            refusal = Refusal("source", repr(source[:48]), "must be 1 to 48 of a-z 0-9 _ . -")
            return self._refuse("somebody", drone, kind, refusal)
        index = self._index.get(drone)
        if index is None:
            refusal = Refusal("drone", repr(drone[:40]), "must be one of `drones` in world/info")
            return self._refuse(source, drone, kind, refusal)
        if refusal := self._stamp_refusal(message, gating):
            return self._refuse(source, drone, kind, refusal)
        gate_ns = message.t_ns if gating else self._clock.next_ns
        late_ns = self._link_delay_ns(drone, kind, message, gate_ns)
        if late_ns is None:
            return True  # the link loses it, but it was sent and so counts as an output
        external, delay_ns = index in self._drivers, self._clock.delay_ns
        if external:  # the drone's real link already delays commands
            gate_ns, delay_ns = min(gate_ns, self._clock.now_ns), 0
        apply_ns = gate_ns + delay_ns + late_ns
        if not gating:  # a rerun repeats these commands from their events
            if not self._budgets.spend(source, f"drone/{drone}/cmd/", source in self._barrier.participants):
                return self._refuse(source, drone, kind, too_many(source))
            fields = {name: getattr(message, name) for name in messages.fields(type(message))}
            data = {"command": kind, "apply_t_ns": apply_ns, "message": fields}
            self._outbox.event("command", drone, f"{source} sends {kind} to {drone}", data, source)
        is_new = self.queue.push(index, kind, message, apply_ns)
        if external and is_new:
            for command in self.queue.pop(self._clock.now_ns, self._drivers):
                self._carry_out(command, self._clock.next_ns)
        return is_new

    def _refuse(self, source: str, drone: str, kind: str, refusal: Refusal) -> bool:
        self._outbox.refuse(source, f"drone/{drone[:40]}/cmd/{kind}", refusal)
        return True

    def _stamp_refusal(self, message: Any, gating: bool) -> Refusal | None:
        now_ns = self._clock.now_ns
        if self._clock.mode == "realtime":
            age_ms, max_age_ms = (now_ns - message.t_ns) / 1e6, self._scenario.time.max_command_age_ms
            if age_ms > max_age_ms:
                return Refusal("age", f"{age_ms:.0f} ms", f"must be <= {max_age_ms:g} ms")
        if gating and message.t_ns > now_ns:
            return Refusal("t_ns", str(message.t_ns), f"must be <= {now_ns}, the newest gate")
        return None

    def _link_delay_ns(self, drone: str, kind: str, message: Any, gate_ns: int) -> int | None:
        """Return the delay due to faults of the link to the world [ns], in whole gates; None if the command is lost.

        `gate_ns`: the gate to which the command belongs.
        """
        acting = self._faults_at(gate_ns)
        if not acting:
            return 0
        senders = (self._sender(drone, message.source),)
        faults = [fault for fault in acting if fault.kind != RADIO and joins(fault, senders, WORLD)]
        late_ns = total_delay_ns(faults, self._scenario.seed, WORLD, keys.command(drone, kind), message)
        return NEVER if late_ns is None else -(-late_ns // self._clock.gate_ns) * self._clock.gate_ns

    def _is_lost_by_radio(self, drone: str, command: QueuedCommand, gate_ns: int) -> bool:
        """Return whether the radio loses a command that would take effect before a gate."""
        acting = self._faults_at(gate_ns)
        if not acting:
            return False
        targets = (WORLD, self._cluster_of.get(drone))
        radios = [fault for fault in acting if fault.kind == RADIO and fault.target in targets]
        if not radios:
            return False
        key, sender = keys.command(drone, command.kind), self._sender(drone, command.source)
        if drone_of(sender, self._drones) == drone:
            return False

        def distance_m(fault: Fault) -> float | None:
            position_m = position_of(sender, fault.parameters["place"], self._drones, self._position_m)
            return distance_between(self._position_m(drone), position_m)

        return total_delay_ns(radios, self._scenario.seed, WORLD, key, command.message, distance_m) is NEVER

    def _sender(self, drone: str, source: str) -> str:
        """Return the sender of a command: the source, or the drone's controller if the source hosts it."""
        controller = f"controller.{self._cluster_of.get(drone)}"
        participant = self._barrier.participants.get(source)
        return controller if participant is not None and controller in participant.join.serves else source

    def _position_m(self, drone: str) -> list[float] | None:
        """Return the true position of a drone [m; W]; None for an unknown drone."""
        i = self._index.get(drone)
        return self._fleet.bodies.state[i, :3].tolist() if i is not None else None

    # Application

    def apply(self, t_ns: int) -> None:
        """Pass the commands that take effect at t_ns to the firmware."""
        for command in self.queue.pop(t_ns):
            self._carry_out(command, t_ns + self._clock.gate_ns)

    def _carry_out(self, command: QueuedCommand, gate_ns: int) -> None:
        """Pass on a command that takes effect before a gate, or drop it if the radio loses it or it is refused."""
        drone = self._fleet.names[command.drone]
        if self._is_lost_by_radio(drone, command, gate_ns):
            return
        refusal = self.queue.refusal(command)
        if refusal is None and command.kind == "mode":
            refusal = self._apply_mode(drone, command)
        elif refusal is None:
            refusal = self._apply_setpoint(command)
            if refusal is None and self.queue.claim(command.drone, command.source):
                self._outbox.event("commander", drone, f"{command.source} flies {drone}", source=command.source)
        if refusal:
            self._outbox.refuse(command.source, keys.command(drone, command.kind), refusal)

    def _apply_setpoint(self, command: QueuedCommand) -> str | None:
        m, i, fleet = command.message, command.drone, self._fleet
        if i in self._drivers:
            return self._hand_on(command)
        if command.kind == "velocity":
            return fleet.set_velocity(i, m.velocity_m_s, m.yaw_rate_rad_s, m.frame)
        if command.kind == "ardrone":
            return fleet.set_ardrone(i, m.forward, m.left, m.up, m.yaw_left, m.hover)
        if command.kind == "attitude":
            return fleet.set_attitude(i, m.orientation_wxyz, m.thrust_n, m.yaw_rate_rad_s)
        return fleet.set_rotors(i, m.speed_rad_s)

    def _apply_mode(self, drone: str, command: QueuedCommand) -> str | None:
        fleet, source, mode = self._fleet, command.source, command.message.mode
        enter = {"takeoff": fleet.takeoff, "land": fleet.land, "emergency": fleet.emergency, "reset": fleet.reset}
        reported = self._drivers.status(command.drone)
        was = reported.state if reported else fleet.status(command.drone)[0]
        refusal = self._hand_on(command) if command.drone in self._drivers else enter[mode](command.drone)
        if refusal is None:
            self._outbox.notice("mode", drone, f"{source} asks {drone} to {mode}", {"mode": mode}, source)
        if refusal is None and mode == "emergency" and was not in ("landed", "emergency"):
            text = f"{source} stops the rotors of {drone}, which is {was}"
            self._outbox.notice("emergency", drone, text, {"cause": "command"}, source)
        return refusal

    def _hand_on(self, command: QueuedCommand) -> str | None:
        """Publish a command for the driver of an external drone; return why it is refused, or None."""
        refusal = self._drivers.command_refusal(command.drone, command.kind, command.message)
        if refusal is None:
            self._put_accepted(command.drone, command.kind, command.message)
        return refusal

    def _put_accepted(self, i: int, kind: str, message: Any) -> None:
        key = keys.accepted(self._fleet.names[i], kind)
        self._outbox.put(key, msgspec.structs.replace(message, seq=self._outbox.next_seq(key)))

    def _release_drone(self, i: int) -> None:
        """Make a drone that has lost its commander hover."""
        if i in self._drivers:
            hover = Ardrone(self._clock.now_ns, 0, WORLD, 0.0, 0.0, 0.0, 0.0, hover=True)
            self._put_accepted(i, "ardrone", hover)
        else:
            self._fleet.release(i)

    def release_all(self, source: str) -> None:
        """Release the drones commanded by a process that has left or died; they hover."""
        for i in self.queue.remove_source(source):
            self._release_drone(i)
            self._outbox.event("release", self._fleet.names[i], f"{source} no longer flies it", source=source)

    # Requests

    def operations(self) -> dict[str, Operation]:
        """Return the handlers of the `op` values on `world/control` that concern commanders."""
        return dict.fromkeys(("acquire", "release", "mission"), self._operate)

    def _operate(self, request: ControlRequest) -> Refusal | None:
        name, priority = request.args.get("drone"), number(request.args.get("priority", 0))
        index = self._index.get(name) if isinstance(name, str) else None
        if index is None:
            return refused_argument(request, "drone", f"one of {', '.join(self._index)}")
        if request.op == "mission":
            return self._report_mission(request, self._fleet.names[index])
        if request.op == "release":
            refusal = self.queue.release(index, request.source)
            if refusal is None:
                self._release_drone(index)
            return refusal
        if priority is None or not 0 <= priority <= PRIORITY_MAX:
            return refused_argument(request, "priority", f"from 0 to {PRIORITY_MAX}")
        if not request.source:
            return Refusal("source", "empty", "must be the name of the source that will send the commands")
        return self.queue.acquire(index, request.source, int(priority))

    def _report_mission(self, request: ControlRequest, drone: str) -> Refusal | None:
        """Publish the reported progress of a drone's mission."""
        args = request.args
        if args.get("state") not in MISSION_STATES:
            return refused_argument(request, "state", f"one of {', '.join(MISSION_STATES)}")
        for name in ("items", "done"):
            if type(args.get(name)) is not int or not 0 <= args[name] <= MISSION_ITEMS_MAX:
                return refused_argument(request, name, f"a whole number from 0 to {MISSION_ITEMS_MAX}")
        reason = str(args.get("reason", ""))[:MISSION_REASON_MAX]
        data = {name: args[name] for name in ("state", "items", "done")}
        data |= {"reason": reason, "failsafe": args.get("failsafe") is True}
        text = f"{drone}: mission {data['state']}, {data['done']} of {data['items']} items flown"
        self._outbox.notice("mission", drone, f"{text}: {reason}" if reason else text, data, request.source)
        return None


class QueuedCommand(NamedTuple):
    """A command that takes effect at `apply_ns`. Commands are sorted by all fields except the message."""

    apply_ns: int
    priority: int
    source: str
    seq: int
    drone: int  # with `kind`, makes the order independent of arrival
    kind: str
    message: Any


class Commander(NamedTuple):
    """The source that commands a drone."""

    source: str
    priority: int


class CommandQueue:
    """The pending commands and the commander of each of the given drones."""

    SAVED: ClassVar[Saved] = {
        "_commanders": list[Commander | None],
        "_priorities": dict[tuple[int, str], int],
        "_queued": dict[int, list[QueuedCommand]],
        "_recent": dict[tuple[int, str, int, str, int], Any],
    }

    def __init__(self, drones: list[str]) -> None:
        self._names = drones
        self._commanders: list[Commander | None] = [None] * len(drones)
        self._priorities: dict[tuple[int, str], int] = {}
        self._queued: dict[int, list[QueuedCommand]] = {}  # commands by the time at which they take effect
        self._recent: dict[tuple[int, str, int, str, int], Any] = {}  # messages by fields that are quick to compare

    def restored(self) -> None:
        """Convert the messages, which a saved state stores as maps, to their types."""
        for t_ns, queued in self._queued.items():
            self._queued[t_ns] = [each._replace(message=_command(each.kind, each.message)) for each in queued]
        self._recent = {mark: _command(mark[1], message) for mark, message in self._recent.items()}

    def push(self, drone: int, kind: str, message: Any, apply_ns: int) -> bool:
        """Queue a command to take effect at `apply_ns`; return False for a duplicate."""
        mark = (drone, kind, apply_ns, message.source, message.seq)
        if self._recent.get(mark) == message:
            return False
        self._recent[mark] = message
        if len(self._recent) > RECENT_PER_DRONE * len(self._names):
            del self._recent[next(iter(self._recent))]
        priority = self._priorities.get((drone, message.source), PROGRAM)
        command = QueuedCommand(apply_ns, priority, message.source, message.seq, drone, kind, message)
        self._queued.setdefault(apply_ns, []).append(command)
        return True

    def pop(self, t_ns: int, drones: Container[int] | None = None) -> list[QueuedCommand]:
        """Remove and return, in order of effect, commands to `drones` (default: all) that take effect up to t_ns."""
        instants = sorted([instant for instant in self._queued if instant <= t_ns])
        due = [command for instant in instants for command in sorted(self._queued.pop(instant), key=_order)]
        if drones is None:
            return due
        for command in due:
            if command.drone not in drones:
                self._queued.setdefault(command.apply_ns, []).append(command)
        return [command for command in due if command.drone in drones]

    def commanders(self) -> list[str | None]:
        """Return the name of each drone's commander, None for a drone without one."""
        return [commander.source if commander else None for commander in self._commanders]

    def refusal(self, command: QueuedCommand) -> Refusal | None:
        """Return why the source may not command the drone now; None if it may."""
        commander = self._commanders[command.drone]
        if commander is None or commander.source == command.source:
            return None
        if command.kind == "mode" and command.priority >= commander.priority:
            return None
        state = f"flown by {commander.source!r} (priority {commander.priority})"
        return Refusal(self._names[command.drone], state, "acquire it with a higher priority through world/control")

    def claim(self, drone: int, source: str) -> bool:
        """Make the source the commander if the drone has none; return whether it became commander."""
        if self._commanders[drone] is not None:
            return False
        self._commanders[drone] = Commander(source, self._priorities.get((drone, source), PROGRAM))
        return True

    def acquire(self, drone: int, source: str, priority: int) -> Refusal | None:
        """Make the source the commander; return the refusal if another commander's priority is not lower."""
        commander = self._commanders[drone]
        if commander is not None and commander.source != source and priority <= commander.priority:
            state = f"flown by {commander.source!r} with priority {commander.priority}"
            return Refusal(self._names[drone], state, "acquire it with a higher priority")
        self._priorities[drone, source] = priority
        self._commanders[drone] = Commander(source, priority)
        return None

    def release(self, drone: int, source: str) -> Refusal | None:
        """Take the drone from its commander; return the refusal if the source is not the commander."""
        commander = self._commanders[drone]
        if commander is None or commander.source != source:
            owner = f"{commander.source!r}" if commander else "nobody"
            state = f"flown by {owner}, not by {source!r}"
            return Refusal(self._names[drone], state, "only its commander can release it")
        self._commanders[drone] = None
        self._priorities.pop((drone, source), None)
        self._drop_setpoints(source, [drone])  # a setpoint still queued would make the source the commander again
        return None

    def remove_source(self, source: str) -> list[int]:
        """Remove a source that has left, with its priorities; return the indices of the drones it commanded."""
        drones = [i for i, commander in enumerate(self._commanders) if commander and commander.source == source]
        for drone in drones:
            self._commanders[drone] = None
        for drone in range(len(self._names)):
            self._priorities.pop((drone, source), None)
        self._drop_setpoints(source, range(len(self._names)))
        return drones

    def _drop_setpoints(self, source: str, drones: Container[int]) -> None:
        """Remove the queued setpoints of a source to some drones; mode commands stay queued."""
        for instant, queued in self._queued.items():
            remaining = [c for c in queued if c.kind == "mode" or c.source != source or c.drone not in drones]
            self._queued[instant] = remaining


def _command(kind: str, fields: Any) -> Any:
    return msgspec.convert(fields, messages.type_of(keys.command("any", kind)))


_order = itemgetter(slice(6))  # all fields of a QueuedCommand except the message
