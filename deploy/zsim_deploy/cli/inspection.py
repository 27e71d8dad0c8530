"""Inspection of a running federation, as with `ros2 topic`, and messages and requests sent to it by hand."""

import json
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from difflib import get_close_matches
from typing import Any, NamedTuple

import msgspec

from zsim.contract import keys, messages, run_messages
from zsim.contract.framing import pairs_of
from zsim.errors import DecodeError, RunError
from zsim.transport.session import RawSample, ReceivedSample, Session, Subscription, check_expression, result_of

LISTEN_S = 1.0  # how long `keys` listens, wall time; every live key of the contract has at least one message a second
POLL_S = 0.05  # polling interval of a subscription, wall time
LINE_S = 1.0  # interval between lines of `hz`, wall time
SILENCE_S = 1.0  # wall time without a message after which `hz` reports silence; twice the longest gap if that is longer
UNHEARD_S = 3.0  # wall time after which a key without any message is reported; live keys have at least one a second
NAMED_MAX = 5  # maximum number of similar keys suggested for a key without a publisher
OUTCOME_S = 3.0  # wall time for the world to report the outcome of a command; a slow or paused world takes longer
UNKNOWN_SENDER = "somebody"  # source in the world's event about a message that it could not decode
PUB, ASK = "zsim.pub", "zsim.ask"
COMMANDS = "drone/*/cmd/*"


def list_keys(link: Session, expression: str) -> list[tuple[str, str, int]]:
    """Return (key, message type, number of messages) for every key with a message or an answer within LISTEN_S."""
    check_expression(expression)
    counts: Counter[str] = Counter()
    for pattern in (keys.INFO, keys.CLOCK, "drone/*/truth", "drone/*/estimate", "cluster/*/state"):
        counts.update({sample.key: 0 for sample in link.get(pattern) if keys.matches(expression, sample.key)})
    for sample in _samples(link.subscribe(expression), time.monotonic() + LISTEN_S):
        counts[sample.key] += 1
    kinds = {key: messages.type_of(key) for key in counts}
    names = {key: kind.__name__ if kind else "not in the contract" for key, kind in kinds.items()}
    return [(key, names[key], count) for key, count in sorted(counts.items())]


def echo(
    link: Session,
    expression: str,
    count: int | None,
    emit: Callable[[str, Any], None],
    raw: bool,
    timeout_s: float = math.inf,
    note: Callable[[str], None] = lambda text: None,
) -> int:
    """Pass the messages on a key expression to `emit` until `count` or the timeout is reached; return their number.

    `emit` takes the key and the message, or, if `raw`, the payload in hexadecimal digits; `note` takes notices for the
    user.
    """
    subscription = link.subscribe(expression)
    until_s, number = time.monotonic() + timeout_s, 0
    unheard_s = time.monotonic() + min(UNHEARD_S, timeout_s)
    while True:
        for sample in _samples(subscription, until_s if number else unheard_s):
            number += 1
            emit(sample.key, sample.payload.hex() if raw else readable(sample))
            if number == count:
                return number
        if time.monotonic() >= until_s:
            return number
        if not number:
            note(f"no message on {expression} for {UNHEARD_S:g} s{keys_like(link, expression)}")
        unheard_s = until_s


def keys_like(link: Session, expression: str) -> str:
    """Return the end of a message about a key without a publisher: similar keys in use, or how to list those in use."""
    in_use = [key for key, _, _ in list_keys(link, "**")]
    names = ", ".join(get_close_matches(expression, in_use, NAMED_MAX))
    return f"; similar keys in use: {names}" if names else "; `zsim keys` lists the keys in use"


def readable(sample: ReceivedSample) -> Any:
    """Return a message as JSON values; if it cannot be decoded, its MessagePack value, or else why it is refused."""
    try:
        return _plain(messages.decode(sample.key, sample.payload))
    except DecodeError as error:
        try:
            return _plain(msgspec.msgpack.decode(sample.payload))
        except messages.REFUSALS:
            return {"refused": str(error), "bytes": len(sample.payload)}


def _plain(value: Any) -> Any:
    """Convert a value to JSON values: bytes to base64, and values that JSON cannot represent to their repr."""
    try:
        return msgspec.to_builtins(value, str_keys=True, enc_hook=repr)
    except messages.REFUSALS:  # for instance a key that is neither text nor a number
        return repr(value)


