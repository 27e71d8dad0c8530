"""Controls of the run: its time, all drones together, and injected faults; also the elements that all forms share.

viser sends every assigned property to all pages, so properties are set by `assign`, which skips unchanged ones.
"""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import viser

from zsim.contract.messages import DroneInfo
from zsim.contract.run_messages import GATES_MAX, RATE_MAX
from zsim.scenario.faults import PROCESS_KILL, ROTORS, FaultKind, expected, kinds_of, typed_rest, unstated
from zsim.scenario.scenario import Scenario
from zsim.sensors.sensor_catalogue import declarations
from zsim_bridges.console.orders import CommandClient, RequestOutcome
from zsim_bridges.console.run_condition import (
    RunCondition,
    fleet_refusals,
    preflight_refusal,
    run_refusals,
    single_drones,
)

REASON_STYLE = "font-size:11px;line-height:1.3;color:#868e96;padding:0 10px 10px;overflow-wrap:anywhere"
"""The bottom padding makes room for the row of tabs below, which would overlap the end of the text by 9 px."""
LIMITS_STYLE = "font-size:11px;line-height:1.2;color:#868e96;padding:0 12px 4px;text-align:right"
HELD_HINT = "hold for 0.6 s, with the pointer, Space or Enter"  # equal to HOLD_MS in orders.html
DURATION_MAX_S = 1e5  # maximum duration of a fault; longer than any run
DURATION_S = 30.0  # initial value of a fault's duration
FIXES_LOST_PERCENT = 100.0  # this and the following are initial values
THRUST_REMAINING_PERCENT = 70.0  # remaining thrust of a weak motor; with less, the drone could not be held level
GUST_M_S = 4.0  # about the strongest gust that the drones of a formation can withstand
MESSAGES_LOST_PERCENT = 30.0
TARGET_TEXTS = {
    "drone": "a drone",
    "world": "the world, hence all drones",
    "link": "the messages between two processes A/B; a drone's radio is affected by faults of the kind radio",
    "radio": "the radio of all drones (target: world), or of a formation's drones",
    "process": "a process",
}
"""Descriptions of the targets of faults."""
ORDERS = ("hold", "land", "emergency")  # operations with an `OrderButton`


class RunForm:
    """Controls to pause, resume and step the run, and to set its rate; `rate` is the rate at which it was started."""

    def __init__(self, gui: viser.GuiApi, client: CommandClient, rate: float) -> None:
        pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        pause.on_click(lambda _: client.request_world("pause"))
        resume = gui.add_button("Resume", icon=viser.Icon.PLAYER_PLAY, visible=False)
        resume.on_click(lambda _: client.request_world("resume"))
        gates = gui.add_number("gates", 1, min=1, max=GATES_MAX, step=1)
        gui.add_html(limits_line(f"gates: 1 to {GATES_MAX}"))
        step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT)

        def request_step() -> None:
            count = gates.value  # a fraction is sent unchanged, and refused by the world
            client.request_world("step", gates=int(count) if count == int(count) else count)

        step.on_click(lambda _: request_step())
        rate_input = gui.add_number(
            "rate", rate, min=0.0, max=RATE_MAX, step=0.5, hint="1 is real time; 0: as fast as possible"
        )
        gui.add_html(limits_line(f"rate: 0 to {RATE_MAX:g} × real time"))
        set_rate = gui.add_button("Set rate")
        set_rate.on_click(lambda _: client.request_world("rate", value=float(rate_input.value)))
        self._controls = {"pause": pause, "resume": resume, "step": step, "rate": set_rate}
        self._reasons = gui.add_html("")

    def refresh(self, run: RunCondition) -> None:
        """Disable what would be refused; Resume replaces Pause in a paused run."""
        refusals = run_refusals(run)
        set_refusals(self._controls, refusals)
        paused = run.clock == "paused"
        assign(self._controls["pause"], visible=not paused)
        assign(self._controls["resume"], visible=paused)
        toggle = {"resume": "Resume"} if paused else {"pause": "Pause"}
        self._reasons.content = refusal_lines({**toggle, "step": "Step", "rate": "Set rate"}, refusals)


