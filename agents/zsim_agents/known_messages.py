"""What a record has already: its run, and the messages at its end, of which the world may bring some again."""

from pathlib import Path

from zsim.contract import keys, messages
from zsim.contract.flight_messages import ClusterState, Command, Estimate
from zsim.contract.run_messages import ClusterRequest
from zsim.errors import DecodeError
from zsim.record import Recorded, RecordReader

OUTPUTS = (Command, Estimate, ClusterState, ClusterRequest)
KNOWN_MAX = 2_000_000  # messages remembered: 7 s of 1000 drones
TAIL_NS = 7_000_000_000  # simulated, at the end of a record; the world's history has 5 s


class KnownMessages:
    """Messages that are written, so that none is written twice; the oldest are forgotten beyond KNOWN_MAX."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, bytes], None] = {}
        self._outputs_only = False

    def __bool__(self) -> bool:
        return bool(self._known)

    def __contains__(self, entry: tuple[str, bytes]) -> bool:
        return entry in self._known

    def add(self, key: str, payload: bytes) -> None:
        """Remember a message."""
        self._known[key, payload] = None
        self._outputs_only = False
        if len(self._known) > KNOWN_MAX:
            del self._known[next(iter(self._known))]

    def add_tail(self, path: Path) -> Recorded | None:
        """Remember what stands at the end of a record; return the newest clock there."""
        with RecordReader(path) as reader:
            last = reader.last(keys.CLOCK)
            last_ns = last.t_ns if last else 0
            for recorded in reader.messages(by_time=False, from_ns=max(0, last_ns - TAIL_NS)):
                self.add(recorded.key, recorded.payload)
        return last

    def keep_outputs(self) -> None:
        """Forget all but outputs of participants, who repeat them after a rejoin; anything else that comes is new."""
        if not self._outputs_only:
            self._known = {entry: None for entry in self._known if _is_output(*entry)}
            self._outputs_only = True

    def clear(self) -> None:
        """Forget all of them: what passes from now on is new."""
        self._known.clear()


def _is_output(key: str, payload: bytes) -> bool:
    kind = messages.type_of(key)
    if kind is None or not issubclass(kind, OUTPUTS):
        return False
    try:
        messages.decode(key, payload)
    except DecodeError:
        return False
    return True


def is_of_run(path: Path, run_id: str) -> bool:
    """Tell whether a file is the record of a run, or one that ends before it says of which run it is.

    Raises:
        RecordError: it is no record.
    """
    if not path.exists() or not path.stat().st_size:
        return path.exists()
    with RecordReader(path) as reader:
        recorded = next(reader.messages([keys.INFO]), None)
        if recorded is None:
            return not reader.topics()
    try:
        return messages.decode(keys.INFO, recorded.payload).run_id == run_id
    except DecodeError:
        return False
