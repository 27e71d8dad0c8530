"""Controls of the run's time, of drones one by one or all together, and of injected faults."""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import viser

from zsim.contract.messages import DroneInfo
from zsim.contract.run_messages import GATES_MAX, RATE_MAX
from zsim.scenario.fault_kinds import PROCESS_KILL, ROTORS, FaultKind, kinds_of
from zsim.scenario.scenario import Scenario
from zsim.sensors.sensor_catalogue import declarations
from zsim_bridges.console.command_client import CommandClient, RequestOutcome
from zsim_bridges.console.monitoring.run_condition import RunCondition, drone_refusals, fleet_refusals, run_refusals
from zsim_bridges.console.page import operator_input

REASON_STYLE = "font-size:11px;line-height:1.3;color:#868e96;padding:0 10px 10px;overflow-wrap:anywhere"
"""The row of tabs below stands 9 px higher than what is above it ends."""

DURATION_S = 30.0  # of a fault, unless another time is typed
WEAK_THRUST_SHARE = 0.7  # share of thrust of a weak motor: less, and the aircraft cannot be held level
GUST_M_S = (4.0, 0.0, 0.0)  # about what the drones of the formation can still hold against
LOSS_PROBABILITY = 0.3
TIME_PARAMETERS = ("at_s", "for_s")  # s, simulated; of any fault, beside its own parameters


class FaultForm:
    """Controls of faults.

    Args:
        gui: viser's, in the folder where they are to be.
        client: sends requests.
        report: called with requests that are refused without being sent.
        scenario: has the drones and processes.
        drones: of the run, with the names of their rotors; the AR.Drone's hold where there are none.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        client: CommandClient,
        report: Callable[[RequestOutcome], None],
        scenario: Scenario,
        drones: Sequence[DroneInfo] = (),
    ) -> None:
        self._rotors = {drone.name: [rotor.name for rotor in drone.rotors] for drone in drones}
        self._client = client
        self._report = report
        self._kinds = kinds_of(declarations(scenario.drones))
        names = [drone.name for drone in scenario.drones]
        self._drone = gui.add_dropdown("drone", names)
        self._for = gui.add_number("for [s]", DURATION_S, min=0.0, max=1e5, step=1.0, hint="0: until it is cleared")
        self._button(gui, "GPS lost", lambda: self._on_drone("gps_dropout"))
        self._button(gui, "Motor weak", self._weaken)
        self._button(gui, "Gust", lambda: self._add("gust", "world", velocity_m_s=list(GUST_M_S)))
        self._button(
            gui, "Link loss", lambda: self._add("link_loss", f"world/{self._estimator()}", probability=LOSS_PROBABILITY)
        )
        self._button(gui, "Kill estimator", lambda: self._add(PROCESS_KILL, self._estimator()))
        self._any_fault(gui, names)
        gui.add_button("Clear all faults", color="green").on_click(lambda _: client.request_world("fault_clear"))

    def _button(self, gui: viser.GuiApi, label: str, act: Callable[[], None]) -> None:
        gui.add_button(label, color="orange").on_click(lambda _: act())

    def _estimator(self) -> str:
        return f"estimator.{self._drone.value}"

    def _weaken(self) -> None:
        rotors = self._rotors.get(self._drone.value) or ROTORS
        self._on_drone("rotor_efficiency", rotor=rotors[0], value=WEAK_THRUST_SHARE)

    def _on_drone(self, kind: str, **parameters: Any) -> None:
        self._add(kind, self._drone.value, **parameters)

    def _add(self, kind: str, target: str, **parameters: Any) -> None:
        duration = (
            {"for_s": float(self._for.value)} if self._for.value > 0 and self._kinds[kind].lasts != "once" else {}
        )
        self._client.request_world("fault_add", kind=kind, target=target, **{**duration, **parameters})

    def _any_fault(self, gui: viser.GuiApi, names: list[str]) -> None:
        with gui.add_folder("Any fault", expand_by_default=False):
            kind = gui.add_dropdown("kind", list(self._kinds))
            target = gui.add_text("target", names[0], hint="drone, world, process, or link A/B")
            help_ = gui.add_markdown(_help(self._kinds[kind.value]))
            text = gui.add_text("parameters", "", hint="NAME: VALUE, NAME: VALUE, …; at_s and for_s too")
            kind.on_update(lambda _: setattr(help_, "content", _help(self._kinds[kind.value])))
            gui.add_button("Inject it", color="orange").on_click(
                lambda _: self._inject(kind.value, target.value, text.value)
            )

    def _inject(self, kind: str, target: str, text: str) -> None:
        try:
            parameters = operator_input.parse_parameters(
                text, [*TIME_PARAMETERS, *(p.name for p in self._kinds[kind].parameters)]
            )
        except operator_input.InputError as error:
            self._report(RequestOutcome("fault_add", str(error)))
            return
        self._add(kind, target.strip(), **parameters)


def _help(fault: FaultKind) -> str:
    """Return a kind's effect and parameters."""
    lines = [f"`{p.name}` {p.description}{f' [{p.unit}]' if p.unit else ''}" for p in fault.parameters]
    return f"<sub>{fault.description}; strikes a {fault.strikes}. {'; '.join(lines)}</sub>"


