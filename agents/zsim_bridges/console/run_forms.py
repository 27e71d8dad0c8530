"""Controls of the run's time, of drones one by one or all together, and of injected faults."""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import viser

from zsim.contract.messages import DroneInfo
from zsim.contract.run_messages import GATES_MAX, RATE_MAX
from zsim.scenario.fault_kinds import PROCESS_KILL, ROTORS, FaultKind, expected, kinds_of, unstated
from zsim.scenario.scenario import Scenario
from zsim.sensors.sensor_catalogue import declarations
from zsim_bridges.console import operator_input
from zsim_bridges.console.command_client import CommandClient, RequestOutcome
from zsim_bridges.console.console_tables import preflight_lines
from zsim_bridges.console.operator_input import range_refusal
from zsim_bridges.console.run_condition import (
    RunCondition,
    drone_refusals,
    fleet_refusals,
    preflight_refusal,
    run_refusals,
)

REASON_STYLE = "font-size:11px;line-height:1.3;color:#868e96;padding:0 10px 10px;overflow-wrap:anywhere"
"""The row of tabs below stands 9 px higher than what is above it ends."""

LIMITS_STYLE = "font-size:11px;line-height:1.2;color:#868e96;padding:0 12px 4px;text-align:right"
HELD_HINT = "hold it for 0.6 s, by hand or by Space or Enter"  # as long as HOLD_MS of orders.html
DURATION_MAX_S = 1e5  # of a fault; longer than any run
DURATION_S = 30.0  # of a fault, unless another time is typed
FIXES_LOST_PERCENT = 100.0
THRUST_LEFT_PERCENT = 70.0  # of a weak motor: less, and the aircraft cannot be held level
GUST_M_S = 4.0  # about what the drones of the formation can still hold against
MESSAGES_LOST_PERCENT = 30.0
STRIKES = {
    "drone": "a drone",
    "world": "the world, so all drones",
    "link": "the messages between two processes A/B; the radio of a drone is the kind radio",
    "radio": "the radio between drones and others: the world's, or a formation's",
    "process": "a process",
}
"""What the target of a kind is, in words."""


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
        hint = "0: until it is cleared"
        self._for = gui.add_number("for [s]", DURATION_S, min=0.0, max=DURATION_MAX_S, step=1.0, hint=hint)
        gui.add_html(limits_line(f"for: 0 to {DURATION_MAX_S:g} s; {hint}"))
        share: dict[str, Any] = {"min": 0.0, "max": 100.0, "step": 1.0}
        self._fixes = gui.add_number("fixes lost [%]", FIXES_LOST_PERCENT, **share)
        self._button(gui, "GPS lost")
        self._thrust = gui.add_number("thrust left [%]", THRUST_LEFT_PERCENT, **share)
        self._button(gui, "Motor weak")
        self._gust = gui.add_number("gust [m/s]", GUST_M_S, min=-100.0, max=100.0, step=0.5, hint="to the east")
        self._button(gui, "Gust")
        self._messages = gui.add_number("msgs lost [%]", MESSAGES_LOST_PERCENT, **share)
        self._button(gui, "Messages lost")
        self._button(gui, "Kill estimator")
        self._strikes = gui.add_html("")
        for control in (self._drone, self._fixes, self._thrust, self._gust, self._messages):
            control.on_update(lambda _: self._describe())
        self._describe()
        self._any_fault(gui, names)
        gui.add_button("Clear all faults", color="green").on_click(lambda _: client.request_world("fault_clear"))

    def _button(self, gui: viser.GuiApi, label: str) -> None:
        gui.add_button(label, color="orange").on_click(lambda _: self._add(*self._common()[label][:3]))

    def _common(self) -> dict[str, tuple[str, str, dict[str, Any], str]]:
        """Return the common faults by their button: kind, target, parameters, and what they strike in words."""
        drone = self._drone.value
        rotor = (self._rotors.get(drone) or ROTORS)[0]
        fixes, thrust, gust, messages = (
            float(each.value) for each in (self._fixes, self._thrust, self._gust, self._messages)
        )
        link = f"world/estimator.{drone}"
        return {
            "GPS lost": ("gps_dropout", drone, {"probability": fixes / 100}, f"{fixes:g} % of the fixes of {drone}"),
            "Motor weak": (
                "rotor_efficiency",
                drone,
                {"rotor": rotor, "value": thrust / 100},
                f"rotor {rotor} of {drone}: {thrust:g} % of its thrust is left",
            ),
            "Gust": ("gust", "world", {"velocity_m_s": [gust, 0.0, 0.0]}, f"all drones: {gust:g} m/s to the east"),
            "Messages lost": (
                "link_loss",
                link,
                {"probability": messages / 100},
                f"{messages:g} % of the messages between the processes {link.replace('/', ' and ')}; no radio",
            ),
            "Kill estimator": (PROCESS_KILL, f"estimator.{drone}", {}, f"process estimator.{drone}, as by kill -9"),
        }

    def _describe(self) -> None:
        lines = (f"<b>{escape(label)}</b>: {escape(each[3])}" for label, each in self._common().items())
        self._strikes.content = f"<div style='{REASON_STYLE}'>{'<br>'.join(lines)}</div>"

    def _add(self, kind: str, target: str, parameters: Mapping[str, Any]) -> None:
        lasts_s, lasts = float(self._for.value), self._kinds[kind].lasts != "once" and "for_s" not in parameters
        refusal = range_refusal("for", lasts_s, 0.0, DURATION_MAX_S, "s") if lasts else None
        if refusal:
            self._report(RequestOutcome(f"fault_add {kind} of {target}", refusal))
            return
        duration = {"for_s": lasts_s} if lasts and lasts_s > 0 else {}
        self._client.request_world("fault_add", kind=kind, target=target, **{**duration, **parameters})

    def _any_fault(self, gui: viser.GuiApi, names: list[str]) -> None:
        with gui.add_folder("Any fault", expand_by_default=False):
            kind = gui.add_dropdown("kind", list(self._kinds))
            help_ = gui.add_markdown("")
            target = gui.add_text("target", "", hint="as the kind asks; a link of processes is A/B")
            text = gui.add_text(
                "parameters", "", hint="as in `zsim fault add TARGET KIND …`: NAME=VALUE … --for 10s --at 40s"
            )

            def choose() -> None:
                chosen = self._kinds[kind.value]
                help_.content = _help(chosen)
                target.value = _example_target(chosen, self._drone.value)
                text.value = _example_parameters(chosen)

            kind.on_update(lambda _: choose())
            choose()
            gui.add_button("Inject it", color="orange").on_click(
                lambda _: self._inject(kind.value, target.value, text.value)
            )

    def _inject(self, kind: str, target: str, text: str) -> None:
        try:
            parameters = operator_input.parse_fault(text, kind, self._kinds[kind])
        except operator_input.InputError as error:
            self._report(RequestOutcome("fault_add", str(error)))
            return
        self._add(kind, target.strip(), parameters)


