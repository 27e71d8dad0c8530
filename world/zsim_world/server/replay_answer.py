"""What a replay is asked for with, and its answer from the history. Pure."""

from collections.abc import Sequence
from typing import Annotated

import msgspec

from zsim.contract.messages import REFUSALS, ControlAnswer, ControlRequest, Count
from zsim.scenario import rights
from zsim_world.server.message_history import History

EXPRESSIONS_MAX = 1000  # of one replay; a controller of hundreds of drones reads two keys of each


class _Wish(msgspec.Struct):
    """The arguments; `page` is `more` of the answer before."""

    from_ns: int
    keys: Annotated[list[str], msgspec.Meta(max_length=EXPRESSIONS_MAX)]
    page: Count = 0


def answer(request: ControlRequest, history: History, readable: Sequence[str]) -> ControlAnswer:
    """Return a page of what passed, as far as the asker may read it.

    Args:
        request: with from_ns, keys and page.
        history: what passed.
        readable: expressions of the keys that the asker may read.
    """
    try:
        wish = msgspec.convert(request.args, _Wish)
    except REFUSALS as error:
        return ControlAnswer(False, f"replay: needs from_ns (whole number) and keys (list of texts): {error}")
    page = history.page(
        wish.from_ns,
        lambda key: rights.permits(wish.keys, key) and rights.permits(readable, key),
        wish.page,
    )
    return ControlAnswer(True, result=page.passed, more=page.more)
