"""Decides which page of the console is in control of which part of the run: a formation, or the run itself.

A page takes control of a free part by using one of its controls. Another page must request the part, and gets it when
the controlling page grants the request, is closed or is lost. Emergencies, landings and holds need no control.
"""

import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import zip_longest
from typing import Any, NamedTuple

import viser

from zsim_bridges.console.run_forms import assign

RUN = "run"  # the part with time, faults and single drones; a formation of that name shares it
EVERY = ""  # the part of controls that affect all parts
LOST_S = 10.0  # wall; a page that has not polled for so long counts as lost: its script or its machine has stopped
SILENT_SHOWN_S = 3.0  # wall; minimum silence that is shown; pages poll twice a second
HERE = ("", "127.0.0.1", "::1")  # addresses of pages on the console's machine
OPERATOR, VIEWER = "operator", "viewer"
Tell = Callable[[int, str], None]
CONTROL_STYLE = "font-size:12px;line-height:1.35;padding:2px 10px 6px;overflow-wrap:anywhere"


class Holding(NamedTuple):
    """The page that controls a part and the one that requests it (each empty for none), as seen by one page."""

    part: str
    holder: str = ""
    silent_s: float = 0.0
    asker: str = ""
    mine: bool = False
    asked_by_me: bool = False


@dataclass
class _Page:
    number: int  # counts pages in the order in which they were opened
    role: str = OPERATOR
    address: str = ""
    looked_s: float | None = None  # when it last polled [s; wall]; None before the first poll

    @property
    def name(self) -> str:
        return f"{self.role} {self.number}{f' ({self.address})' if self.address not in HERE else ''}"


