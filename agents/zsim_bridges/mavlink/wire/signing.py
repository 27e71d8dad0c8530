"""Signatures of MAVLink 2 frames.

Source: https://mavlink.io/en/guide/message_signing.html.
"""

import hmac
from collections.abc import Collection
from hashlib import sha256

KEY_BYTES = 32  # a secret key
SIGNATURE_BYTES = 13  # link id, 6 of time, 6 of hash
HASH_BYTES = 6  # the first of SHA-256
TICKS_PER_S = 100_000  # timestamps count 10 us
EPOCH_S = 1_420_070_400  # 2015-01-01 in seconds since 1970: zero of timestamps
BEHIND_MAX = 6_000_000  # ticks, a minute: a stream that begins may be behind that much
TIMESTAMP_MAX = 2**48 - 1
STREAMS_MAX = 4096  # remembered; only holders of the key begin any


class Signing:
    """Signs frames with a key, and checks those that come in.

    Args:
        key: the secret, 32 bytes.
        link_id: of the frames that it signs.
        accepts_unsigned: whether frames without a signature are taken, or the ids of the messages that are.

    Attributes:
        timestamp: of the newest frame signed or accepted [10 us since 2015].
    """

    def __init__(self, key: bytes, link_id: int = 0, accepts_unsigned: bool | Collection[int] = False) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"the signing key has {len(key)} bytes; must have {KEY_BYTES}")
        self._key = key
        self._link = bytes([link_id])
        self._accepts_unsigned = accepts_unsigned
        self._streams: dict[tuple[int, int, int], int] = {}
        self.timestamp = 0

    def advance(self, unix_s: float) -> None:
        """Follow the wall clock [s since 1970]; timestamps never go back."""
        self.timestamp = max(self.timestamp, min(TIMESTAMP_MAX, int((unix_s - EPOCH_S) * TICKS_PER_S)))

    def accepts_unsigned(self, message_id: int) -> bool:
        """Return whether a frame without a signature is taken."""
        policy = self._accepts_unsigned
        return policy if isinstance(policy, bool) else message_id in policy

    def sign(self, frame: bytes) -> bytes:
        """Return the signature that follows a frame, header to checksum."""
        self.timestamp += 1
        head = self._link + self.timestamp.to_bytes(6, "little")
        return head + self._hash(frame + head)

    def refusal(self, frame: bytes, signature: bytes, system_id: int, component_id: int) -> str | None:
        """Return why a signed frame is refused, `bad_signature` or `replayed`; None if it is accepted."""
        if not hmac.compare_digest(self._hash(frame + signature[:-HASH_BYTES]), signature[-HASH_BYTES:]):
            return "bad_signature"
        stream = system_id, component_id, signature[0]
        timestamp = int.from_bytes(signature[1:7], "little")
        known = self._streams.get(stream)
        oldest = self.timestamp - BEHIND_MAX if known is None else known + 1
        if timestamp < oldest or (known is None and len(self._streams) >= STREAMS_MAX):
            return "replayed"
        self._streams[stream] = timestamp
        self.timestamp = max(self.timestamp, timestamp)
        return None

    def _hash(self, data: bytes) -> bytes:
        return sha256(self._key + data).digest()[:HASH_BYTES]
