"""The controls of each page, and which page is in control of what."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
from fake_gui import Control, Gui
from refused import has_terms, without_tags

from zsim_bridges.console import scene
from zsim_bridges.console.console_page import ControlForm, DroneForm, PageForms
from zsim_bridges.console.control_desk import LOST_S, RUN, ControlDesk
from zsim_bridges.console.run_condition import RunCondition

NAMES = ["drone1", "drone2"]


def part_of(_: str) -> str:
    return "main"


class Figures:
    """The figures of one page; like viser, they cannot be set once they are removed."""

    def __init__(self) -> None:
        self.removed, self.shown = False, ""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "content":
            if self.removed:
                raise RuntimeError("Cannot assign to 'content' on a removed GuiHtmlHandle.")
            name = "shown"
        super().__setattr__(name, value)


class Pages:
    """A server that records the callbacks for pages and the figures of each page."""

    def __init__(self) -> None:
        self.clients: dict[int, Any] = {}
        self.figures: dict[int, Figures] = {}

    def on_client_connect(self, add: Any) -> None:
        self.add = add

    def on_client_disconnect(self, remove: Any) -> None:
        self.remove = remove

    def get_clients(self) -> dict[int, Any]:
        return self.clients

    def open(self, client_id: int) -> None:
        """Open a page whose dropdowns show their first options."""
        made: list[Figures] = []
        gui = MagicMock()

        def add_html(*_: Any, **__: Any) -> Figures:
            made.append(Figures())
            return made[-1]

        gui.add_html.side_effect = add_html
        gui.add_dropdown.side_effect = lambda _, options, **__: SimpleNamespace(
            value=options[0], on_update=lambda _: None
        )
        self.clients[client_id] = SimpleNamespace(client_id=client_id, gui=gui, scene=MagicMock())
        self.add(self.clients[client_id])
        *_, self.figures[client_id], _ = made  # the events come last


def test_a_page_closed_while_it_is_drawn_does_not_affect_the_others():
    pages, shared = Pages(), MagicMock(parts={})
    server: Any = pages
    forms = PageForms(server, MagicMock(), shared, NAMES, MagicMock(), ControlDesk(["main"]), part_of)
    pages.open(1)
    pages.open(2)
    pages.figures[1].removed = True
    forms.show([], {}, lambda drones: {drone: f"figures of {drone}" for drone in drones}, [])
    assert (pages.figures[1].shown, pages.figures[2].shown) == ("", "figures of drone1")
    assert forms.chosen(1) == ""
    assert forms.chosen(2) == "drone1"


def test_the_ground_of_a_page_follows_its_theme():
    pages, shared = Pages(), MagicMock(parts={})
    server: Any = pages
    PageForms(server, MagicMock(), shared, NAMES, MagicMock(), ControlDesk(["main"]), part_of)
    pages.open(1)
    page = pages.clients[1]
    theme = page.gui.add_checkbox.return_value
    (switch,) = theme.on_update.call_args.args
    for dark, colours in ((True, scene.DARK), (False, scene.LIGHT)):
        theme.value = dark
        switch(None)
        assert page.scene.add_box.call_args.args[:2] == ("/field", colours[0])
        assert page.scene.add_grid.call_args.kwargs["cell_color"] == colours[1]


# Control


class Desk(ControlDesk):
    """A desk with three pages, on a clock that the test advances; it records the messages to pages."""

    def __init__(self) -> None:
        self.wall_s = 100.0
        self.notices: list[tuple[int, str]] = []
        super().__init__(["main"], lambda page, line: self.notices.append((page, line)), lambda: self.wall_s)
        for page, role in ((4, "operator"), (7, "operator"), (9, "viewer")):
            self.record_poll(page, role, f"10.0.0.{page}")

    def holders(self) -> list[str]:
        return [each.holder for each in self.holdings(4, self.parts)]


ONE, TWO = "operator 1 (10.0.0.4)", "operator 2 (10.0.0.7)"


@pytest.fixture
def desk() -> Desk:
    return Desk()


def test_one_page_is_in_control_and_the_others_see_it(desk: Desk):
    assert desk.use(4, "main") == ""
    assert desk.use(4, "main") == ""
    assert has_terms(desk.use(7, "main"), ONE, "main", "Control")
    assert desk.use(7, RUN) == ""  # another part
    assert desk.holders() == [ONE, TWO]
    assert desk.others(7) == [ONE, "viewer 3 (10.0.0.9)"]
    assert desk.refusal(4, "")  # neither page controls every part
    assert desk.refusal(7, "")
    desk.release(7, RUN)
    assert desk.refusal(4, "") == ""


def test_a_refusal_of_a_drone_names_it_and_the_part_to_ask_for():
    pages, desk = Pages(), ControlDesk(["main"])
    server: Any = pages
    forms = PageForms(server, MagicMock(), MagicMock(parts={}), NAMES, MagicMock(), desk, lambda _: RUN)
    pages.open(1)
    pages.open(2)
    assert forms.use(1, "drone2") == ""
    assert has_terms(forms.use(2, "drone2"), "operator 1", "time and faults", "drone2", "Control")
    assert has_terms(desk.refusal(2, RUN), "operator 1", "time and faults", "Control")


def test_control_is_requested_and_granted_or_kept(desk: Desk):
    desk.use(4, "main")
    desk.request(7, "main")
    assert [page for page, _ in desk.notices] == [4]
    assert desk.refusal(7, "main")
    desk.answer(9, "main", granted=True)  # not in control, so without effect
    assert desk.holders() == [ONE, ""]
    desk.answer(4, "main", granted=False)
    assert (desk.holders(), desk.notices[-1][0]) == ([ONE, ""], 7)
    desk.answer(4, "main", granted=True)  # no request is pending
    assert desk.holders() == [ONE, ""]
    desk.request(7, "main")
    desk.answer(4, "main", granted=True)
    assert desk.holders() == [TWO, ""]
    assert has_terms(desk.refusal(4, "main"), TWO)


def test_a_lost_page_loses_the_parts_that_another_requests(desk: Desk):
    desk.use(4, "main")
    desk.use(4, RUN)
    desk.request(7, "main")
    desk.wall_s += LOST_S
    desk.release_lost()
    assert desk.holders() == [ONE, ONE]
    desk.wall_s += 0.1
    desk.release_lost()
    assert desk.holders() == [TWO, ONE]
    assert {page for page, _ in desk.notices[-2:]} == {4, 7}
    assert desk.holdings(7, [RUN])[0].silent_s > LOST_S  # the others see that it is silent


def test_a_closed_page_releases_its_parts_to_the_requesting_page(desk: Desk):
    desk.use(4, "main")
    desk.use(4, RUN)
    desk.request(7, "main")
    desk.close(4)
    assert desk.holders() == [TWO, ""]
    desk.close(7)
    assert desk.holders() == ["", ""]


def test_a_closed_page_is_not_granted_control(desk: Desk):
    desk.use(4, "main")
    desk.request(7, "main")
    desk.close(7)
    desk.answer(4, "main", granted=True)
    assert desk.holders() == [ONE, ""]


class ControlGui(Gui):
    """The controls of one page, several of which may have the same label."""

    def _add(self, label: str | None, value: Any = None, options: Sequence[str] = ()) -> Control:
        return Control(value, label or "", options)

    def offered(self) -> list[str]:
        return [button.label for button in self.buttons if button.visible]


def test_pages_request_and_grant_control_with_their_buttons():
    desk, guis, forms = Desk(), {}, {}
    for page in (4, 7):
        gui: Any = ControlGui()
        guis[page], forms[page] = gui, ControlForm(gui, desk, page, {"a": "main", "b": RUN, "c": ""})

    def offered() -> list[list[str]]:
        for form in forms.values():
            form.refresh(["main", RUN])
        return [guis[page].offered() for page in (4, 7)]

    assert offered() == [[], []]
    desk.use(4, "main")
    assert offered() == [["Release main"], ["Ask for main"]]
    styles = [guis[page].html[0].content.partition("<style>")[2] for page in (4, 7)]
    assert styles == ["", '[id="a"],[id="c"]{opacity:.35}</style>']
    guis[7].buttons[0].press()
    assert offered() == [[f"Give main to {TWO}", "Keep main"], []]
    assert has_terms(without_tags(guis[7].html[0].content.replace("<br>", "\n")), "main", ONE, "you have asked")
    guis[4].buttons[1].press()
    assert offered() == [["Release main"], ["Ask for main"]]
    guis[7].buttons[0].press()
    guis[4].buttons[0].press()
    assert offered() == [["Ask for main"], ["Release main"]]
    guis[7].buttons[0].press()
    assert offered() == [[], []]


def test_without_control_a_page_may_land_and_stop_but_not_take_off():
    desk, gui, client = Desk(), ControlGui(), MagicMock()
    shown: Any = gui
    form = DroneForm(shown, client, NAMES, lambda drone, use: (desk.use if use else desk.refusal)(7, part_of(drone)))
    takeoff, back, reset = gui.buttons  # land and emergency are orders, not buttons
    run = RunCondition("running", drones={"drone1": "landed", "drone2": "landed"})
    form.refresh(run)
    assert not takeoff.disabled
    desk.use(4, "main")
    for button in (takeoff, back, reset):
        button.press()
    assert not client.send_mode.called
    form.refresh(run)
    assert has_terms(takeoff.hint, ONE)
    assert not any("disabled" in each.content for each in gui.html if 'data-zsim-order="emergency"' in each.content)
    desk.release(4, "main")
    takeoff.press()
    assert desk.holders() == [TWO, ""]
