"""Types of messages' fields: finite numbers, whole numbers of 64 bits; and the first fields of every message."""

import sys
from typing import Annotated

from msgspec import Meta, Struct

# Limits that every finite number keeps and that NaN and infinities break: msgspec compares while it decodes.
Number = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Whole = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Vector3 = tuple[Number, Number, Number]


class Message(Struct, frozen=True, gc=False):
    """The first fields of every message: simulated time of publication, and a count per key from 0.

    A class may have a method `fault`: it returns what is wrong with a message and no type can express, or None.
    """

    t_ns: Count
    seq: Count