def _example_target(kind: FaultKind, drone: str) -> str:
    """Return a target that a kind may have, for a drone."""
    estimator = f"estimator.{drone}"
    targets = {"drone": drone, "link": f"world/{estimator}", "process": estimator}
    return targets.get(kind.strikes, "world")


def _example_parameters(kind: FaultKind) -> str:
    """Return the magnitudes of a kind as they are typed, with their defaults; to be filled in where there is none."""
    return " ".join(f"{p.name}={'' if p.default is None else p.default}" for p in unstated(kind, {}))


def _help(fault: FaultKind) -> str:
    """Return a kind's effect, what it strikes, and its parameters with their limits."""
    stated = unstated(fault, {})
    lines = [
        f"`{p.name}` {p.description}: {expected(p)}{'' if p in stated else ' (may be left out)'}"
        for p in fault.parameters
    ]
    strikes = f"{fault.description}; strikes {STRIKES[fault.strikes]}."
    return f"<sub>{' '.join([strikes, '; '.join(lines)])}</sub>"


def limits_line(text: str) -> str:
    """Return the limits of a number, to stand below its field, as HTML."""
    return f"<div style='{LIMITS_STYLE}'>{escape(text)}</div>"


def set_refusals(controls: Mapping[str, Any], refusals: Mapping[str, str]) -> None:
    """Grey out the controls of those operations that would be refused; the reason is their tooltip.

    Viser sends an assigned property always: what has not changed is left alone.
    """
    for op, control in controls.items():
        reason = refusals.get(op, "")
        if isinstance(control, OrderButton):
            control.lock(reason)
            continue
        if control.disabled != bool(reason):
            control.disabled = bool(reason)
        if control.hint != (reason or None):
            control.hint = reason or None


