"""Looking at a running federation, as users of `ros2 topic` expect."""

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from zsim.contract import keys, messages
from zsim.errors import DecodeError
from zsim.transport.session import Mailbox, Sample, Session, check_expression

LISTEN_S = 1.0  # wall time that `keys` listens: every key of the contract that lives speaks at least once a second
PACKET_S = 0.05  # wait between two looks into an empty mailbox
LINE_S = 1.0  # between two lines of `hz`
SILENCE_S = 1.0  # from which on a key that spoke is said to be silent; later where its own gaps are longer


def list_keys(link: Session, listen_s: float = LISTEN_S) -> list[tuple[str, str, int]]:
    """Return (key, message, messages heard) of everything that speaks or answers within `listen_s`."""
    heard: Counter[str] = Counter()
    for expression in (keys.INFO, keys.CLOCK, "drone/*/truth", "drone/*/estimate", "cluster/*/state"):
        heard.update({sample.key: 0 for sample in link.get(expression)})
    box = link.subscribe("**")
    for sample in _samples(box, time.monotonic() + listen_s):
        heard[sample.key] += 1
    return [(key, _kind(key), count) for key, count in sorted(heard.items())]


def echo(link: Session, expression: str, count: int | None, emit: Callable[[str, Any], None], raw: bool) -> None:
    """Hand every message on an expression to `emit` until `count` have come."""
    box = link.subscribe(expression)
    for number, sample in enumerate(_samples(box, math.inf), start=1):
        emit(sample.key, sample.payload.hex() if raw else readable(sample))
        if number == count:
            return


def readable(sample: Sample) -> Any:
    """Return a message as JSON can say it; what is not of the contract is decoded as far as it goes."""
    try:
        return _plain(messages.decode(sample.key, sample.payload))
    except DecodeError as error:
        try:
            return _plain(msgspec.msgpack.decode(sample.payload))
        except messages.REFUSALS:
            return {"refused": str(error), "bytes": len(sample.payload)}


def _plain(value: Any) -> Any:
    """Return a value as JSON can say it: bytes in base64, in Python's words what it has no form for."""
    try:
        return msgspec.to_builtins(value, str_keys=True, enc_hook=repr)
    except messages.REFUSALS:  # a key that is neither text nor a number, say
        return repr(value)


class Rate:
    """How often messages come, in wall and in simulated time, over a window of messages."""

    def __init__(self, window: int) -> None:
        self._walls: deque[float] = deque(maxlen=window)
        self._stamps: deque[int] = deque(maxlen=window)
        self.total = 0

    def add(self, wall_s: float, t_ns: int | None) -> None:
        self.total += 1
        self._walls.append(wall_s)
        if t_ns is not None:
            self._stamps.append(t_ns)

    def line(self, now_s: float) -> str:
        """Return the rates in words, or since when nothing comes."""
        gaps = [b - a for a, b in zip(self._walls, list(self._walls)[1:], strict=False)]
        silent_s = now_s - self._walls[-1]
        if silent_s > max(SILENCE_S, 2 * max(gaps, default=0.0)):
            return f"nothing for {silent_s:.1f} s, {self.total} messages before"
        if not gaps:
            return f"{self.total} message"
        wall_hz = len(gaps) / max(1e-9, sum(gaps))
        text = f"{wall_hz:.1f} Hz wall (gap {1e3 * min(gaps):.1f} to {1e3 * max(gaps):.1f} ms)"
        span_ns = self._stamps[-1] - self._stamps[0] if len(self._stamps) > 1 else 0
        if span_ns > 0:
            text += f", {1e9 * (len(self._stamps) - 1) / span_ns:.1f} Hz simulated"
        return f"{text}, {self.total} messages"


def hz(link: Session, expression: str, window: int, seconds: float, emit: Callable[[str], None]) -> None:
    """Tell once a second, and at the end, how often messages come on an expression.

    Raises:
        SessionError: it is no key expression.
    """
    check_expression(expression)
    arrived: deque[tuple[float, bytes]] = deque()

    def arrive(sample: Sample) -> None:  # in Zenoh's thread, so that a gap is one between messages
        if sample.payload:  # empty: a deletion
            arrived.append((time.monotonic(), sample.payload))

    link.on_message(expression, arrive)
    rate, head = Rate(window), msgspec.msgpack.Decoder(_Stamp)
    until_s = time.monotonic() + seconds
    while (now_s := time.monotonic()) < until_s:
        time.sleep(min(LINE_S, until_s - now_s))
        for _ in range(len(arrived)):
            wall_s, payload = arrived.popleft()
            rate.add(wall_s, _stamp(head, payload))
        nothing = f"no message on {expression} yet; `zsim keys` lists what speaks"
        emit(rate.line(time.monotonic()) if rate.total else nothing)


class _Stamp(msgspec.Struct):
    t_ns: int | None = None


def _stamp(head: "msgspec.msgpack.Decoder[_Stamp]", payload: bytes) -> int | None:
    try:
        return head.decode(payload).t_ns
    except messages.REFUSALS:
        return None


def _kind(key: str) -> str:
    kind = messages.type_of(key)
    return kind.__name__ if kind else "not of the contract"


def _samples(box: Mailbox, until_s: float) -> Iterator[Sample]:
    """Yield what arrives until a wall time; wakes to look at the clock and to let Ctrl-C in."""
    while time.monotonic() < until_s:
        arrived = False
        for sample in box.drain():
            arrived = True
            yield sample
            if time.monotonic() >= until_s:
                return
        if not arrived:
            time.sleep(min(PACKET_S, max(0.0, until_s - time.monotonic())))
