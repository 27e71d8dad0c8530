"""A substitute for viser's GUI that records its controls and lets tests operate them."""

import math
import re
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

PERSON, NOBODY = 1, None  # client_id of a control's event: a page's, or none when the console itself sets the value


class Control:
    """A control: its properties, and its callbacks."""

    def __init__(self, value: Any = None, label: str = "", options: Sequence[str] = ()) -> None:
        self.value, self.label, self.options = value, label, options
        self.min, self.max = -math.inf, math.inf  # bounds of a slider
        self.content = ""
        self.visible = True
        self.disabled = False
        self.hint: str | None = None
        self.acts: list[Callable[[Any], None]] = []

    def __enter__(self) -> "Control":
        return self

    def __exit__(self, *_: object) -> None:
        return

    def on_click(self, act: Callable[[Any], None]) -> None:
        self.acts.append(act)

    on_update = on_click

    def put(self, value: Any = None, client_id: int | None = PERSON) -> None:
        """Change the value as a page does, or as the console itself does (NOBODY)."""
        self.value = value
        self.press(client_id)

    def press(self, client_id: int | None = PERSON) -> None:
        for act in self.acts:
            act(SimpleNamespace(client_id=client_id))

    def add_tab(self, label: str, icon: Any = None) -> "Control":
        return Control()

    def dock_left(self) -> None:
        return

    dock_right = dock_left

    def set_width(self, _: float) -> None:
        return


class OrderHtml(Control):
    """The button of an order: HTML from which the page builds the order when the button is pressed."""

    @property
    def order(self) -> dict[str, str]:
        return dict(re.findall(r'data-([\w-]+)="([^"]*)"', self.content))

    @property
    def label(self) -> str:
        return re.findall(r">([^<>]+)</button>", self.content)[0] if self.content else ""

    @label.setter
    def label(self, _: str) -> None: ...

    @property
    def hint(self) -> str | None:
        return re.findall(r'title="([^"]*)"', self.content)[0] or None

    @hint.setter
    def hint(self, _: str | None) -> None: ...  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def disabled(self) -> bool:
        return " disabled>" in self.content

    @disabled.setter
    def disabled(self, _: bool) -> None: ...


class Gui:
    """A page that records its controls.

    Attributes:
        at: controls by label; the labels are unique.
        html, buttons, plots: controls in the order of their creation.
    """

    def __init__(self) -> None:
        self.main_panel = Control()
        self.at: dict[str, Control] = {}
        self.html: list[Control] = []
        self.buttons: list[Control] = []
        self.plots: list[Any] = []

    def _add(self, label: str | None, value: Any = None, options: Sequence[str] = ()) -> Control:
        control = Control(value, label or "", options)
        if label is not None:
            assert label not in self.at, f"two controls are called {label!r}"
            self.at[label] = control
        return control

    def add_button(self, label: str, *, visible: bool = True, **_: Any) -> Control:
        self.buttons.append(self._add(label))
        self.buttons[-1].visible = visible
        return self.buttons[-1]

    def add_button_group(self, label: str, options: list[str]) -> Control:
        return self._add(label, options[0])

    def add_dropdown(self, label: str, options: list[str], initial_value: str | None = None) -> Control:
        return self._add(None if label in self.at else label, initial_value or options[0], options)

    def add_number(self, label: str, value: float, **_: Any) -> Control:
        return self._add(label, value)

    def add_slider(self, label: str, low: float, high: float, step: float, value: float) -> Control:
        slider = self._add(label, value)
        slider.min, slider.max = low, high
        return slider

    def add_text(self, label: str, value: str, **_: Any) -> Control:
        return self._add(label, value)

    def add_checkbox(self, label: str, value: bool, **_: Any) -> Control:
        return self._add(label, value)

    def add_folder(self, label: str | None, **_: Any) -> Control:
        return Control()

    def add_html(self, content: str, **_: Any) -> Control:
        made = OrderHtml() if "data-zsim-order" in content else Control()
        made.content = content
        if isinstance(made, OrderHtml):
            self.at[made.label] = made
        self.html.append(made)
        return made

    def add_uplot(self, data: Any, series: Any, title: str, scales: Any, **_: Any) -> Any:
        self.plots.append(SimpleNamespace(data=data, title=title, visible=True, scales=scales))
        return self.plots[-1]

    def add_markdown(self, _: str) -> Control:
        return Control()

    def add_tab_group(self) -> Control:
        return Control()

    add_panel = add_tab_group

    def reset(self) -> None:
        return

    def configure_theme(self, **_: Any) -> None:
        return

    def set_panel_label(self, _: str) -> None:
        return

    def press(self, label: str) -> None:
        self.at[label].put(None)