ORDERS = ("hold", "land", "emergency")  # operations whose buttons are those of orders


def heard(run: RunCondition) -> RunCondition:
    """Return the condition as if the world answered: an order is given to one that is silent, too."""
    return run._replace(silent_s=0.0)


def order_refusals(refusals: Mapping[str, str]) -> dict[str, str]:
    """Return those of the refusals that concern orders; an emergency is never kept back."""
    return {op: "" if op == "emergency" else reason for op, reason in refusals.items() if op in ORDERS}


def refusal_lines(labels: Mapping[str, str], refusals: Mapping[str, str]) -> str:
    """Return, a line for each reason, which controls are greyed out, as HTML; `labels` names them by operation."""
    by_reason: dict[str, list[str]] = {}
    for op, label in labels.items():
        if refusals.get(op):
            by_reason.setdefault(refusals[op], []).append(label)
    lines = [f"{', '.join(names)}: {reason}" for reason, names in by_reason.items()]
    return f"<div style='{REASON_STYLE}'>{'<br>'.join(map(escape, lines))}</div>" if lines else ""


class OrderButton:
    """A button whose order the page repeats until it is confirmed: it is the page's own, not one of viser's.

    Args:
        gui: viser's, in the folder where it is to be.
        label: of the button.
        op: see `OrderRequest`.
        of: whom it concerns: {"drone": name}, of several by commas, or {"cluster": name}.
        held: whether it is to be held for a while.

    Attributes:
        visible: always.
        disabled: whether it is off.
    """

    visible = True

    def __init__(self, gui: viser.GuiApi, label: str, op: str, of: dict[str, str], *, held: bool = False) -> None:
        self._label, self._op, self._of, self._held = label, op, of, held
        self._hint = HELD_HINT if held else ""
        self.disabled = False
        self._content = self._drawn()
        self._html = gui.add_html(self._content)

    def name(self, label: str, of: dict[str, str]) -> None:
        """Give it another label, and let it concern somebody else."""
        self._label, self._of = label, of
        self._draw()

    def lock(self, reason: str) -> None:
        """Switch it off for a reason; on where that is empty."""
        self.disabled, self._hint = bool(reason), reason or (HELD_HINT if self._held else "")
        self._draw()

    def _draw(self) -> None:
        """Viser sends an assigned property always: what has not changed is left alone."""
        content = self._drawn()
        if content != self._content:
            self._content = self._html.content = content

    def _drawn(self) -> str:
        data = {"data-zsim-order": self._op, **{f"data-{key}": name for key, name in self._of.items()}}
        data |= {"title": self._hint, **({"data-zsim-hold": "1", "class": "stop"} if self._held else {})}
        attributes = " ".join(f'{key}="{escape(value)}"' for key, value in data.items())
        off = " disabled" if self.disabled else ""
        return f'<div class="zsim-order"><button type="button" {attributes}{off}>{escape(self._label)}</button></div>'


FLEET = {"Take off all": "takeoff", "Reset all": "reset"}  # an operation of formations, and a mode of drones


def _whole(value: float) -> float:
    """Return a whole number as an integer, and any other one as it is: the world refuses it."""
    return int(value) if value == int(value) else value


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
        gui.add_html(limits_line(f"gates: 1 to {GATES_MAX}"))
        step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT)
        step.on_click(lambda _: client.request_world("step", gates=_whole(gates.value)))
        wanted = gui.add_number(
            "rate", rate, min=0.0, max=RATE_MAX, step=0.5, hint="Real time is 1; 0: as fast as it goes"
        )
        gui.add_html(limits_line(f"rate: 0 to {RATE_MAX:g} × real time"))
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
    """Take-off and reset of all drones; their landing and emergency are orders of the head of the page.

    Formations take off by their controllers, drones of none each by itself.

    Args:
        gui: viser's, in the folder where they are to be.
        client: sends requests.
        scenario: names the drones and formations.
    """

    def __init__(self, gui: viser.GuiApi, client: CommandClient, scenario: Scenario) -> None:
        self._client = client
        self._formations = {cluster.name: cluster.drones for cluster in scenario.clusters}
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
        """Request takeoff of all formations and single drones, or reset of those in an emergency."""
        if operation == "reset":
            self._client.send_mode([d for d in self._drones if self._run.drones.get(d) == "emergency"], operation)
        else:
            fit = {name: not preflight_refusal(self._run, drones) for name, drones in self._formations.items()}
            for name in self._formations:
                if operation != "takeoff" or fit[name]:
                    self._client.request_cluster(name, operation)
            single = [d for d in self._single if operation != "takeoff" or not preflight_refusal(self._run, [d])]
            if single:
                self._client.send_mode(single, operation)


