"""Progress of a run: a live line and a line per event on a terminal (`Screen`), or JSON lines for a launcher."""

import json
import math
import sys
import threading
from collections.abc import Callable
from typing import Any, Protocol, Self

import msgspec
from rich.console import Console
from rich.live import Live
from rich.text import Text

from zsim.contract.flight_messages import ClusterState
from zsim.contract.run_messages import Waiting, waiting_text
from zsim.errors import printable, without_numbers

PERIOD_S = 0.2  # wall time between two updates
SLOW_S = 3.0  # wall time until the notice; compiled code loads within 2 s unless the machine is busy
SLOW_NOTICE = "loading compiled code; the first time on a machine it is compiled, which takes one to three minutes"
REPEATED_S = 10.0  # simulated time over which equal events are counted; also the interval of plain clock lines
REASON_NS = 5_000_000_000  # simulated time after which a reason is shown; in a normal take-off one lasts 3 s
DRIVERS, PRESENCE = "driver.", ("join", "leave")  # shown because people start drivers by hand and watch this screen
QUIET = frozenset({"join", "leave", "command", "control", "mode", "commander", "release", "refused", "end"})


def cell(text: str) -> Text:
    """Return a text for rich in which brackets are not parsed as markup and control codes are visible."""
    return Text(printable(text))


class NotebookLine:
    """A line below a notebook cell that is updated in place; rich would need ipywidgets for this."""

    def __init__(self) -> None:
        self._handle: Any = None

    def update(self, text: str) -> None:
        from IPython.display import Pretty, display  # present in every notebook

        shown = Pretty(printable(text))
        if self._handle is None:
            self._handle = display(shown, display_id=True)
        else:
            self._handle.update(shown)


class ProgressSink(Protocol):
    """Interface of progress displays: `Screen` and `JsonProgress`."""

    def clock(self, line: dict[str, Any]) -> None: ...
    def event(self, line: dict[str, Any]) -> None: ...
    def health(self, line: dict[str, Any]) -> None: ...
    def say(self, text: str) -> None: ...


class SlowStart:
    """Shows a line from another thread if a start takes longer than SLOW_S, usually because code is being compiled."""

    def __init__(self, say: Callable[[str], None], text: str = SLOW_NOTICE) -> None:
        self._timer = threading.Timer(SLOW_S, say, args=(text,))
        self._timer.daemon = True
        self._timer.start()

    def over(self) -> None:
        self._timer.cancel()


class HoldReasons:
    """The reasons why clusters wait; a reason that persists is shown once."""

    def __init__(self) -> None:
        self._since: dict[str, tuple[str, int]] = {}
        self._shown: set[tuple[str, str]] = set()

    def line(self, cluster: str, state: ClusterState) -> str | None:
        """Return a line once a state's reason, whatever its numbers, has persisted for REASON_NS; otherwise None."""
        shape = without_numbers(state.reason)
        former, since_ns = self._since.get(cluster, ("", 0))
        if shape != former:
            self._since[cluster] = (shape, state.t_ns)
            return None
        if not shape or state.t_ns - since_ns < REASON_NS or (cluster, shape) in self._shown:
            return None
        self._shown.add((cluster, shape))
        return f"  {state.t_ns / 1e9:8.2f} s  {cluster}, {state.phase}: {state.reason}"


class RepeatedEvents:
    """Merges repeated events: the first is shown immediately, further equal ones as one line with their count."""

    def __init__(self) -> None:
        # by kind and text: simulated times of the first and the last event [s], and their count
        self._counted: dict[tuple[str, str], tuple[float, float, int]] = {}

    def lines(self, t_s: float, kind: str, text: str) -> list[str]:
        lines = self.over(t_s)
        first = self._counted.get((kind, text))
        self._counted[kind, text] = (first[0], t_s, first[2] + 1) if first else (t_s, t_s, 1)
        return lines if first else [*lines, f"  {t_s:8.2f} s  {kind}: {text}"]

    def over(self, t_s: float) -> list[str]:
        """Return a line for each repeated event that has been counted for REPEATED_S, and stop counting it."""
        ended = [key for key, (first_s, _, _) in self._counted.items() if t_s - first_s >= REPEATED_S]
        counted = [(*key, *self._counted.pop(key)) for key in ended]
        return [
            f"  {last_s:8.2f} s  {kind}: {text} ({count - 1} more since {first_s:.2f} s)"
            for kind, text, first_s, last_s, count in counted
            if count > 1
        ]


