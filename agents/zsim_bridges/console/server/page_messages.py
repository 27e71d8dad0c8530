"""Which messages of a page may reach viser."""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import msgspec
import viser
from msgspec import Meta, Struct

from zsim.contract import flight_messages
from zsim.schema import message
from zsim_bridges.console.server.http_proxy import MESSAGE_MAX
from zsim_bridges.console.server.page_tokens import OPERATOR

NAME_MAX = 64  # characters of what is no text of a user's
VALUE_MAX = 2_000  # characters of a control's text: expressions of twelve variables, a line each
EXACT_MAX = 2**53  # a page's numbers are exact up to it; a larger one fits no message

Value = bool | message.Number | Annotated[str, Meta(max_length=VALUE_MAX)]


class ViewerCamera(Struct, tag_field="type", tag="ViewerCameraMessage"):
    """Every page sends where its camera is."""

    wxyz: flight_messages.Quaternion
    position: message.Vector3
    fov: message.Number
    near: message.Number
    far: message.Number
    image_height: message.Number
    image_width: message.Number
    look_at: message.Vector3
    up_direction: message.Vector3


class ControlUpdate(Struct, tag_field="type", tag="GuiUpdateMessage", forbid_unknown_fields=True):
    """A page sends this when somebody uses a control."""

    class Updates(Struct, forbid_unknown_fields=True):
        """Only the value of a control."""

        value: Value

    uuid: str
    updates: Updates


class SceneClick(Struct, tag_field="type", tag="ScenePointerMessage"):
    """A page sends this when somebody clicks into the scene; nothing but the ray is looked at."""

    event_type: Literal["click"]
    ray_origin: message.Vector3
    ray_direction: message.Vector3
    screen_pos: tuple[tuple[message.Number, message.Number]]
    modifier: Annotated[str, Meta(max_length=NAME_MAX)] | None = None


_DECODER = msgspec.msgpack.Decoder(ViewerCamera | ControlUpdate | SceneClick)
"""All other messages are refused, such as to show the page on the Internet, or to upload files."""


class PageControls:
    """The controls that viser knows, and those that each page has for itself.

    Args:
        gui: of all pages.
        pages: returns the GUI of each open page.
    """

    def __init__(self, gui: viser.GuiApi, pages: Callable[[], Sequence[viser.GuiApi]] = tuple) -> None:
        self._gui = gui
        self._pages = pages

    def _own(self, uuid: str) -> Any:
        handles = (page._gui_input_handle_from_uuid.get(uuid) for page in self._pages())
        return next((handle for handle in handles if handle is not None), None)

    def accepts(self, uuid: str, value: Value) -> bool:
        """Return whether a control takes such a value: viser converts it to its type, and fails where it cannot."""
        handle: Any = self._gui._gui_input_handle_from_uuid.get(uuid)  # viser has no public way to a control by its id
        handle = handle or self._own(uuid)
        return handle is not None and not getattr(handle, "disabled", False) and _accepts(handle, value)


def _accepts(handle: Any, value: Value) -> bool:
    options = getattr(handle, "options", None)
    if options is not None:
        return value in options
    current = handle.value
    if isinstance(current, bool) or isinstance(value, bool):
        return isinstance(current, bool) and isinstance(value, bool)
    if isinstance(current, str) or isinstance(value, str):
        return isinstance(current, str) and isinstance(value, str)
    return abs(value) <= EXACT_MAX


def is_permitted(data: bytes, role: str, controls: PageControls) -> bool:
    """Return whether a message of a page may reach the console.

    Args:
        data: one message of viser's: a msgpack map with its type.
        role: of the page.
        controls: of all pages.
    """
    if len(data) > MESSAGE_MAX:
        return False
    try:
        message = _DECODER.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return False
    if not isinstance(message, ControlUpdate):
        return True
    return role == OPERATOR and controls.accepts(message.uuid, message.updates.value)