def set_refusals(controls: Mapping[str, Any], refusals: Mapping[str, str]) -> None:
    """Grey out the controls of those operations that would be refused; the reason is their tooltip.

    Viser sends an assigned property always: what has not changed is left alone.
    """
    for op, control in controls.items():
        reason = refusals.get(op, "")
        if control.disabled != bool(reason):
            control.disabled = bool(reason)
        if control.hint != (reason or None):
            control.hint = reason or None


def refusal_lines(labels: Mapping[str, str], refusals: Mapping[str, str]) -> str:
    """Return, a line for each reason, which controls are greyed out, as HTML; `labels` names them by operation."""
    by_reason: dict[str, list[str]] = {}
    for op, label in labels.items():
        if refusals.get(op):
            by_reason.setdefault(refusals[op], []).append(label)
    lines = [f"{', '.join(names)}: {reason}" for reason, names in by_reason.items()]
    return f"<div style='{REASON_STYLE}'>{'<br>'.join(map(escape, lines))}</div>" if lines else ""


FLEET = {"Take off all": "takeoff", "Reset all": "reset"}  # an operation of formations, and a mode of drones


class RunForm:
    """Pause or resume, single steps, rate.

    Args:
        gui: viser's, in the folder where they are to be.
        client: sends requests.
        rate: that the run was started with.
    """

    def __init__(self, gui: viser.GuiApi, client: CommandClient, rate: float) -> None:
        pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        pause.on_click(lambda _: client.request_world("pause"))
        resume = gui.add_button("Resume", icon=viser.Icon.PLAYER_PLAY, visible=False)
        resume.on_click(lambda _: client.request_world("resume"))
        gates = gui.add_number("gates", 1, min=1, max=GATES_MAX, step=1)
        step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT)
        step.on_click(lambda _: client.request_world("step", gates=int(gates.value)))
        wanted = gui.add_number(
            "rate", rate, min=0.0, max=RATE_MAX, step=0.5, hint="Real time is 1; 0: as fast as it goes"
        )
        set_rate = gui.add_button("Set rate")
        set_rate.on_click(lambda _: client.request_world("rate", value=float(wanted.value)))
        self._controls = {"pause": pause, "resume": resume, "step": step, "rate": set_rate}
        self._reasons = gui.add_html("")

    def refresh(self, run: RunCondition) -> None:
        """Offer what the run would not refuse: Resume stands in the place of Pause while it is paused."""
        refusals = run_refusals(run)
        set_refusals(self._controls, refusals)
        paused = run.clock == "paused"
        if self._controls["resume"].visible != paused:
            self._controls["pause"].visible, self._controls["resume"].visible = not paused, paused
        toggle = {"resume": "Resume"} if paused else {"pause": "Pause"}
        self._reasons.content = refusal_lines({**toggle, "step": "Step", "rate": "Set rate"}, refusals)


