"""A record as the inputs of a world: what reached it between two gates, and what was true at the second one.

The order of a record is the order in which messages passed the world: what stands before the clock of a gate was
taken in before that gate was integrated.
"""

from collections.abc import Iterator
from typing import NamedTuple

from zsim.contract import keys, messages
from zsim.record import Recorded, RecordReader

SPOKEN = ("join", "done", "bye")  # what processes say to the world
OUTPUTS = (messages.Estimate, messages.ClusterState, messages.ClusterRequest)


class Passage(NamedTuple):
    """The way to a gate.

    Attributes:
        t_ns: the gate.
        inputs: what was taken in before, in order.
        truth: payloads at the gate, by drone.
    """

    t_ns: int
    inputs: list[Recorded]
    truth: dict[str, bytes]


def passages(reader: RecordReader, drones: list[str]) -> Iterator[Passage]:
    """Yield the way to each gate of a record, as far as it is whole."""
    truth_keys = {keys.truth(drone): drone for drone in drones}
    wanted = {key for key in reader.topics() if key in truth_keys or key == keys.CLOCK or _is_input(key)}
    inputs: list[Recorded] = []
    truth: dict[str, bytes] = {}
    last_ns = -1
    for recorded in reader.messages(wanted, by_time=False):
        if recorded.key in truth_keys:
            truth[truth_keys[recorded.key]] = recorded.payload
        elif recorded.key != keys.CLOCK:
            inputs.append(recorded)
        elif recorded.t_ns > last_ns and truth:  # another of the same gate is told while time stands
            yield Passage(recorded.t_ns, inputs, truth)
            inputs, truth, last_ns = [], {}, recorded.t_ns


def _is_input(key: str) -> bool:
    kind, _, what = keys.parts(key)
    if kind == "process":
        return what in SPOKEN
    return key == keys.EVENT or (kind == "drone" and what.startswith("cmd/")) or messages.type_of(key) in OUTPUTS
