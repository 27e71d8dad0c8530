"""A running federation inspected as users of `ros2 topic` expect, and messages and requests sent to it by hand."""

import json
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import msgspec

from zsim.contract import keys, messages
from zsim.contract.framing import pairs_of
from zsim.errors import DecodeError, RunError
from zsim.transport.session import RawSample, ReceivedSample, Session, Subscription, check_expression

LISTEN_S = 1.0  # wall time that `keys` listens: every live key of the contract has a message at least once a second
PACKET_S = 0.05  # wait between two looks into an empty subscription
LINE_S = 1.0  # between two lines of `hz`
SILENCE_S = 1.0  # after which a key with messages is reported as silent; later where its own gaps are longer
PUB, ASK = "zsim.pub", "zsim.ask"
COMMANDS = "drone/*/cmd/*"


def list_keys(link: Session, expression: str, listen_s: float = LISTEN_S) -> list[tuple[str, str, int]]:
    """Return (key, message, messages received) of every key with a message or an answer within `listen_s`.

    Raises:
        SessionError: the expression of the keys that are wanted is none.
    """
    check_expression(expression)
    counts: Counter[str] = Counter()
    for known in (keys.INFO, keys.CLOCK, "drone/*/truth", "drone/*/estimate", "cluster/*/state"):
        counts.update({sample.key: 0 for sample in link.get(known) if keys.matches(expression, sample.key)})
    subscription = link.subscribe(expression)
    for sample in _samples(subscription, time.monotonic() + listen_s):
        counts[sample.key] += 1
    return [(key, _kind(key), count) for key, count in sorted(counts.items())]


def echo(link: Session, expression: str, count: int | None, emit: Callable[[str, Any], None], raw: bool) -> None:
    """Hand every message on an expression to `emit` until `count` have come."""
    subscription = link.subscribe(expression)
    for number, sample in enumerate(_samples(subscription, math.inf), start=1):
        emit(sample.key, sample.payload.hex() if raw else readable(sample))
        if number == count:
            return


def readable(sample: ReceivedSample) -> Any:
    """Return a message as values that JSON has; one outside of the contract is decoded as far as possible."""
    try:
        return _plain(messages.decode(sample.key, sample.payload))
    except DecodeError as error:
        try:
            return _plain(msgspec.msgpack.decode(sample.payload))
        except messages.REFUSALS:
            return {"refused": str(error), "bytes": len(sample.payload)}


def _plain(value: Any) -> Any:
    """Return a value as JSON can hold it: bytes in base64, as its repr what JSON has no form for."""
    try:
        return msgspec.to_builtins(value, str_keys=True, enc_hook=repr)
    except messages.REFUSALS:  # for instance a key that is neither text nor a number
        return repr(value)


class MessageRate:
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
        """Return the rates as text, or since when nothing comes."""
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
    """Show once a second, and at the end, how often messages come on an expression.

    Raises:
        SessionError: it is no key expression.
    """
    check_expression(expression)
    arrived: deque[tuple[float, bytes]] = deque()

    def arrive(sample: RawSample) -> None:  # in Zenoh's thread, so that a gap is one between messages
        if sample.payload:  # empty: a deletion
            arrived.append((time.monotonic(), sample.payload))

    link.declare_subscriber(expression, arrive)
    rate, head = MessageRate(window), msgspec.msgpack.Decoder(_Stamp)
    until_s = time.monotonic() + seconds
    while (now_s := time.monotonic()) < until_s:
        time.sleep(min(LINE_S, until_s - now_s))
        for _ in range(len(arrived)):
            wall_s, payload = arrived.popleft()
            rate.add(wall_s, _stamp(head, payload))
        nothing = f"no message on {expression} yet; `zsim keys` lists the keys in use"
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


def _samples(subscription: Subscription, until_s: float) -> Iterator[ReceivedSample]:
    """Yield what arrives until a wall time; wakes to look at the clock and to let Ctrl-C in."""
    while time.monotonic() < until_s:
        arrived = False
        for sample in subscription.drain():
            arrived = True
            yield sample
            if time.monotonic() >= until_s:
                return
        if not arrived:
            time.sleep(min(PACKET_S, max(0.0, until_s - time.monotonic())))