class FleetForm:
    """Buttons to let all drones take off, and to reset them; landing and stopping all are orders in the page's head.

    Formations take off through their controllers, single drones individually.
    """

    def __init__(self, gui: viser.GuiApi, client: CommandClient, scenario: Scenario) -> None:
        self._client = client
        self._formations = {cluster.name: cluster.drones for cluster in scenario.clusters}
        self._drones = [drone.name for drone in scenario.drones]
        self._single_drones = single_drones(scenario)
        self._run = RunCondition()
        takeoff = gui.add_button("Take off all", icon=viser.Icon.PLANE_DEPARTURE, color="gray")
        takeoff.on_click(lambda _: self._take_off())
        reset = gui.add_button("Reset all", icon=viser.Icon.REFRESH, color="gray")
        reset.on_click(lambda _: self._reset())
        self._controls: dict[str, Any] = {"takeoff": takeoff, "reset": reset}
        self._reasons = gui.add_html("")

    def refresh(self, run: RunCondition) -> None:
        """Disable what would be refused; Reset all is visible only while a drone is in an emergency."""
        self._run = run
        refusals = fleet_refusals(run, self._single_drones)
        set_refusals(self._controls, refusals)
        assign(self._controls["reset"], visible=not refusals["reset"])
        self._reasons.content = refusal_lines({"takeoff": "Take off all"}, refusals)

    def _take_off(self) -> None:
        for name, drones in self._formations.items():
            if not preflight_refusal(self._run, drones):
                self._client.request_cluster(name, "takeoff")
        ready = [drone for drone in self._single_drones if not preflight_refusal(self._run, [drone])]
        if ready:
            self._client.send_mode(ready, "takeoff")

    def _reset(self) -> None:
        self._client.send_mode([d for d in self._drones if self._run.drones.get(d) == "emergency"], "reset")


