"""The controls that are on pages, and what they take."""

from typing import Any

import viser

from zsim_bridges.console.http.page_rights import Value

EXACT_MAX = 2**53  # a number of a page is whole up to it; a larger one fits no message


class PageControls:
    """What viser knows of its controls, and the switches that each page has for itself.

    Args:
        gui: of all pages.
        switches: ids of those of single pages.
    """

    def __init__(self, gui: viser.GuiApi, switches: set[str]) -> None:
        self._gui = gui
        self._switches = switches

    def is_local(self, uuid: str) -> bool:
        """Tell whether a control changes nothing but its own page."""
        return uuid in self._switches

    def accepts(self, uuid: str, value: Value) -> bool:
        """Tell whether a control takes such a value: viser turns it into another type, and fails where it cannot."""
        if uuid in self._switches:
            return isinstance(value, bool)
        handle: Any = self._gui._gui_input_handle_from_uuid.get(uuid)  # viser has no public way to a control by its id
        return handle is not None and _accepts(handle, value)


def _accepts(handle: Any, value: Value) -> bool:
    options = getattr(handle, "options", None)
    if options is not None:
        return value in options
    now = handle.value
    if isinstance(now, bool) or isinstance(value, bool):
        return isinstance(now, bool) and isinstance(value, bool)
    if isinstance(now, str) or isinstance(value, str):
        return isinstance(now, str) and isinstance(value, str)
    return abs(value) <= EXACT_MAX