def publish(link: Session, info: messages.Info, key: str, text: str, count: int, rate_hz: float) -> int:
    """Publish a JSON text as the command of its key, `count` times; t_ns, seq and source are filled in.

    Args:
        link: an open session.
        info: of the run.
        key: `drone/NAME/cmd/KIND` of a drone of the run.
        text: a JSON map of the message's fields.
        count: how many times, the first at once.
        rate_hz: how often per wall second.

    Raises:
        RunError: no JSON, not the message of that key, or a key on which nobody sends by hand.
    """
    fields = _fields(_command_key(key, info), text)
    clock, start_s = _Now(link), time.monotonic()
    for seq in range(count):
        time.sleep(max(0.0, start_s + seq / rate_hz - time.monotonic()))
        link.put_raw(key, _payload(key, {"t_ns": clock.t_ns(), "seq": seq, **fields}))
    return count


class _Now:
    """The simulated time, as a sender that takes part in nothing knows it."""

    def __init__(self, link: Session) -> None:
        self._subscription = link.subscribe(keys.CLOCK)
        self._newest = next(iter(link.get(keys.CLOCK)), None)

    def t_ns(self) -> int:
        """Return the time of the newest clock, 0 where no world answers."""
        for sample in self._subscription.drain():
            self._newest = sample
        return messages.decode(keys.CLOCK, self._newest.payload).t_ns if self._newest else 0


def _command_key(key: str, info: messages.Info) -> str:
    """Return the key if a command of a drone may be sent there."""
    _refuse_wildcards(key, "pub")
    kind = messages.type_of(key)
    if kind is None:
        raise RunError(f"{key}: is no key of the contract; `zsim keys` lists those in use, docs/protocol.md all")
    if not keys.matches(COMMANDS, key):
        raise RunError(f"{key}: only the process that this is about writes here; must be {COMMANDS.replace('*', '…')}")
    drones = [drone.name for drone in info.drones]
    if keys.thing(key) not in drones:
        raise RunError(f"{key}: drone is {keys.thing(key)!r}; must be one of {', '.join(drones)}")
    return key


def _refuse_wildcards(key: str, command: str) -> None:
    if "*" in key:
        raise RunError(f"key is {key!r}; `zsim {command}` takes one key, without wildcards")


def _fields(key: str, text: str) -> dict[str, Any]:
    kind = messages.type_of(key)
    assert kind is not None
    fields = _map(f"{key}: the message", text, _example(kind))
    return {"source": PUB, **fields} if "source" in kind.__struct_fields__ else fields


def _map(what: str, text: str, example: str) -> dict[str, Any]:
    """Return the map that a JSON text holds; `what` opens the line of a fault."""
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RunError(f"{what} is no JSON ({error}); must be a map such as '{example}'") from error
    if not isinstance(fields, dict):
        raise RunError(f"{what} is {text[:40]!r}; must be a map such as '{example}'")
    try:
        msgspec.msgpack.encode(fields)
    except messages.REFUSALS as error:
        raise RunError(f"{what} cannot be sent ({error}); must be a map such as '{example}'") from error
    return fields


def _payload(key: str, fields: dict[str, Any]) -> bytes:
    payload = msgspec.msgpack.encode(fields)
    try:
        messages.decode(key, payload)
    except DecodeError as error:
        raise RunError(str(error)) from error
    return payload


def _example(kind: type[msgspec.Struct]) -> str:
    names = [name for name in messages.fields(kind) if name not in ("t_ns", "seq", "source")]
    return "{" + ", ".join(f'"{name}": …' for name in names) + "}"


def ask(link: Session, key: str, op: str, text: str) -> Any:
    """Send a request with the arguments in a JSON text; return its result as JSON can hold it.

    Raises:
        RunError: no JSON, nobody answers, or the answer is a refusal.
    """
    _refuse_wildcards(key, "ask")
    answer = link.request(key, op, ASK, _map(f"{op}: args", text, '{"gates": 50}'))
    if not answer.ok:
        raise RunError(answer.error)
    with suppress(DecodeError):  # a replay is the only result that holds messages
        pairs = pairs_of(answer.result)
        return [{"key": key, "message": readable(ReceivedSample(key, payload))} for key, payload in pairs]
    return msgspec.to_builtins(answer.result, str_keys=True)
