"""A name in a table that may be narrower than it: its end is kept, which tells `estimator.drone2` from its siblings."""

from typing import NamedTuple

from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.text import Text

from zsim.errors import printable

NAME_MIN = 12  # columns that a name keeps where the table is too wide: `…ator.drone12`


def shortened(name: str, width: int) -> str:
    """Return a name in so many columns, its beginning left out where it is longer."""
    return name if len(name) <= width else f"…{name[len(name) - width + 1 :]}"


class NameCell(NamedTuple):
    """A cell with a name of the contract, or of a host, all characters of which are one column wide."""

    name: str

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement(min(len(self.name), NAME_MIN), len(self.name)).with_maximum(options.max_width)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(printable(shortened(self.name, options.max_width)), no_wrap=True, overflow="crop")
