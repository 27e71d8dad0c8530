"""The slider of one variable of a formation."""

import threading
import time
from typing import Any, NamedTuple

import viser

from zsim_bridges.console.page.operator_input import SliderRange

STILL_S = 2.0  # wall; a formation whose goal has not changed for so long is not on its way: the slider shows its goal


class _HeldValue(NamedTuple):
    """Value of a slider that was moved, the formation's newest goal, and since when it is the goal [s, wall]."""

    value: float
    goal: float
    since_s: float


class VariableSlider:
    """A slider of one cluster variable, which follows the formation while the operator does not move it.

    Args:
        gui: viser's, in the folder where it is to be.
        range_: of the variable, in whose unit all values here are.
    """

    def __init__(self, gui: viser.GuiApi, range_: SliderRange) -> None:
        self.range = range_
        self._lock = threading.Lock()
        self._moved: tuple[float, float] | None = None
        self._held: _HeldValue | None = None
        self._slider: Any = gui.add_slider(range_.label, range_.low, range_.high, range_.step, range_.start)
        self._slider.label = range_.label_unknown
        self._slider.on_update(self._on_update)

    def lock(self, locked: bool) -> None:
        """Let nobody move it, or let them."""
        if self._slider.disabled != locked:
            self._slider.disabled = locked

    @property
    def moved_s(self) -> float | None:
        """When an operator moved it last [s, wall], None once the value has been popped."""
        moved = self._moved
        return None if moved is None else moved[1]

    def pop_value(self) -> float | None:
        """Return the value to which it was moved, once; None where it was not moved."""
        with self._lock:
            moved, self._moved = self._moved, None
        return None if moved is None else moved[0]

    def hold(self, wall_s: float) -> None:
        """Keep its value while the formation goes there."""
        self._held = _HeldValue(float(self._slider.value), float("nan"), wall_s)

    def follow(self, goal: float, wall_s: float) -> None:
        """Show the formation's goal [m, rad], unless it was moved and the formation is on its way."""
        shown = self.range.to_display(goal)
        if self._moved is None and not self._is_held(shown, wall_s):
            self._widen(shown)
            self._slider.value = shown
            self._mark(goal)

    def _widen(self, shown: float) -> None:
        """Let the slider reach as far as what it shows, which is as it is: what it may ask for stays the range."""
        low, high = min(self.range.low, shown), max(self.range.high, shown)
        if (self._slider.min, self._slider.max) != (low, high):
            self._slider.min, self._slider.max = low, high

    def _mark(self, goal: float) -> None:
        """Let the label say that a value is out of range."""
        label = self.range.label_of(goal)
        if self._slider.label != label:
            self._slider.label = label

    def _is_held(self, goal: float, wall_s: float) -> bool:
        kept = self._held
        if kept is None:
            return False
        if goal != kept.goal:
            self._held = kept._replace(goal=goal, since_s=wall_s)
        elif goal == kept.value or wall_s - kept.since_s > STILL_S:
            self._held = None
        return self._held is not None

    def _on_update(self, event: viser.GuiEvent[Any]) -> None:
        if event.client_id is None:
            return  # set by `follow`
        with self._lock:
            self._moved = (float(self._slider.value), time.monotonic())
