"""Hashes of what the agents of a flight have published, by which two flights are compared."""

import hashlib
from typing import Any

from msgspec.structs import replace

from zsim.contract import messages
from zsim.contract.run_messages import ClusterRequest


def content_of(message: Any) -> bytes:
    """Return an agent's output as on the wire, but without the process that it was in: an agent may share one."""
    return messages.encode(replace(message, **{"controller" if isinstance(message, ClusterRequest) else "source": ""}))


class OutputHashes:
    """SHA-256 of the outputs of agents up to an instant, by key.

    Args:
        until_ns: the last instant whose outputs count; what is answered to later gates may not be on record.
    """

    def __init__(self, until_ns: int) -> None:
        self._until_ns = until_ns
        self._of: dict[str, hashlib._Hash] = {}

    def add(self, key: str, t_ns: int, content: bytes) -> None:
        """Add an output, as `content_of` gives it; those of a key in the order in which they were published."""
        if t_ns <= self._until_ns:
            self._of.setdefault(key, hashlib.sha256()).update(len(content).to_bytes(4, "little") + content)

    def hexdigests(self) -> dict[str, str]:
        return {key: digest.hexdigest() for key, digest in sorted(self._of.items())}