class MessageRate:
    """The message rate over a window of messages, in wall time and in simulated time."""

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
        gaps = [b - a for a, b in zip(self._walls, list(self._walls)[1:], strict=False)]
        silent_s = now_s - self._walls[-1]
        if silent_s > max(SILENCE_S, 2 * max(gaps, default=0.0)):
            return f"no messages for {silent_s:.1f} s, {self.total} messages before"
        if not gaps:
            return f"{self.total} message"
        wall_hz = len(gaps) / max(1e-9, sum(gaps))
        text = f"{wall_hz:.1f} Hz wall (gap {1e3 * min(gaps):.1f} to {1e3 * max(gaps):.1f} ms)"
        span_ns = self._stamps[-1] - self._stamps[0] if len(self._stamps) > 1 else 0
        if span_ns > 0:
            text += f", {1e9 * (len(self._stamps) - 1) / span_ns:.1f} Hz simulated"
        return f"{text}, {self.total} messages"


def hz(link: Session, expression: str, window: int, seconds: float, emit: Callable[[str], None]) -> int:
    """Pass a line about the message rate to `emit`, once a second and at the end; return the number of messages.

    `seconds`: duration, wall time; `window`: see `MessageRate`.
    """
    check_expression(expression)
    arrived: deque[tuple[float, bytes]] = deque()

    def arrive(sample: RawSample) -> None:  # called in Zenoh's thread, so that the times are those of arrival
        if sample.payload:  # an empty payload is a deletion
            arrived.append((time.monotonic(), sample.payload))

    link.declare_subscriber(expression, arrive)
    rate, stamp_decoder = MessageRate(window), msgspec.msgpack.Decoder(_Stamp)
    until_s, unheard_s = time.monotonic() + seconds, time.monotonic() + min(UNHEARD_S, seconds)
    nothing = f"no message on {expression} yet"
    while (now_s := time.monotonic()) < until_s:
        time.sleep(min(LINE_S, until_s - now_s))
        for _ in range(len(arrived)):
            wall_s, payload = arrived.popleft()
            t_ns = None
            with suppress(*messages.REFUSALS):
                t_ns = stamp_decoder.decode(payload).t_ns
            rate.add(wall_s, t_ns)
        if not rate.total and time.monotonic() >= unheard_s:
            nothing, unheard_s = f"no message on {expression} yet{keys_like(link, expression)}", math.inf
        emit(rate.line(time.monotonic()) if rate.total else nothing)
    return rate.total


class _Stamp(msgspec.Struct):
    t_ns: int | None = None


def _samples(subscription: Subscription, until_s: float) -> Iterator[ReceivedSample]:
    """Yield samples until a monotonic time [s]; poll, so that Ctrl-C is handled."""
    while time.monotonic() < until_s:
        arrived = False
        for sample in subscription.drain():
            arrived = True
            yield sample
            if time.monotonic() >= until_s:
                return
        if not arrived:
            time.sleep(min(POLL_S, max(0.0, until_s - time.monotonic())))


class Published(NamedTuple):
    """The outcome of commands sent by hand."""

    sent: int
    refused: int = 0  # number of commands that the world refused, according to its events
    reason: str = ""  # reason of the first refusal
    note: str = ""  # why the outcome is unknown; empty if it is known


def publish(link: Session, info: messages.Info, key: str, text: str, count: int, rate_hz: float) -> Published:
    """Publish a JSON text as a command `count` times, and wait for the outcome.

    t_ns, seq and source are filled in. Raise RunError if the text is not a message of the key, or the key is not that
    of a command to a drone of the run.
    """
    _refuse_wildcards(key, "pub")
    kind = messages.type_of(key)
    if kind is None:
        raise RunError(
            f"{key}: is not a key of the contract; `zsim keys` lists those in use, docs/protocol.md all of them"
        )
    if not keys.matches(COMMANDS, key):
        raise RunError(f"{key}: is written only by its own process; must be {COMMANDS.replace('*', '…')}")
    drones = [drone.name for drone in info.drones]
    if keys.thing(key) not in drones:
        raise RunError(f"{key}: drone is {keys.thing(key)!r}; must be one of {', '.join(drones)}")
    field_names = [name for name in messages.fields(kind) if name not in ("t_ns", "seq", "source")]
    example = "{" + ", ".join(f'"{name}": …' for name in field_names) + "}"
    fields = _map(f"{key}: the message", text, example)
    if "source" in kind.__struct_fields__:
        fields = {"source": PUB, **fields}
    events, clock, start_s = link.subscribe(keys.EVENT), _SimulatedTime(link), time.monotonic()
    for seq in range(count):
        time.sleep(max(0.0, start_s + seq / rate_hz - time.monotonic()))
        payload = msgspec.msgpack.encode({"t_ns": clock.t_ns(), "seq": seq, **fields})
        try:
            messages.decode(key, payload)
        except DecodeError as error:
            raise RunError(str(error)) from error
        link.put_raw(key, payload)
    return _outcome(events, clock, info.gate_ns, (key, str(fields.get("source", PUB))), count)


