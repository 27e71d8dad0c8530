"""Controls that each page has for itself: a page that goes takes nothing with it."""

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

from zsim_bridges.console.page.page_forms import PageForms
from zsim_bridges.console.scene import ground_grid

NAMES = ["drone1", "drone2"]


class Figures:
    """Figures of one page; of a removed one viser lets nothing be set."""

    def __init__(self) -> None:
        self.removed, self.shown = False, ""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "content":
            if self.removed:
                raise RuntimeError("Cannot assign to 'content' on a removed GuiHtmlHandle.")
            name = "shown"
        super().__setattr__(name, value)


class Pages:
    """A server that notes who wants to know of pages, and the figures of each page."""

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
        """Open a page, whose dropdowns show what they began with."""
        figures, gui = Figures(), MagicMock()
        gui.add_html.side_effect = lambda _: figures
        gui.add_dropdown.side_effect = lambda _, options, **__: SimpleNamespace(
            value=options[0], on_update=lambda _: None
        )
        self.figures[client_id] = figures
        self.clients[client_id] = SimpleNamespace(client_id=client_id, gui=gui, scene=MagicMock())
        self.add(self.clients[client_id])


def test_a_page_that_is_closed_while_it_is_drawn_ends_nothing_of_the_others():
    pages, folder = Pages(), MagicMock()
    server: Any = pages
    forms = PageForms(server, MagicMock(), NAMES, MagicMock(), folder, folder, folder, folder)
    pages.open(1)
    pages.open(2)
    pages.figures[1].removed = True
    forms.show_figures(lambda _: "", lambda drone: f"figures of {drone}")
    assert (pages.figures[1].shown, pages.figures[2].shown) == ("", "figures of drone1")
    assert forms.chosen(1) == ""
    assert forms.chosen(2) == "drone1"


def test_the_ground_of_a_page_has_its_theme():
    pages, folder = Pages(), MagicMock()
    server: Any = pages
    PageForms(server, MagicMock(), NAMES, MagicMock(), folder, folder, folder, folder)
    pages.open(1)
    page = pages.clients[1]
    theme = page.gui.add_checkbox.return_value
    (switch,) = theme.on_update.call_args.args
    for dark, colours in ((True, ground_grid.DARK), (False, ground_grid.LIGHT)):
        theme.value = dark
        switch(None)
        assert page.scene.add_box.call_args.args[:2] == ("/field", colours[0])
        assert page.scene.add_grid.call_args.kwargs["cell_color"] == colours[1]