class JsonProgress:
    """Writes progress as JSON lines for the launcher or another parent process."""

    @staticmethod
    def read(text: str) -> tuple[str, Any]:
        """Return the kind and content of a line from this class; the kind is empty for other output."""
        try:
            line = json.loads(text)
        except ValueError:
            return "", text
        if not isinstance(line, dict):  # other output, such as a number, may be valid JSON
            return "", text
        return next(((kind, line[kind]) for kind in ("clock", "event", "health", "say") if kind in line), ("", text))

    def clock(self, line: dict[str, Any]) -> None:
        self._write("clock", line)

    def event(self, line: dict[str, Any]) -> None:
        self._write("event", line)

    def health(self, line: dict[str, Any]) -> None:
        self._write("health", line)

    def say(self, text: str) -> None:
        self._write("say", text)

    def hang_up(self) -> None:
        """Do nothing: the reader of the lines handles the loss of the terminal."""

    def _write(self, kind: str, content: Any) -> None:
        try:
            sys.stdout.write(json.dumps({kind: content}) + "\n")
            sys.stdout.flush()
        except (BrokenPipeError, ValueError):
            return  # the launcher has ended; its stop channel then ends this process


class PipedConsole(Console):
    """A console that drops its output without an error once the reader has gone."""

    def on_broken_pipe(self) -> None:
        self.quiet = True


class Screen:
    """Shows progress live on a terminal; elsewhere, prints events, and a line per wait and per ten simulated seconds.

    Args:
        duration_s: simulated time at the end.
        console: console to write to; None for stderr.
        from_s: simulated time at the beginning; a replay may begin within the record.
    """

    def __init__(self, duration_s: float, console: Console | None = None, from_s: float = 0.0) -> None:
        self.console = console or PipedConsole(stderr=True)
        self._duration_s = duration_s
        self._from_s = from_s
        self._live = Live(Text("starting …"), console=self.console, refresh_per_second=5, transient=True)
        self._is_live = self.console.is_terminal
        self._next_plain_s = 0.0
        self._last_plain = ""
        self._repeated = RepeatedEvents()

    def __enter__(self) -> Self:
        if self._is_live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()
        for text in self._repeated.over(math.inf):
            self.say(text)

    def say(self, text: str) -> None:
        if self.console.quiet:
            self._live.stop()
            self.console.quiet = False
        self.console.print(printable(text), highlight=False, markup=False, soft_wrap=True)

    def hang_up(self) -> None:
        """Stop live output once the terminal has gone, without drawing, so that a signal handler may call this."""
        self._is_live = False
        self.console.quiet = True

    def clock(self, line: dict[str, Any]) -> None:
        for repeated in self._repeated.over(line["t_s"]):
            self.say(repeated)
        text = describe(line, self._duration_s, self._from_s)
        if self._is_live:
            self._live.update(cell(text))
            return
        waiting = bool(line["waiting_for"])
        if (line["t_s"] >= self._next_plain_s or waiting) and text != self._last_plain:
            self._next_plain_s = line["t_s"] + REPEATED_S
            self._last_plain = text
            self.say(text)

    def event(self, line: dict[str, Any]) -> None:
        is_coming = line["kind"] in PRESENCE and line["text"].startswith(DRIVERS)
        if line["kind"] not in QUIET or is_coming or line.get("data", {}).get("fails"):
            for text in self._repeated.lines(line["t_s"], line["kind"], line["text"]):
                self.say(text)

    def health(self, line: dict[str, Any]) -> None:
        """Do nothing: the live line has no room for health, which `zsim up` shows in a table."""


def describe(line: dict[str, Any], duration_s: float, from_s: float = 0.0) -> str:
    """Return the live line: simulated time, real-time factor, phase, and the processes waited for."""
    span_s = duration_s - from_s
    share = min(1.0, max(0.0, line["t_s"] - from_s) / span_s) if span_s > 0.0 else 0.0
    filled = int(20 * share)
    bar = "█" * filled + "░" * (20 - filled)
    text = f"{bar} {line['t_s']:7.1f} / {duration_s:g} s  × {line['rate']:.1f} real time"
    if line.get("phase"):
        text += f"  {line['phase']}"
    if line["state"] != "running":
        text += f"  {line['state']}"
    waiting = waiting_text(line["state"], msgspec.convert(line["waiting_for"], list[Waiting]))
    return f"{text}  {waiting}" if waiting else text
