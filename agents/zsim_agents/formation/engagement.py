"""The phases of a formation flight: take-off, assembly, engaged flight on references, hold, landing.

`Engagement` does not communicate: at each gate it takes estimates and returns commands; requests arrive between gates.
Every engagement, resumption and reference is checked, every refusal gives a reason, and every new reference starts at
the estimate of the formation or continues the previous reference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from zsim.contract.snapshot import State, checked
from zsim.schema import plugin
from zsim_agents.formation.assembly import Assembly, assembly_goal, planned_assembly
from zsim_agents.formation.control_law import (
    ControlLaw,
    FormationCommand,
    FormationGains,
    Pairs,
    ProportionalLaw,
    RobotLimits,
    guard,
)
from zsim_agents.formation.flight_check import (
    AIRBORNE,
    ASSEMBLY_CLIMB_M_S,
    ASSEMBLY_HEIGHT_M,
    DOWN,
    GUARD_PARTS,
    HELD_ON_REQUEST,
    READY_TO_ENGAGE,
    RECOVERY_S,
    REJOINING,
    RESEND_S,
    SHAPE,
    SHAPE_IN_FLIGHT,
    TOO_NEAR,
    EngagementLimits,
    FlightCheck,
    GateInput,
    GateOutput,
    ModeCommand,
    formation_fault,
    place_fault,
    setpoints,
)
from zsim_agents.formation.flight_plan import (
    REFUSALS,
    Assemble,
    FlightPlan,
    FlightRequest,
    MoveTo,
    Order,
    RefusalError,
    Scheduled,
)
from zsim_agents.formation.guidance import REJOINED_M, AssignedPositions, Guidance
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace

DT_MAX_S = 0.1  # maximum integration step, which applies after a gap
CLIMB_GAIN_1_S = 0.8  # proportional gain of the climb to the assembly height
HOLD_APART_M = 0.1  # margin above the minimum separation while a formation is held


class Engagement:
    """The state machine of a formation's flight phases.

    Args:
        drones: names of the drones, in the order of the robots.
        plan: requests of the scenario; a landing request drops the remaining ones.

    Raises:
        ValueError: the plan is impossible (see `FlightPlan`), or the number of names is not n.
    """

    def __init__(
        self,
        space: ClusterSpace,
        drones: Sequence[str],
        gains: FormationGains | None = None,
        limits: EngagementLimits | None = None,
        plan: Sequence[Scheduled] = (),
        law: Callable[[ClusterSpace, FormationGains], ControlLaw] = ProportionalLaw,
    ) -> None:
        if len(drones) != space.n:
            raise ValueError(f"cluster: {len(drones)} drones; allowed: {space.n}, one per robot of its cluster space")
        self.space = space
        self.drones = tuple(drones)
        self.gains = gains or FormationGains()
        self.law = law(space, self.gains)
        self.law.robots = self.drones
        self.guidance = Guidance(space, self.gains)
        self.plan = FlightPlan(space, plan)
        self.check = FlightCheck(space, self.drones, self.gains, limits or EngagementLimits())
        self._held_limits = self.gains.limits._replace(separation_min_m=self.gains.separation_min_m + HOLD_APART_M)
        self._phase = "idle"
        self._gate: GateInput | None = None
        self._dt_s = 0.0
        self._modes_sent_s: dict[str, float] = {}  # time of the last mode command, by drone
        self._landing_s = -math.inf
        self._fault = ""  # why the control loop of an engaged formation is open
        self._faultless_since_s = math.inf
        self._assembly: Assembly | None = None  # set while the drones fly to assigned positions or wait there
        self._positions: AssignedPositions | None = None  # set while the drones of a held formation are led back
        self._checked = np.empty(0)  # the last faultless reference; a reference at rest stays the same array
        self._wrapped = self._checked, self._checked  # the last reference, without and with wrapped angles

    @property
    def phase(self) -> str:
        """The present phase: idle, taking_off, assembling, engaged, landing or held."""
        return "held" if self._phase == "engaged" and (self._fault or self.guidance.paused) else self._phase

    def step(self, gate: GateInput) -> GateOutput:
        last_s = self._gate.t_s if self._gate else gate.t_s
        self._dt_s = min(max(gate.t_s - last_s, 0.0), DT_MAX_S)
        self._gate = gate
        self.check.observe(gate)
        self.plan.run(gate.t_s, self._submit)
        gate = self._gate  # the robots in the order set by the last assembly
        if self._phase in ("assembling", "engaged") and gate.is_down:
            self._phase, self._positions, self._assembly = "idle", None, None
        if self._phase == "engaged":
            self._update_fault(gate)
            return self._hold(gate) if self._fault else self._fly(gate)
        if self._assembly is not None:
            return self._assemble(gate, self._assembly)
        if self._phase in ("taking_off", "assembling"):
            return self._climb(gate)
        if self._phase != "landing":
            return self._output(gate, "")
        # a take-off command may still be in transit: idle only some time after the request to land
        if gate.is_down and gate.t_s - self._landing_s >= RESEND_S:
            self._phase = "idle"
        modes = self._mode_commands(gate, "land", AIRBORNE | {"taking_off"})
        return self._output(gate, self.check.state_fault(gate, DOWN | {"landing"}) or "", modes=modes)

    def request(self, request: FlightRequest) -> str | None:
        """Grant a request and return None, or change nothing and return why it is refused."""
        refusal = self._submit(request)
        if refusal is None and request is Order.LAND:
            self.plan.clear()
        elif refusal is None and not isinstance(request, Order):
            self.plan.overrule()
        return refusal

    def warm_start(self, phase: str, desired: Array, plan_step: int = 0, drones: Sequence[str] = ()) -> None:
        """Continue in the phase and at the reference (4n,) of a previous process of this formation.

        The plan continues after the completed steps; a target or trajectory of the plan that was being flown is
        requested again, starting from that reference.

        Args:
            plan_step: last `GateOutput.plan_step` of the previous process.
            drones: names of the drones in the order of the robots, if it differs from the scenario's.
        """
        self._phase = "engaged" if phase == "held" else phase
        self._set_drones(drones or self.drones)
        if self._phase == "engaged":
            self.guidance.engage(desired)
        self.plan.start_at(plan_step)

    def snapshot(self) -> State | None:
        law = self.law.snapshot()
        if plugin.is_own(type(self.law)):
            law = checked(law, type(self.law))
        if law is None:
            return None
        return {
            "phase": self._phase,
            "drones": list(self.drones),
            "assembly": self._assembly and self._assembly.snapshot(),
            "landing_s": self._landing_s,
            "fault": self._fault,
            "well_since_s": self._faultless_since_s,
            "modes": self._modes_sent_s,
            "value": self.check.value,
            "checked": self._checked,
            "places": None if self._positions is None else self._positions.p_W,
            "guidance": self.guidance.snapshot(),
            "plan": self.plan.snapshot(),
            "law": law,
        }

    def restore(self, state: State, gate: GateInput | None) -> None:
        """Restore the snapshot of another process and the last gate that it processed."""
        self._phase, self._landing_s = state["phase"], state["landing_s"]
        self._set_drones(state["drones"])
        self._assembly = state["assembly"] and Assembly.restored(state["assembly"], self.gains)
        self._fault, self._faultless_since_s = state["fault"], state["well_since_s"]
        self._modes_sent_s, self._checked = state["modes"], state["checked"]
        self.check.value = state["value"]
        self._positions = None if state["places"] is None else self._assigned_positions(state["places"])
        self.guidance.restore(state["guidance"])
        self.plan.restore(state["plan"])
        self.law.restore(state["law"])
        self._gate = gate
        if gate:
            self.check.observe(gate)

    def _submit(self, request: FlightRequest) -> str | None:
        if self._gate is None:
            return "no gate has been processed yet; repeat the request when the simulation runs"
        try:
            self._grant(request, self._gate)
        except REFUSALS as refusal:
            return str(refusal)
        return None

    def _grant(self, request: FlightRequest, gate: GateInput) -> None:
        if request is Order.TAKE_OFF:
            if self._phase != "idle":
                raise RefusalError(f"phase is {self.phase}; must be idle to take off")
            if fault := self.check.take_off_fault(gate, self.plan.assembles):
                raise RefusalError(fault)
            self._phase = "taking_off"
            self._modes_sent_s.clear()
        elif request is Order.ENGAGE:
            self._grant_engagement(gate)
        elif request is Order.LAND:
            if self._phase == "idle" and gate.is_down:
                raise RefusalError("all drones are on the ground")
            self._phase, self._landing_s, self._positions, self._assembly = "landing", gate.t_s, None, None
            self._modes_sent_s.clear()
        elif request is Order.REJOIN:
            if self._phase != "engaged" or not self._fault:
                raise RefusalError(f"phase is {self.phase}; must be held by a fault")
            if fault := self._control_fault(gate):
                raise RefusalError(fault)
            c = self._checked if self._checked.size else self.guidance.value(gate.t_s)[0]
            if fault := formation_fault(self.space, c, self.gains, SHAPE_IN_FLIGHT):
                raise RefusalError(fault)
            self._positions = self._assigned_positions(self.space.inverse(c)[0])
        elif request is Order.PAUSE and self._positions is not None:
            self._positions = None
        elif isinstance(request, Assemble):
            self._grant_assembly(request, gate)
        elif self._phase != "engaged":
            raise RefusalError(f"phase is {self.phase}; must be engaged")
        elif self._fault:
            raise RefusalError(self._fault)
        elif isinstance(request, Order):
            self.guidance.pause(gate.t_s)
        elif isinstance(request, MoveTo):
            self.guidance.target(request, gate.t_s)
        else:
            self.guidance.follow(request, gate.t_s)

    def _grant_engagement(self, gate: GateInput) -> None:
        if self._phase == "engaged" and self.guidance.paused and not self._fault:
            self.guidance.resume(gate.t_s)
            return
        if self._phase != "assembling":
            raise RefusalError(f"phase is {self.phase}; must be assembling, or held on request")
        if fault := self._arrival_fault(gate) or self.check.engagement_fault(gate):
            raise RefusalError(fault)
        if self._assembly is None:
            self.guidance.engage(self.check.value)
        else:
            self.guidance.engage_at(self.check.value, self._assembly.c, gate.t_s)
        self.plan.overrule()
        self.law.reset()
        self._fault, self._assembly = "", None
        self._phase = "engaged"

    def _grant_assembly(self, request: Assemble, gate: GateInput) -> None:
        """Assign the drones to the positions of a formation and start their flight there."""
        if self._phase not in ("assembling", "engaged") or self._fault:
            raise RefusalError(self._fault or f"phase is {self.phase}; must be assembling or engaged")
        if fault := self._arrival_fault(gate) or self.check.assembly_fault(gate):
            raise RefusalError(fault)
        if self._phase == "engaged":
            base = self.guidance.base(gate.t_s)
        elif (base := self.check.formation()) is not None:
            base = np.where(self.space.neutral, 0.0, base)
        c = assembly_goal(self.space, request.values, base, gate.p_W, gate.yaw)
        self._assembly, order = planned_assembly(self.space, c, gate.p_W, self.gains)
        self._phase = "assembling"
        self._set_drones([self.drones[k] for k in order.tolist()])
        self._gate = gate.reordered(order)
        self.check.observe(self._gate)

    def _set_drones(self, drones: Sequence[str]) -> None:
        """Set the names of the drones, in the order of the robots."""
        self.drones = self.law.robots = self.check.drones = tuple(drones)

    def _arrival_fault(self, gate: GateInput) -> str | None:
        """Return how far the drones still are from their assigned positions, as a text; None after arrival."""
        if self._assembly is None or self._assembly.arrived(gate.p_W):
            return None
        i, distance_m = self._assembly.farthest(gate.p_W)
        return (
            f"{self.drones[i]} is {distance_m:.1f} m from its position, with "
            f"{self._assembly.remaining_s:.1f} s of the paths left"
        )

    def _assigned_positions(self, p_W: Array) -> AssignedPositions:
        return AssignedPositions(p_W, self.gains, self._held_limits, SHAPE.share)

    def _control_fault(self, gate: GateInput) -> str | None:
        """Return why the drones cannot be led individually; None if they can."""
        return self.check.state_fault(gate, AIRBORNE) or self.check.estimate_fault(gate)

    def _mode_commands(self, gate: GateInput, mode: str, states: frozenset[str]) -> tuple[ModeCommand, ...]:
        """Return mode commands for the drones in one of the given states, each at most once per RESEND_S."""
        due = []
        for drone, state in zip(self.drones, gate.states, strict=True):
            if state in states and gate.t_s - self._modes_sent_s.get(drone, -math.inf) >= RESEND_S:
                self._modes_sent_s[drone] = gate.t_s
                due.append(ModeCommand(drone, mode))
        return tuple(due)

    def _climb(self, gate: GateInput) -> GateOutput:
        """Lead the flying drones vertically to the assembly height, each individually."""
        modes: tuple[ModeCommand, ...] = ()
        reason = self.check.state_fault(gate, AIRBORNE) if self._phase == "taking_off" else None
        if reason:
            modes = self._mode_commands(gate, "takeoff", frozenset({"landed"}))
        else:
            self._phase = "assembling"
            reason = self.check.engagement_fault(gate) or READY_TO_ENGAGE
        below_m = ASSEMBLY_HEIGHT_M - gate.p_W[:, 2]
        climb_m_s = np.minimum(np.maximum(CLIMB_GAIN_1_S * below_m, 0.0), ASSEMBLY_CLIMB_M_S)
        return self._output(
            gate, reason, modes=modes, command=self._vertical_command(gate, climb_m_s, self.gains.limits)
        )

    def _assemble(self, gate: GateInput, assembly: Assembly) -> GateOutput:
        """Lead the drones to their positions without turning; all stop if one cannot be controlled."""
        if fault := self._control_fault(gate):
            return self._output(gate, fault, command=self._vertical_command(gate, 0.0, self.gains.limits))
        assembly.advance(gate.p_W, self._dt_s)
        command = self._guarded(gate, assembly.velocities(gate.p_W), self.gains.limits)
        reason = self._arrival_fault(gate) or self.check.engagement_fault(gate) or READY_TO_ENGAGE
        return self._output(gate, reason, command=command)

    def _update_fault(self, gate: GateInput) -> None:
        """Set the fault of an engaged formation, or clear it after RECOVERY_S without a fault."""
        fault = self._rejoin_fault(gate) or self.check.flight_fault(gate)
        if not fault and not self._fault:  # the checks of a request cover only a limited time of the reference
            try:
                c_des = self.guidance.value(gate.t_s)[0]
                if c_des is not self._checked:
                    fault = place_fault(self.space, c_des, self.gains, SHAPE)
                    self._checked = self._checked if fault else c_des
            except REFUSALS as error:
                fault = str(error)
            fault = f"reference: {fault}" if fault else None
        if fault:
            self._fault, self._faultless_since_s = fault, math.inf
        elif self._fault:
            self._faultless_since_s = min(self._faultless_since_s, gate.t_s)
            if gate.t_s - self._faultless_since_s < RECOVERY_S:
                return
            try:
                self.guidance.rejoin(self.check.value, gate.t_s)
            except REFUSALS as refusal:
                self._fault, self._faultless_since_s = f"cannot continue: {refusal}", gate.t_s
            else:
                self._fault, self._positions = "", None
                self.law.reset()

    def _rejoin_fault(self, gate: GateInput) -> str | None:
        """Return which drone has not rejoined its position; stop leading the drones if one cannot be controlled."""
        if self._positions is None:
            return None
        if self._control_fault(gate):
            self._positions = None
            return None
        i, distance_m = self._positions.farthest(gate.p_W)
        finding = f"{self.drones[i]} is {distance_m:.1f} m from its position; allowed: {REJOINED_M:g} m"
        return f"{REJOINING}: {finding}" if distance_m > REJOINED_M else None

    def _fly(self, gate: GateInput) -> GateOutput:
        c_des, c_dot_des = self.guidance.value(gate.t_s)
        command = self.law.command(self.check.value, gate.p_W, gate.v_W, c_des, c_dot_des, self._dt_s)
        reason = HELD_ON_REQUEST if self.guidance.paused else ""
        if command.guarded:
            reason = f"{GUARD_PARTS} {self._pairs(command.guarded)}"
        if c_des is not self._wrapped[0]:
            self._wrapped = c_des, self.space.wrapped(c_des)
        return self._output(gate, reason, command=command, reference=(self._wrapped[1], c_dot_des))

    def _hold(self, gate: GateInput) -> GateOutput:
        """Stop the drones of a held formation, or lead them to their positions without turning."""
        if self._positions is None:
            command = self._vertical_command(gate, 0.0, self._held_limits)
        else:
            command = self._guarded(gate, self._positions.velocities(gate.p_W), self._held_limits)
        return self._output(gate, self._fault, command=command)

    def _guarded(self, gate: GateInput, v_W: Array, limits: RobotLimits) -> FormationCommand:
        """Return the command for velocities (n, 3) [m/s, W], guarded and without turning."""
        v_W, guarded, alarmed = guard(gate.p_W, gate.v_W, v_W, limits)
        return FormationCommand(v_W, np.zeros(self.space.n), 1.0, guarded, alarmed)

    def _vertical_command(self, gate: GateInput, climb_m_s: Array | float, limits: RobotLimits) -> FormationCommand:
        """Return the command for climb rates (n,) [m/s], guarded, without turning; zero if an estimate is unusable."""
        v_W = np.zeros((self.space.n, 3))
        alarmed: Pairs = ()
        if self.check.estimate_fault(gate) is None:
            v_W[:, 2] = climb_m_s
            v_W, _, alarmed = guard(gate.p_W, gate.v_W, v_W, limits)
        return FormationCommand(v_W, np.zeros(self.space.n), 1.0, (), alarmed)

    def _output(
        self,
        gate: GateInput,
        reason: str,
        *,
        modes: tuple[ModeCommand, ...] = (),
        command: FormationCommand | None = None,
        reference: tuple[Array, Array] | None = None,
    ) -> GateOutput:
        """Return the output of a gate; without a reference, the desired value is the estimate."""
        if command and command.alarmed:
            finding = f"closer than {self.gains.separation_alarm_m:g} m: {self._pairs(command.alarmed)}"
            reason = f"{TOO_NEAR}, {finding}; {reason}"
        if self.plan.note:
            reason = f"{reason}; {self.plan.note}" if reason else self.plan.note
        desired, desired_rate = reference or (self.check.value, np.zeros(self.space.size))
        return GateOutput(
            modes=modes,
            setpoints=setpoints(gate, command.v_W, command.yaw_rate) if command else (None,) * self.space.n,
            phase=self.phase,
            value=self.check.value,
            desired=desired,
            desired_rate=desired_rate,
            trajectory_t_s=self.guidance.trajectory_t_s(gate.t_s) if self._phase == "engaged" else None,
            margin=self.check.margin,
            reason=reason,
            factor=command.factor if command else 1.0,
            plan_step=self.plan.resume_at(self._is_led()),
        )

    def _is_led(self) -> bool:
        """Return whether the drones are assembling or following a reference, as opposed to hovering or holding."""
        return self._assembly is not None or (self._phase == "engaged" and not self.guidance.paused)

    def _pairs(self, pairs: Pairs) -> str:
        return ", ".join(f"{self.drones[i]} and {self.drones[j]}" for i, j in pairs)
