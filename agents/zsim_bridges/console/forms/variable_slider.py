"""A slider of a cluster variable: people move it, and the formation moves it along when nobody does."""

import threading
import time
from typing import Any, NamedTuple

import viser

from zsim_bridges.console.forms.slider_limits import SliderRange

STILL_S = 2.0  # wall; a formation whose goal has not moved for so long goes nowhere: the slider shows where it is to be


class _HeldValue(NamedTuple):
    """Where a slider was put, where the formation was to be when that last changed, and when on the wall it did."""

    value: float
    goal: float
    since_s: float


class VariableSlider:
    """One variable.

    Args:
        gui: viser's, in the place where it is to be.
        range_: of the variable, in whose unit all values here are.
    """

    def __init__(self, gui: viser.GuiApi, range_: SliderRange) -> None:
        self.range = range_
        self._lock = threading.Lock()
        self._moved: tuple[float, float] | None = None
        self._out_of_range = False
        self._held: _HeldValue | None = None
        self._slider: Any = gui.add_slider(range_.label, range_.low, range_.high, range_.step, range_.to_display(0.0))
        self._slider.on_update(self._on_update)

    @property
    def moved_s(self) -> float | None:
        """When on the wall somebody moved it last, None once that has been taken."""
        moved = self._moved
        return None if moved is None else moved[1]

    def pop_value(self) -> float | None:
        """Return where it was moved to, once; None where nobody has moved it."""
        with self._lock:
            moved, self._moved = self._moved, None
        return None if moved is None else moved[0]

    def hold(self, wall_s: float) -> None:
        """Leave it where it was put while the formation goes there."""
        self._held = _HeldValue(float(self._slider.value), float("nan"), wall_s)

    def follow(self, goal: float, wall_s: float) -> None:
        """Show where the formation is to be, a value [m, rad], unless it was moved and the formation is on its way."""
        shown = self.range.to_display(goal)
        if self._moved is None and not self._is_held(shown, wall_s):
            self._slider.value = shown

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
            return  # by `follow`
        value = float(self._slider.value)
        with self._lock:
            # A page takes a number from beyond the limits, and puts it to the nearest limit when its box is left.
            if self._out_of_range and value in (self.range.low, self.range.high):
                self._out_of_range = False
                return
            self._out_of_range = self.range.refusal(value) is not None
            self._moved = (value, time.monotonic())
