"""Decides which page of the console is in control of which part of the run: a formation, or the run itself.

A page takes control of a free part by using one of its controls. Another page must request the part, and gets it when
the controlling page grants the request, releases the part, is closed or is lost. Emergency stops, landings and holds
need no control.
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
ALL_PARTS = ""  # the part of controls that affect all parts
LOST_S = 10.0  # wall; a page that has not polled for so long is considered lost: its script or its machine has stopped
SILENT_SHOWN_S = 3.0  # wall; minimum silence that is shown; pages poll twice a second
LOCAL_ADDRESSES = ("", "127.0.0.1", "::1")  # addresses of pages on the console's machine
OPERATOR, VIEWER = "operator", "viewer"
Notify = Callable[[int, str], None]
CONTROL_STYLE = "font-size:12px;line-height:1.35;padding:2px 10px 6px;overflow-wrap:anywhere"


class Holding(NamedTuple):
    """The page that controls a part and the one that requests it (empty if there is none), as seen by one page."""

    part: str
    holder: str = ""
    silent_s: float = 0.0
    requester: str = ""
    is_mine: bool = False
    is_requested_by_me: bool = False


@dataclass
class _Page:
    number: int  # counts pages in the order in which they were opened
    role: str = OPERATOR
    address: str = ""
    polled_s: float | None = None  # when it last polled [s; wall]; None before the first poll

    @property
    def name(self) -> str:
        return f"{self.role} {self.number}{f' ({self.address})' if self.address not in LOCAL_ADDRESSES else ''}"


class ControlDesk:
    """Records which page, by viser's number, is in control of each part; thread-safe.

    Args:
        parts: names of the formations; RUN is added.
        notify: shows a line of text on a page.
    """

    def __init__(
        self, parts: Sequence[str], notify: Notify = lambda *_: None, wall_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._lock = threading.RLock()
        self._notify = notify
        self._wall_s = wall_s
        self._pages: dict[int, _Page] = {}
        self._count = 0
        self._holders: dict[str, int] = {}
        self._requesters: dict[str, int] = {}
        self.parts = tuple(dict.fromkeys((*parts, RUN)))

    def open(self, page: int) -> None:
        with self._lock:
            if page not in self._pages:
                self._count += 1
                self._pages[page] = _Page(self._count)

    def close(self, page: int) -> None:
        """Record that a page is closed, which releases its parts."""
        with self._lock:
            self._requesters = {part: requester for part, requester in self._requesters.items() if requester != page}
            for part in [part for part, holder in self._holders.items() if holder == page]:
                self._pass_on(part, f"{self.name_of(page)} has left and released")
            self._pages.pop(page, None)

    def record_poll(self, page: int, role: str, address: str) -> None:
        with self._lock:
            self.open(page)
            entry = self._pages[page]
            entry.role, entry.address, entry.polled_s = role, address, self._wall_s()

    def release_lost(self) -> None:
        """Pass on requested parts of silent pages; a silent page keeps a part that no other page requests.

        A page whose socket is closed has released its parts already.
        """
        with self._lock:
            for part in list(self._requesters):
                holder = self._holders[part]
                if self._silent_s(holder) > LOST_S:
                    self._pass_on(part, f"{self.name_of(holder)} was silent for {LOST_S:.0f} s and has lost")
                    self._notify(
                        holder, f"Control of {part_label(part)} was given to another page: this one was silent"
                    )

    def refusal(self, page: int, part: str, drone: str = "") -> str:
        """Return why a page may not use a control of a part, or of a drone that belongs to it; empty if it may."""
        held_with_it = f", hence of {drone}" if drone else ""
        with self._lock:
            for each in self.parts if part == ALL_PARTS else (part,):
                holder = self._holders.get(each, page)
                if holder != page:
                    label = f"{part_label(each)}{held_with_it}"
                    return f"{self.name_of(holder)} is in control of {label}; ask for it under Control"
        return ""

    def use(self, page: int, part: str, drone: str = "") -> str:
        """Give a page control of a free part; return why it may not use the part, empty if it may; see `refusal`."""
        with self._lock:
            refusal = self.refusal(page, part, drone)
            if not refusal and part != ALL_PARTS and part not in self._holders:
                self.open(page)
                self._holders[part] = page
        return refusal

    def request(self, page: int, part: str) -> None:
        with self._lock:
            holder = self._holders.get(part)
            if holder is None or holder == page:
                self.use(page, part)
                return
            self._requesters[part] = page
            self._notify(holder, f"{self.name_of(page)} asks for control of {part_label(part)}: see Control")

    def answer(self, page: int, part: str, granted: bool) -> None:
        with self._lock:
            requester = self._requesters.get(part)
            if self._holders.get(part) != page or requester is None:
                return
            del self._requesters[part]
            if granted:
                self._holders[part] = requester
            decision = "gives you control of" if granted else "keeps control of"
            self._notify(requester, f"{self.name_of(page)} {decision} {part_label(part)}")

    def release(self, page: int, part: str) -> None:
        with self._lock:
            if self._holders.get(part) == page:
                self._pass_on(part, f"{self.name_of(page)} has released")

    def holdings(self, page: int, parts: Collection[str]) -> list[Holding]:
        holdings = []
        with self._lock:
            for part in parts:
                holder, requester = self._holders.get(part), self._requesters.get(part)
                if holder is None:
                    holdings.append(Holding(part))
                    continue
                requester_name = "" if requester is None else self.name_of(requester)
                names = part, self.name_of(holder), self._silent_s(holder), requester_name
                holdings.append(Holding(*names, is_mine=holder == page, is_requested_by_me=requester == page))
        return holdings

    def others(self, page: int) -> list[str]:
        """Return the names of the other open pages that have polled, operators first."""
        with self._lock:
            polling = [each for number, each in self._pages.items() if number != page and each.polled_s is not None]
            return [each.name for each in sorted(polling, key=lambda each: (each.role == VIEWER, each.number))]

    def held_by_others(self, page: int) -> frozenset[str]:
        """Return the parts whose controls a page may not use; ALL_PARTS is one of them if there are any."""
        with self._lock:
            held = frozenset(part for part, holder in self._holders.items() if holder != page)
        return held | {ALL_PARTS} if held else held

    def name_of(self, page: int) -> str:
        entry = self._pages.get(page)  # may be called without the lock, so the page may have closed
        return entry.name if entry else "a page"

    def _silent_s(self, page: int) -> float:
        entry = self._pages.get(page)
        return 0.0 if entry is None or entry.polled_s is None else self._wall_s() - entry.polled_s

    def _pass_on(self, part: str, reason: str) -> None:
        del self._holders[part]
        requester = self._requesters.pop(part, None)
        if requester is not None:
            self._holders[part] = requester
            self._notify(requester, f"{reason} control of {part_label(part)}; it is yours now")


def part_label(part: str) -> str:
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
        identity = f"you are {escape(self._desk.name_of(self._page))}"
        lines = [f"<b>Control</b>: {identity}, alone here"]
        if others:
            lines = [
                f"<b>Control</b>: {identity}; also here: {escape(', '.join(others))}",
                *map(_holding_line, holdings),
            ]
        held = self._desk.held_by_others(self._page)
        rules = ",".join(f'[id="{control}"]' for control, part in self._part_of.items() if part in held)
        greyed = f"<style>{rules}{{opacity:.35}}</style>" if rules else ""
        assign(self._text, content=f"<div style='{CONTROL_STYLE}'>{'<br>'.join(lines)}</div>{greyed}")
        for (first, second), holding in zip_longest(self._buttons, holdings):
            label, is_requested = _offer(holding) if others else ("", False)
            keep = f"Keep {part_label(holding.part)}" if holding and is_requested else ""
            assign(first, label=label or first.label, visible=bool(label))
            assign(second, label=keep or second.label, visible=bool(keep))

    def _press(self, row: int) -> None:
        for holding in self._desk.holdings(self._page, self._parts[row : row + 1]):
            if not holding.is_mine:
                self._desk.request(self._page, holding.part)
            elif holding.requester:
                self._answer(row, granted=True)
            else:
                self._desk.release(self._page, holding.part)
        self.refresh(self._parts)

    def _answer(self, row: int, granted: bool) -> None:
        for part in self._parts[row : row + 1]:
            self._desk.answer(self._page, part, granted)
        self.refresh(self._parts)


def _holding_line(holding: Holding) -> str:
    name = escape(part_label(holding.part))
    if not holding.holder:
        return f"{name}: free"
    silent = f", silent for {holding.silent_s:.0f} s" if holding.silent_s > SILENT_SHOWN_S else ""
    holder = "<b>you</b>" if holding.is_mine else f"<b>{escape(holding.holder)}</b>{silent}"
    request = ""
    if holding.is_requested_by_me:
        request = "; you have asked for it"
    elif holding.requester:
        request = f"; <b>{escape(holding.requester)} asks for it</b>"
    return f"{name}: {holder}{request}"


def _offer(holding: Holding | None) -> tuple[str, bool]:
    """Return the label of a part's first button (empty: hidden), and whether another page requests this page's part."""
    if holding is None or not holding.holder or holding.is_requested_by_me:
        return "", False
    if not holding.is_mine:
        return f"Ask for {part_label(holding.part)}", False
    if holding.requester:
        return f"Give {part_label(holding.part)} to {holding.requester}", True
    return f"Release {part_label(holding.part)}", False
