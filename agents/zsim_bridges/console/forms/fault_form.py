"""Injecting faults, and clearing them: common ones by a button, all by their kind."""

from collections.abc import Callable
from typing import Any

import viser

from zsim.scenario.fault_kinds import KINDS, PROCESS_KILL
from zsim.scenario.scenario import Scenario
from zsim_bridges.console.command_client import Desk, Told
from zsim_bridges.console.forms import form_input

FOR_S = 30.0  # of a fault, unless another time is typed
WEAK = 0.7  # share of thrust of a weak motor: less, and the aircraft cannot be held level
GUST_M_S = (4.0, 0.0, 0.0)  # about what the drones of the formation can still hold against
LOSS = 0.3
TIMES = ("at_s", "for_s")  # s, simulated; what any fault may be given beside its own parameters


class FaultForm:
    """Controls of faults.

    Args:
        gui: viser's, in the place where they are to be.
        desk: sends what is asked for.
        tell: told what is refused already here.
        scenario: names what there is.
    """

    def __init__(self, gui: viser.GuiApi, desk: Desk, tell: Callable[[Told], None], scenario: Scenario) -> None:
        self._desk = desk
        self._tell = tell
        names = [drone.name for drone in scenario.drones]
        self._drone = gui.add_dropdown("drone", names)
        self._for = gui.add_number("for [s]", FOR_S, min=0.0, max=1e5, step=1.0, hint="0: until it is cleared")
        self._button(gui, "GPS lost", lambda: self._on_drone("gps_dropout"))
        self._button(gui, "Motor weak", lambda: self._on_drone("rotor_efficiency", rotor="front_left", value=WEAK))
        self._button(gui, "Gust", lambda: self._add("gust", "world", velocity_m_s=list(GUST_M_S)))
        self._button(gui, "Link loss", lambda: self._add("link_loss", f"world/{self._estimator()}", probability=LOSS))
        self._button(gui, "Kill estimator", lambda: self._add(PROCESS_KILL, self._estimator()))
        self._any(gui, names)
        gui.add_button("Clear all faults", color="green").on_click(lambda _: desk.world("fault_clear"))

    def _button(self, gui: viser.GuiApi, label: str, act: Callable[[], None]) -> None:
        gui.add_button(label, color="orange").on_click(lambda _: act())

    def _estimator(self) -> str:
        return f"estimator.{self._drone.value}"

    def _on_drone(self, kind: str, **parameters: Any) -> None:
        self._add(kind, self._drone.value, **parameters)

    def _add(self, kind: str, target: str, **parameters: Any) -> None:
        lasting = {"for_s": float(self._for.value)} if self._for.value > 0 and KINDS[kind].lasts != "once" else {}
        self._desk.world("fault_add", kind=kind, target=target, **{**lasting, **parameters})

    def _any(self, gui: viser.GuiApi, names: list[str]) -> None:
        with gui.add_folder("Any fault", expand_by_default=False):
            kind = gui.add_dropdown("kind", list(KINDS))
            target = gui.add_text("target", names[0], hint="drone, world, process, or link A/B")
            help_ = gui.add_markdown(_help(kind.value))
            text = gui.add_text("parameters", "", hint="NAME: VALUE, NAME: VALUE, …; at_s and for_s too")
            kind.on_update(lambda _: setattr(help_, "content", _help(kind.value)))
            gui.add_button("Inject it", color="orange").on_click(
                lambda _: self._inject(kind.value, target.value, text.value)
            )

    def _inject(self, kind: str, target: str, text: str) -> None:
        try:
            parameters = form_input.parameters(text, [*TIMES, *(p.name for p in KINDS[kind].parameters)])
        except form_input.TypedError as error:
            self._tell(Told("fault_add", str(error)))
            return
        self._add(kind, target.strip(), **parameters)


def _help(kind: str) -> str:
    """Return what a kind does and takes."""
    found = KINDS[kind]
    lines = [f"`{p.name}` {p.description}{f' [{p.unit}]' if p.unit else ''}" for p in found.parameters]
    return f"<sub>{found.description}; strikes a {found.strikes}. {'; '.join(lines)}</sub>"
