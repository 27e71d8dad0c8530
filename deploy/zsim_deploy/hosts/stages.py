"""What is being done to each host: a line per host that changes on a terminal, a line per stage elsewhere."""

import re

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text


class Stages:
    """Shows the stage of each host while it is entered."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._now: dict[str, str] = {}
        self._live = Live(console=self._console, get_renderable=self._table, refresh_per_second=5)

    def __enter__(self) -> "Stages":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def tell(self, host: str, text: str) -> None:
        """Show what is being done at a host."""
        kind, last = (re.sub(r"\d+ of", "", each) for each in (text, self._now.get(host, "")))
        self._now[host] = text
        if not self._console.is_terminal and kind != last:
            self._console.print(f"{host}: {text}", highlight=False, markup=False, soft_wrap=True)

    def _table(self) -> Table:
        table = Table.grid(padding=(0, 2))
        for host, text in self._now.items():
            table.add_row(Text(host, style="bold"), Text(text))
        return table
