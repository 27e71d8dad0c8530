"""The checksum of MAVLink frames.

Source: https://mavlink.io/en/guide/serialization.html#checksum: CRC-16/MCRF4XX, the polynomial of CCITT in reflected
bits, from 0xFFFF on. `binascii.crc_hqx` is the same polynomial with the bits in the other order, in C.
"""

from binascii import crc_hqx

START = 0xFFFF
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def checksum(data: bytes) -> int:
    """Return the checksum, 16 bits, of all bytes that a frame sums."""
    crc = crc_hqx(data.translate(_REVERSED), START)
    return _REVERSED[crc & 0xFF] << 8 | _REVERSED[crc >> 8]