class FleetForm:
    """Take-off and reset of all drones; their landing and emergency, too, for the head of the page.

    Formations take off and land by their controllers, drones of none each by itself.

    Args:
        gui: viser's, in the folder where they are to be.
        client: sends requests.
        scenario: names the drones and formations.
    """

    def __init__(self, gui: viser.GuiApi, client: CommandClient, scenario: Scenario) -> None:
        self._client = client
        self._formations = [cluster.name for cluster in scenario.clusters]
        in_formation = {name for cluster in scenario.clusters for name in cluster.drones}
        self._drones = [drone.name for drone in scenario.drones]
        self._single = [name for name in self._drones if name not in in_formation]
        self._run = RunCondition()
        self._controls: dict[str, Any] = {}
        for label, op in FLEET.items():
            icon = viser.Icon.PLANE_DEPARTURE if op == "takeoff" else viser.Icon.REFRESH
            self._controls[op] = gui.add_button(label, icon=icon, color="gray")
            self._controls[op].on_click(lambda _, op=op: self.request_all(op))
        self._reasons = gui.add_html("")

    def refresh(self, run: RunCondition) -> None:
        """Offer what would not be refused; Reset all is there only while a drone is in an emergency."""
        self._run = run
        refusals = fleet_refusals(run, self._single)
        set_refusals(self._controls, refusals)
        in_emergency = not refusals["reset"]
        if self._controls["reset"].visible != in_emergency:
            self._controls["reset"].visible = in_emergency
        self._reasons.content = refusal_lines({"takeoff": "Take off all"}, refusals)

    def request_all(self, operation: str) -> None:
        """Request takeoff or land of all formations and single drones, emergency of all, reset of those in one."""
        if operation == "emergency":
            self._client.send_mode(self._drones, operation)
        elif operation == "reset":
            self._client.send_mode([d for d in self._drones if self._run.drones.get(d) == "emergency"], operation)
        else:
            for name in self._formations:
                self._client.request_cluster(name, operation)
            if self._single:
                self._client.send_mode(self._single, operation)


DRONE_MODES = {
    "takeoff": "Take off",
    "land": "Land",
    "return": "Return",
    "emergency": "Emergency",
    "reset": "Reset",
}  # and what is none: to fly back to the start and land there
DRONE_ICONS = {
    "takeoff": viser.Icon.PLANE_DEPARTURE,
    "land": viser.Icon.PLANE_ARRIVAL,
    "return": viser.Icon.HOME,
    "emergency": viser.Icon.ALERT_TRIANGLE,
    "reset": viser.Icon.REFRESH,
}


class DroneForm:
    """Modes of one drone, or of all that are selected, on one page: what another page chooses changes nothing here.

    Args:
        gui: viser's of that page, in the folder where they are to be.
        client: sends requests.
        names: of the drones.
        request_return: lets drones fly back to where they started, and land.

    Attributes:
        choice: the control that chooses one.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        client: CommandClient,
        names: Sequence[str],
        request_return: Callable[[Sequence[str]], None] = lambda _: None,
    ) -> None:
        self._client = client
        self._request_return = request_return
        self.choice = gui.add_dropdown("drone", list(names))
        self._selected: list[str] = []
        self._buttons: dict[str, Any] = {}
        for mode, label in DRONE_MODES.items():
            colour = "red" if mode == "emergency" else "gray"
            button = gui.add_button(f"{label} {self._subject}", icon=DRONE_ICONS[mode], color=colour)
            button.on_click(lambda _, mode=mode: self._request(mode))
            self._buttons[mode] = button
        self._reasons = gui.add_html("")
        self._run = RunCondition()
        self.choice.on_update(lambda _: self._rename())

    @property
    def chosen(self) -> str:
        """Name of the drone that is chosen."""
        return self.choice.value

    @property
    def targets(self) -> list[str]:
        """Names of the drones that a button is for: those that are selected, else the one that is chosen."""
        return self._selected or [self.chosen]

    @property
    def _subject(self) -> str:
        return self.targets[0] if len(self.targets) == 1 else f"{len(self.targets)} drones"

    def choose(self, drone: str) -> None:
        """Choose a drone, as a click on it in the scene does."""
        self.choice.value = drone

    def select(self, drones: Sequence[str]) -> None:
        """Let the buttons be for all of these; of none: for the chosen one."""
        self._selected = list(drones)
        self._rename()

    def refresh(self, run: RunCondition) -> None:
        """Offer what would not be refused of one of the drones at least."""
        self._run = run
        refusals = [drone_refusals(run, drone) for drone in self.targets]
        common = {mode: refusals[0][mode] if all(each[mode] for each in refusals) else "" for mode in DRONE_MODES}
        set_refusals(self._buttons, common)
        self._reasons.content = refusal_lines(DRONE_MODES, common)

    def _request(self, mode: str) -> None:
        """Request a mode of all drones that would not refuse it; an emergency of all."""
        able = [drone for drone in self.targets if not drone_refusals(self._run, drone)[mode]]
        drones = able or self.targets  # what is shown may be older than what is: whoever may refuse it then says why
        if mode == "return":
            self._request_return(drones)
        else:
            self._client.send_mode(drones, mode)

    def _rename(self) -> None:
        for mode, button in self._buttons.items():
            button.label = f"{DRONE_MODES[mode]} {self._subject}"
        self.refresh(self._run)