def _outcome(
    events: Subscription, clock: "_SimulatedTime", gate_ns: int, command_origin: tuple[str, str], sent: int
) -> Published:
    """Return the outcome of commands from the world's events, once the last one has taken effect or been refused."""
    key, source = command_origin
    accepted, refused, last_ns, reason = 0, 0, 0, ""
    until_s = time.monotonic() + OUTCOME_S
    while True:
        now_ns = clock.t_ns()  # read before the events: refusals at a gate are published before its clock
        for sample in events.drain():
            with suppress(DecodeError):
                event: run_messages.Event = messages.decode(keys.EVENT, sample.payload)
                command = str(event.data.get("command"))
                if event.kind == "refused" and event.subject == key and event.source in (source, UNKNOWN_SENDER):
                    refused, reason = refused + 1, reason or event.text
                elif (event.kind, event.source) == ("command", source) and key == keys.command(event.subject, command):
                    accepted += 1
                    last_ns = max(last_ns, int(event.data.get("apply_t_ns", 0)) + gate_ns)
        if refused >= sent or (accepted + refused >= sent and now_ns >= last_ns):
            return Published(sent, min(refused, sent), reason)
        if time.monotonic() >= until_s:
            latest = clock.clock()
            state = latest.state if latest else "unknown"
            note = f"the outcome is not known after {OUTCOME_S:g} s; the state of the world is {state}"
            if state in ("waiting", "paused"):
                note = f"the world is {state}; the outcome will be known only when time continues"
            return Published(sent, min(refused, sent), reason, note)
        time.sleep(POLL_S)


class _SimulatedTime:
    """The simulated time, from the published clock."""

    def __init__(self, link: Session) -> None:
        self._subscription = link.subscribe(keys.CLOCK)
        self._newest = next(iter(link.get(keys.CLOCK)), None)

    def clock(self) -> run_messages.Clock | None:
        for sample in self._subscription.drain():
            self._newest = sample
        return messages.decode(keys.CLOCK, self._newest.payload) if self._newest else None

    def t_ns(self) -> int:
        clock = self.clock()
        return clock.t_ns if clock else 0


def _refuse_wildcards(key: str, command: str) -> None:
    if "*" in key:
        raise RunError(f"key is {key!r}; `zsim {command}` takes one key, without wildcards")


def _map(name: str, text: str, example: str) -> dict[str, Any]:
    """Parse a JSON text that must be a map; raise RunError, beginning with `name`, if it is not."""
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RunError(f"{name} is not JSON ({error}); must be a map such as '{example}'") from error
    if not isinstance(fields, dict):
        raise RunError(f"{name} is {text[:40]!r}; must be a map such as '{example}'")
    try:
        msgspec.msgpack.encode(fields)
    except messages.REFUSALS as error:
        raise RunError(f"{name} cannot be sent ({error}); must be a map such as '{example}'") from error
    return fields


def ask(link: Session, key: str, op: str, text: str) -> Any:
    """Send a request with arguments in a JSON text; return the result as JSON values; errors as in `result_of`."""
    _refuse_wildcards(key, "ask")
    result = result_of(link.request(key, op, ASK, _map(f"{op}: args", text, '{"gates": 50}')))
    with suppress(DecodeError):  # only the result of a replay contains messages
        return [{"key": key, "message": readable(ReceivedSample(key, payload))} for key, payload in pairs_of(result)]
    return msgspec.to_builtins(result, str_keys=True)
