"""Poking a running federation: messages published and requests sent by hand."""

import json
import time
from contextlib import suppress
from typing import Any

import msgspec

from zsim.contract import keys, messages
from zsim.contract.framing import pairs_of
from zsim.errors import DecodeError, RunError
from zsim.transport.session import Sample, Session
from zsim_deploy.cli.inspect.look import readable

PUB, ASK = "zsim.pub", "zsim.ask"
COMMANDS = "drone/*/cmd/*"


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
        self._box = link.subscribe(keys.CLOCK)
        self._newest = next(iter(link.get(keys.CLOCK)), None)

    def t_ns(self) -> int:
        """Return the time of the newest clock, 0 where no world answers."""
        for sample in self._box.drain():
            self._newest = sample
        return messages.decode(keys.CLOCK, self._newest.payload).t_ns if self._newest else 0


def _command_key(key: str, info: messages.Info) -> str:
    """Return the key if a command of a drone may be sent there."""
    _refuse_wildcards(key, "pub")
    kind = messages.type_of(key)
    if kind is None:
        raise RunError(f"{key}: is no key of the contract; `zsim keys` lists what speaks, docs/protocol.md all of them")
    if not keys.matches(COMMANDS, key):
        raise RunError(f"{key}: only the process that this is about speaks here; must be {COMMANDS.replace('*', '…')}")
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
    """Send a request with the arguments in a JSON text; return its result as JSON can say it.

    Raises:
        RunError: no JSON, nobody answers, or the answer is a refusal.
    """
    _refuse_wildcards(key, "ask")
    answer = link.request(key, op, ASK, _map(f"{op}: args", text, '{"gates": 50}'))
    if not answer.ok:
        raise RunError(answer.error)
    with suppress(DecodeError):  # a replay is the only result that holds messages
        return [{"key": name, "message": readable(Sample(name, payload))} for name, payload in pairs_of(answer.result)]
    return msgspec.to_builtins(answer.result, str_keys=True)