DRONE_MODES = {
    "takeoff": "Take off",
    "land": "Land",
    "return": "Return",
    "emergency": "Emergency",
    "reset": "Reset",
}  # and what is none: to fly back to the start and land there
IN_CONTROL = ("takeoff", "return", "reset")  # what needs control; anybody may land a drone, or stop it
DRONE_ICONS = {"takeoff": viser.Icon.PLANE_DEPARTURE, "return": viser.Icon.HOME, "reset": viser.Icon.REFRESH}


class DroneForm:
    """Modes of one drone, or of all that are selected, on one page: what another page chooses changes nothing here.

    Args:
        gui: viser's of that page, in the folder where they are to be.
        client: sends requests.
        names: of the drones.
        may: returns why this page may not let a drone take off or reset it, empty where it may; where it is asked in
            order to do so, that puts the page in control.
        request_return: lets drones fly back to where they started, and land.

    Attributes:
        choice: the control that chooses one.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        client: CommandClient,
        names: Sequence[str],
        may: Callable[[str, bool], str] = lambda *_: "",
        request_return: Callable[[Sequence[str]], None] = lambda _: None,
    ) -> None:
        self._client = client
        self._may = may
        self._request_return = request_return
        self.choice = gui.add_dropdown("drone", list(names))
        self._selected: list[str] = []
        self._buttons: dict[str, Any] = {}
        for mode, label in DRONE_MODES.items():
            if mode in ORDERS:
                held = mode == "emergency"
                self._buttons[mode] = OrderButton(gui, f"{label} {self._subject}", mode, self._order, held=held)
                continue
            button = gui.add_button(f"{label} {self._subject}", icon=DRONE_ICONS[mode], color="gray")
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
    def _order(self) -> dict[str, str]:
        """Whom an order concerns."""
        return {"drone": ",".join(self.targets)}

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
        heard_of = heard(run)
        refusals = [
            {**drone_refusals(run, drone), **order_refusals(drone_refusals(heard_of, drone))} for drone in self.targets
        ]
        for drone, each in zip(self.targets, refusals, strict=True):
            for mode in IN_CONTROL:
                each[mode] = each[mode] or self._may(drone, False)
        common = {mode: refusals[0][mode] if all(each[mode] for each in refusals) else "" for mode in DRONE_MODES}
        set_refusals(self._buttons, common)
        landed = {d: run.checks.get(d, ()) for d in self.targets if run.drones.get(d) == "landed"}
        checks = {drone: found for drone, found in landed.items() if found}
        shown = preflight_lines(checks) if checks and not run.grounded() else ""
        self._reasons.content = refusal_lines(DRONE_MODES, common) + shown

    def _request(self, mode: str) -> None:
        """Request what needs control, of all drones that would not refuse it."""
        able = [drone for drone in self.targets if not drone_refusals(self._run, drone)[mode]]
        drones = able or self.targets  # what is shown may be older than what is: whoever may refuse it then says why
        drones = [drone for drone in drones if not self._may(drone, True)]
        if not drones:
            return
        if mode == "return":
            self._request_return(drones)
        else:
            self._client.send_mode(drones, mode)

    def _rename(self) -> None:
        for mode, button in self._buttons.items():
            label = f"{DRONE_MODES[mode]} {self._subject}"
            if isinstance(button, OrderButton):
                button.name(label, self._order)
            else:
                button.label = label
        self.refresh(self._run)
