"""What a record says at one simulated instant."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.messages import ClusterState, Estimate, Event, Gps, Info, Status, Truth
from zsim_analysis.export.selection import thing


@dataclass
class Instant:
    """Messages stamped with one time; of several on a key, the last."""

    t_ns: int
    truth: dict[str, Truth] = field(default_factory=dict)
    estimates: dict[str, Estimate] = field(default_factory=dict)
    status: dict[str, Status] = field(default_factory=dict)
    gps: dict[str, Gps] = field(default_factory=dict)
    states: dict[str, ClusterState] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)

    def take(self, key: str, message: Any) -> None:
        """Take a message of a type that is drawn."""
        if isinstance(message, Event):
            self.events.append(message)
            return
        places: dict[type, dict[str, Any]] = {
            Truth: self.truth,
            Estimate: self.estimates,
            Status: self.status,
            Gps: self.gps,
            ClusterState: self.states,
        }
        places[type(message)][thing(key)] = message


DRAWN = (Truth, Estimate, Status, Gps, ClusterState, Event)


def is_drawn(key: str) -> bool:
    """Tell whether the messages of a key are drawn."""
    return messages.type_of(key) in DRAWN or key == keys.INFO


def instants(decoded: Iterable[tuple[str, Any]]) -> Iterator[Instant]:
    """Gather keys and messages, in order of time, by their time; `world/info` is passed over."""
    now: Instant | None = None
    for key, message in decoded:
        if isinstance(message, Info):
            continue
        if now is None or message.t_ns != now.t_ns:
            if now is not None:
                yield now
            now = Instant(message.t_ns)
        now.take(key, message)
    if now is not None:
        yield now