class ControlDesk:
    """Records which page, by viser's number, is in control of each part; thread-safe.

    Args:
        parts: names of the formations; RUN is added.
        tell: shows a line of text on a page.
    """

    def __init__(
        self, parts: Sequence[str], tell: Tell = lambda *_: None, wall_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._lock = threading.RLock()
        self._tell = tell
        self._wall_s = wall_s
        self._pages: dict[int, _Page] = {}
        self._count = 0
        self._holders: dict[str, int] = {}
        self._askers: dict[str, int] = {}
        self.parts = tuple(dict.fromkeys((*parts, RUN)))

    def open(self, page: int) -> None:
        with self._lock:
            if page not in self._pages:
                self._count += 1
                self._pages[page] = _Page(self._count)

    def close(self, page: int) -> None:
        """Record that a page is closed, which releases its parts."""
        with self._lock:
            self._askers = {part: asker for part, asker in self._askers.items() if asker != page}
            for part in [part for part, holder in self._holders.items() if holder == page]:
                self._pass_on(part, f"{self.name_of(page)} has left and released")
            self._pages.pop(page, None)

    def look(self, page: int, role: str, address: str) -> None:
        with self._lock:
            self.open(page)
            known = self._pages[page]
            known.role, known.address, known.looked_s = role, address, self._wall_s()

    def release_lost(self) -> None:
        """Pass on requested parts of silent pages; a silent page keeps a part that no other page requests.

        A page whose socket is closed has released its parts already.
        """
        with self._lock:
            for part in list(self._askers):
                holder = self._holders[part]
                if self._silent_s(holder) > LOST_S:
                    self._pass_on(part, f"{self.name_of(holder)} was silent for {LOST_S:.0f} s and has lost")
                    self._tell(holder, f"Control of {words(part)} was given to another page: this one was silent")

    def refusal(self, page: int, part: str) -> str:
        """Return why a page may not use a control of a part; empty if it may."""
        with self._lock:
            for each in self.parts if part == EVERY else (part,):
                holder = self._holders.get(each, page)
                if holder != page:
                    return f"{self.name_of(holder)} is in control of {words(each)}; ask for it under Control"
        return ""

    def use(self, page: int, part: str) -> str:
        """Give a page control of a free part; return why it may not use the part, empty if it may."""
        with self._lock:
            refusal = self.refusal(page, part)
            if not refusal and part != EVERY and part not in self._holders:
                self.open(page)
                self._holders[part] = page
        return refusal

    def ask(self, page: int, part: str) -> None:
        with self._lock:
            holder = self._holders.get(part)
            if holder is None or holder == page:
                self.use(page, part)
                return
            self._askers[part] = page
            self._tell(holder, f"{self.name_of(page)} asks for control of {words(part)}: see Control")

    def answer(self, page: int, part: str, granted: bool) -> None:
        with self._lock:
            asker = self._askers.get(part)
            if self._holders.get(part) != page or asker is None:
                return
            del self._askers[part]
            if granted:
                self._holders[part] = asker
            done = "gives you control of" if granted else "keeps control of"
            self._tell(asker, f"{self.name_of(page)} {done} {words(part)}")

    def release(self, page: int, part: str) -> None:
        with self._lock:
            if self._holders.get(part) == page:
                self._pass_on(part, f"{self.name_of(page)} has released")

    def holdings(self, page: int, parts: Collection[str]) -> list[Holding]:
        found = []
        with self._lock:
            for part in parts:
                holder, asker = self._holders.get(part), self._askers.get(part)
                if holder is None:
                    found.append(Holding(part))
                    continue
                asking = "" if asker is None else self.name_of(asker)
                names = part, self.name_of(holder), self._silent_s(holder), asking
                found.append(Holding(*names, mine=holder == page, asked_by_me=asker == page))
        return found

    def others(self, page: int) -> list[str]:
        """Return the names of the other open pages that have polled, operators first."""
        with self._lock:
            known = [each for number, each in self._pages.items() if number != page and each.looked_s is not None]
            return [each.name for each in sorted(known, key=lambda each: (each.role == VIEWER, each.number))]

    def held_by_others(self, page: int) -> frozenset[str]:
        """Return the parts whose controls a page may not use; EVERY is one of them if there are any."""
        with self._lock:
            held = frozenset(part for part, holder in self._holders.items() if holder != page)
        return held | {EVERY} if held else held

    def name_of(self, page: int) -> str:
        known = self._pages.get(page)  # may be called without the lock, so the page may have closed
        return known.name if known else "a page"

    def _silent_s(self, page: int) -> float:
        known = self._pages.get(page)
        return 0.0 if known is None or known.looked_s is None else self._wall_s() - known.looked_s

    def _pass_on(self, part: str, why: str) -> None:
        del self._holders[part]
        asker = self._askers.pop(part, None)
        if asker is not None:
            self._holders[part] = asker
            self._tell(asker, f"{why} control of {words(part)}; it is yours now")


def words(part: str) -> str:
    return "time and faults" if part == RUN else part


class ControlForm:
    """Shows on one page (viser's number) who is in control, with buttons to request, grant and release control.

    `part_of` maps the id of each shared control, which is also the id of its element on the page, to its part.
    """

    def __init__(self, gui: viser.GuiApi, desk: ControlDesk, page: int, part_of: Mapping[str, str]) -> None:
        self._part_of = part_of
        self._desk = desk
        self._page = page
        self._parts: list[str] = []
        self._text = gui.add_html("")
        self._buttons: list[tuple[Any, Any]] = []
        for row in range(2):  # the shown formation, and the run
            first, second = gui.add_button("Ask", visible=False), gui.add_button("Keep", visible=False, color="gray")
            first.on_click(lambda _, row=row: self._press(row))
            second.on_click(lambda _, row=row: self._answer(row, granted=False))
            self._buttons.append((first, second))

    def refresh(self, parts: list[str]) -> None:
        self._parts = parts
        holdings, others = self._desk.holdings(self._page, parts), self._desk.others(self._page)
        here = f"you are {escape(self._desk.name_of(self._page))}"
        lines = [f"<b>Control</b>: {here}, alone here"]
        if others:
            lines = [f"<b>Control</b>: {here}; also here: {escape(', '.join(others))}", *map(_holding_line, holdings)]
        held = self._desk.held_by_others(self._page)
        rules = ",".join(f'[id="{control}"]' for control, part in self._part_of.items() if part in held)
        greyed = f"<style>{rules}{{opacity:.35}}</style>" if rules else ""
        assign(self._text, content=f"<div style='{CONTROL_STYLE}'>{'<br>'.join(lines)}</div>{greyed}")
        for (first, second), holding in zip_longest(self._buttons, holdings):
            label, asked = _offer(holding) if others else ("", False)
            keep = f"Keep {words(holding.part)}" if holding and asked else ""
            assign(first, label=label or first.label, visible=bool(label))
            assign(second, label=keep or second.label, visible=bool(keep))

    def _press(self, row: int) -> None:
        for holding in self._desk.holdings(self._page, self._parts[row : row + 1]):
            if not holding.mine:
                self._desk.ask(self._page, holding.part)
            elif holding.asker:
                self._answer(row, granted=True)
            else:
                self._desk.release(self._page, holding.part)
        self.refresh(self._parts)

    def _answer(self, row: int, granted: bool) -> None:
        for part in self._parts[row : row + 1]:
            self._desk.answer(self._page, part, granted)
        self.refresh(self._parts)


def _holding_line(holding: Holding) -> str:
    name = escape(words(holding.part))
    if not holding.holder:
        return f"{name}: free"
    silent = f", silent for {holding.silent_s:.0f} s" if holding.silent_s > SILENT_SHOWN_S else ""
    who = "<b>you</b>" if holding.mine else f"<b>{escape(holding.holder)}</b>{silent}"
    asked = ""
    if holding.asked_by_me:
        asked = "; you have asked for it"
    elif holding.asker:
        asked = f"; <b>{escape(holding.asker)} asks for it</b>"
    return f"{name}: {who}{asked}"


def _offer(holding: Holding | None) -> tuple[str, bool]:
    """Return the label of a part's first button (empty: hidden), and whether another page requests this page's part."""
    if holding is None or not holding.holder or holding.asked_by_me:
        return "", False
    if not holding.mine:
        return f"Ask for {words(holding.part)}", False
    if holding.asker:
        return f"Give {words(holding.part)} to {holding.asker}", True
    return f"Release {words(holding.part)}", False