class FaultForm:
    """Controls to inject faults: common ones of a chosen drone, or any fault.

    Args:
        report: called with the outcome of each request that is refused without being sent.
        scenario: names the drones and processes.
        drones: drones of the run, with the names of their rotors; without such names, those of the AR.Drone are used.
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
        self._drone = gui.add_dropdown("drone", [drone.name for drone in scenario.drones])
        hint = "0: until it is cleared"
        self._duration = gui.add_number("for [s]", DURATION_S, min=0.0, max=DURATION_MAX_S, step=1.0, hint=hint)
        gui.add_html(limits_line(f"for: 0 to {DURATION_MAX_S:g} s; {hint}"))
        percent_range: dict[str, Any] = {"min": 0.0, "max": 100.0, "step": 1.0}

        def add_button(label: str) -> None:
            gui.add_button(label, color="orange").on_click(lambda _: self._add(*self._common_faults()[label][:3]))

        self._fixes = gui.add_number("fixes lost [%]", FIXES_LOST_PERCENT, **percent_range)
        add_button("GPS lost")
        self._thrust = gui.add_number("thrust left [%]", THRUST_REMAINING_PERCENT, **percent_range)
        add_button("Motor weak")
        self._gust = gui.add_number("gust [m/s]", GUST_M_S, min=-100.0, max=100.0, step=0.5, hint="to the east")
        add_button("Gust")
        self._messages = gui.add_number("msgs lost [%]", MESSAGES_LOST_PERCENT, **percent_range)
        add_button("Messages lost")
        add_button("Kill estimator")
        self._effects = gui.add_html("")
        for control in (self._drone, self._fixes, self._thrust, self._gust, self._messages):
            control.on_update(lambda _: self._describe())
        self._describe()
        self._any_fault(gui)
        gui.add_button("Clear all faults", color="green").on_click(lambda _: client.request_world("fault_clear"))

    def _common_faults(self) -> dict[str, tuple[str, str, dict[str, Any], str]]:
        """Return kind, target, parameters and description of each common fault, by its button's label."""
        drone = self._drone.value
        rotor = (self._rotors.get(drone) or ROTORS)[0]
        fixes, thrust, gust, messages = (
            float(each.value) for each in (self._fixes, self._thrust, self._gust, self._messages)
        )
        link = f"world/estimator.{drone}"
        weak_text = f"rotor {rotor} of {drone}: {thrust:g} % of its thrust is left"
        lost_text = f"{messages:g} % of the messages between the processes {link.replace('/', ' and ')}; not by radio"
        return {
            "GPS lost": ("gps_dropout", drone, {"probability": fixes / 100}, f"{fixes:g} % of the fixes of {drone}"),
            "Motor weak": ("rotor_efficiency", drone, {"rotor": rotor, "value": thrust / 100}, weak_text),
            "Gust": ("gust", "world", {"velocity_m_s": [gust, 0.0, 0.0]}, f"all drones: {gust:g} m/s to the east"),
            "Messages lost": ("link_loss", link, {"probability": messages / 100}, lost_text),
            "Kill estimator": (PROCESS_KILL, f"estimator.{drone}", {}, f"process estimator.{drone}, as with kill -9"),
        }

    def _describe(self) -> None:
        lines = (f"<b>{escape(label)}</b>: {escape(each[3])}" for label, each in self._common_faults().items())
        self._effects.content = f"<div style='{REASON_STYLE}'>{'<br>'.join(lines)}</div>"

    def _add(self, kind: str, target: str, parameters: Mapping[str, Any]) -> None:
        duration_s, lasts = float(self._duration.value), self._kinds[kind].lasts != "once" and "for_s" not in parameters
        refusal = range_refusal("for", duration_s, 0.0, DURATION_MAX_S, "s") if lasts else None
        if refusal:
            self._report(RequestOutcome(f"fault_add {kind} of {target}", refusal))
            return
        duration = {"for_s": duration_s} if lasts and duration_s > 0 else {}
        self._client.request_world("fault_add", kind=kind, target=target, **{**duration, **parameters})

    def _any_fault(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Any fault", expand_by_default=False):
            kind = gui.add_dropdown("kind", list(self._kinds))
            help_ = gui.add_markdown("")
            target = gui.add_text("target", "", hint="as the kind requires; a link between processes is A/B")
            text = gui.add_text(
                "parameters", "", hint="as in `zsim fault add TARGET KIND …`: NAME=VALUE … --for 10s --at 40s"
            )

            def choose() -> None:
                """Describe the chosen kind, and fill in a possible target and default magnitudes."""
                chosen = self._kinds[kind.value]
                magnitudes = unstated(chosen, {})
                lines = [
                    f"`{p.name}` {p.description}: {expected(p)}{'' if p in magnitudes else ' (may be left out)'}"
                    for p in chosen.parameters
                ]
                effect = f"{chosen.description}; affects {TARGET_TEXTS[chosen.strikes]}."
                help_.content = f"<sub>{effect} {'; '.join(lines)}</sub>"
                estimator = f"estimator.{self._drone.value}"
                targets = {"drone": self._drone.value, "link": f"world/{estimator}", "process": estimator}
                target.value = targets.get(chosen.strikes, "world")
                text.value = " ".join(f"{p.name}={'' if p.default is None else p.default}" for p in magnitudes)

            def inject() -> None:
                try:
                    parameters = parse_fault(text.value, kind.value, self._kinds[kind.value])
                except InputError as error:
                    self._report(RequestOutcome("fault_add", str(error)))
                    return
                self._add(kind.value, target.value.strip(), parameters)

            kind.on_update(lambda _: choose())
            choose()
            gui.add_button("Inject it", color="orange").on_click(lambda _: inject())


def parse_fault(text: str, name: str, kind: FaultKind) -> dict[str, Any]:
    """Return the parameters and times of a fault, typed as after TARGET KIND in a terminal.

    Every magnitude must be given, even one with a default: an empty text should not, say, affect all samples.

    Raises:
        InputError: the text is malformed, names a parameter that the kind does not have, or omits a magnitude.
    """
    prefix = f"parameters are {text[:40]!r}"
    try:
        values = typed_rest(text)
    except ValueError as error:
        raise InputError(f"{prefix}: {error}") from None
    allowed_names = [p.name for p in kind.parameters]
    for given in values:
        if given not in (*allowed_names, "at_s", "for_s"):
            allowed = ", ".join([*(f"{each}=VALUE" for each in allowed_names), "--at", "--for"])
            raise InputError(f"{prefix}; {given[:40]!r} is not known, allowed: {allowed}")
    missing = [f"{p.name} is missing; must be {expected(p)}" for p in unstated(kind, values)]
    if missing:
        raise InputError(f"{'; '.join(missing)} ({name})")
    return {given: value for given, value in values.items() if value is not None}


# Elements of forms


class OrderButton:
    """A button for an order, which the page repeats until it is settled; HTML, not a control of viser.

    Args:
        target: target of the order: {"drone": name}, with several names separated by commas, or {"cluster": name}.
        needs_hold: whether the button must be held down for a while.
    """

    visible = True

    def __init__(
        self, gui: viser.GuiApi, label: str, op: str, target: dict[str, str], *, needs_hold: bool = False
    ) -> None:
        self._label, self._op, self._target, self._needs_hold = label, op, target, needs_hold
        self._hint = HELD_HINT if needs_hold else ""
        self.disabled = False
        self._html = gui.add_html(self._content())

    def rename(self, label: str, target: dict[str, str]) -> None:
        self._label, self._target = label, target
        assign(self._html, content=self._content())

    def lock(self, reason: str) -> None:
        self.disabled, self._hint = bool(reason), reason or (HELD_HINT if self._needs_hold else "")
        assign(self._html, content=self._content())

    def _content(self) -> str:
        data = {"data-zsim-order": self._op, **{f"data-{key}": name for key, name in self._target.items()}}
        data |= {"title": self._hint, **({"data-zsim-hold": "1", "class": "stop"} if self._needs_hold else {})}
        attributes = " ".join(f'{key}="{escape(value)}"' for key, value in data.items())
        off = " disabled" if self.disabled else ""
        return f'<div class="zsim-order"><button type="button" {attributes}{off}>{escape(self._label)}</button></div>'


class InputError(ValueError):
    """An operator's text cannot be parsed; the message states the faulty part and what is allowed."""


def range_refusal(name: str, value: float, low: float, high: float, unit: str = "") -> str | None:
    """Return why a typed number is refused, or None if it is within its limits; numbers are never clipped to them."""
    if low <= value <= high:
        return None
    unit_text = f" {unit}" if unit else ""
    return f"{name} is {value:g}{unit_text}; must be from {low:g} to {high:g}{unit_text}"


def assign(control: Any, **properties: Any) -> None:
    for name, value in properties.items():
        if getattr(control, name) != value:
            setattr(control, name, value)


def limits_line(text: str) -> str:
    """Return the limits of a number as HTML, to be shown below its field."""
    return f"<div style='{LIMITS_STYLE}'>{escape(text)}</div>"


def set_refusals(controls: Mapping[str, Any], refusals: Mapping[str, str]) -> None:
    """Disable the controls of operations that would be refused; the reason is their tooltip."""
    for op, control in controls.items():
        reason = refusals.get(op, "")
        if isinstance(control, OrderButton):
            control.lock(reason)
        else:
            assign(control, disabled=bool(reason), hint=reason or None)


def offered_refusals(run: RunCondition, refusals_of: Callable[[RunCondition], Mapping[str, str]]) -> dict[str, str]:
    """Return the refusals; orders are offered even while the world is silent, and emergency stops always."""
    orders = {op: reason for op, reason in refusals_of(run._replace(silent_s=0.0)).items() if op in ORDERS}
    if "emergency" in orders:
        orders["emergency"] = ""
    return {**refusals_of(run), **orders}


def refusal_lines(labels: Mapping[str, str], refusals: Mapping[str, str]) -> str:
    """Return a line of HTML for each reason, with the labels of the controls that it disables."""
    by_reason: dict[str, list[str]] = {}
    for op, label in labels.items():
        if refusals.get(op):
            by_reason.setdefault(refusals[op], []).append(label)
    lines = [f"{', '.join(names)}: {reason}" for reason, names in by_reason.items()]
    return f"<div style='{REASON_STYLE}'>{'<br>'.join(map(escape, lines))}</div>" if lines else ""
