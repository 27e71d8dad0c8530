"""Looking at and poking a running federation, as users of `ros2 topic` expect."""

import json
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from zsim import keys, messages
from zsim.errors import DecodeError, RunError
from zsim.session import Mailbox, Sample, Session

LISTEN_S = 1.0  # wall time that `keys` listens: every key of the contract that lives speaks at least once a second
PACKET_S = 0.05  # wait between two looks into an empty mailbox
CLIENT = "zsim.pub"


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
    """Return a message as plain data; what is not of the contract is decoded as far as it goes."""
    try:
        return msgspec.to_builtins(messages.decode(sample.key, sample.payload))
    except DecodeError as error:
        try:
            return msgspec.msgpack.decode(sample.payload)
        except (msgspec.MsgspecError, UnicodeDecodeError):
            return {"refused": str(error), "bytes": len(sample.payload)}


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

    def line(self) -> str:
        """Return the rates in words."""
        if len(self._walls) < 2:
            return f"{self.total} messages"
        gaps = [b - a for a, b in zip(self._walls, list(self._walls)[1:], strict=False)]
        wall_hz = len(gaps) / max(1e-9, sum(gaps))
        text = f"{wall_hz:.1f} Hz wall (gap {1e3 * min(gaps):.1f} to {1e3 * max(gaps):.1f} ms)"
        span_ns = self._stamps[-1] - self._stamps[0] if len(self._stamps) > 1 else 0
        if span_ns > 0:
            text += f", {1e9 * (len(self._stamps) - 1) / span_ns:.1f} Hz simulated"
        return f"{text}, {self.total} messages"


def hz(link: Session, expression: str, window: int, until_s: float, emit: Callable[[str], None]) -> None:
    """Tell once a second how often messages come on an expression."""
    box, rate, next_s = link.subscribe(expression), Rate(window), time.monotonic() + 1.0
    head = msgspec.msgpack.Decoder(_Stamp)
    while time.monotonic() < until_s:
        for sample in _samples(box, min(next_s, until_s)):
            rate.add(time.monotonic(), _stamp(head, sample.payload))
        if time.monotonic() >= next_s:
            next_s += 1.0
            emit(rate.line() if rate.total else f"no message on {expression} yet; `zsim keys` lists what speaks")
            if time.monotonic() > next_s:
                next_s = time.monotonic() + 1.0


class _Stamp(msgspec.Struct):
    t_ns: int | None = None


def _stamp(head: "msgspec.msgpack.Decoder[_Stamp]", payload: bytes) -> int | None:
    try:
        return head.decode(payload).t_ns
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return None


def publish(link: Session, key: str, text: str, count: int, rate_hz: float) -> int:
    """Publish a JSON text as the message of its key, `count` times; t_ns, seq and source are filled in.

    Raises:
        RunError: no JSON, or not the message of that key.
    """
    fields = _fields(key, text)
    for seq in range(count):
        stamped = {"t_ns": _now_ns(link), "seq": seq, **fields}
        payload = msgspec.msgpack.encode(stamped)
        try:
            messages.decode(key, payload)
        except DecodeError as error:
            raise RunError(str(error)) from error
        link.put_raw(key, payload)
        if seq + 1 < count:
            time.sleep(1.0 / rate_hz)
    return count


def _fields(key: str, text: str) -> dict[str, Any]:
    kind = messages.type_of(key)
    if kind is None:
        raise RunError(f"{key}: is no key of the contract; `zsim keys` lists what speaks, docs/protocol.md all of them")
    try:
        fields = json.loads(text)
    except ValueError as error:
        raise RunError(f"{key}: the message is no JSON ({error}); must be a map such as '{_example(kind)}'") from error
    if not isinstance(fields, dict):
        raise RunError(f"{key}: the message is {text[:40]!r}; must be a map such as '{_example(kind)}'")
    return {"source": CLIENT, **fields} if "source" in kind.__struct_fields__ else fields


def _example(kind: type[msgspec.Struct]) -> str:
    names = [name for name in messages.fields(kind) if name not in ("t_ns", "seq", "source")]
    return "{" + ", ".join(f'"{name}": …' for name in names) + "}"


def _now_ns(link: Session) -> int:
    """Return the simulated time, 0 where no world answers."""
    for sample in link.get(keys.CLOCK):
        return messages.decode(keys.CLOCK, sample.payload).t_ns
    return 0


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
        if not arrived:
            time.sleep(min(PACKET_S, max(0.0, until_s - time.monotonic())))


def report_path(directory: Path) -> Path:
    """Return the record in a run's folder.

    Raises:
        RunError: there is none.
    """
    path = directory / "run.mcap"
    if not path.is_file():
        raise RunError(f"{directory}: holds no run.mcap; give the folder of a run, as `zsim run` printed it")
    return path
