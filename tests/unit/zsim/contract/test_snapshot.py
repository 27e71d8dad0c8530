"""The state of an agent as bytes."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec.msgpack import Ext
from refused import refused

from zsim.contract.snapshot import ARRAY, pack, unpack
from zsim.errors import DecodeError


@pytest.mark.parametrize(
    "value",
    [0, -(2**63), 0.1, -0.0, math.inf, math.nan, "text", b"bytes", None, True, [1, [2.5, "x"]], {"a": {"b": 1}}],
)
def test_plain_values_survive_a_round_trip(value: Any):
    assert repr(unpack(pack({"value": value}))) == repr({"value": value})


@pytest.mark.parametrize(
    ("value", "plain"), [(np.float64(0.1), 0.1), (np.int64(-3), -3), (np.uint8(7), 7), (np.bool_(True), True)]
)
def test_numpy_numbers_come_back_as_plain_ones(value: Any, plain: Any):
    assert repr(unpack(pack({"value": value}))["value"]) == repr(plain)


@pytest.mark.parametrize(
    "array",
    [
        np.array([[1.0, -0.0], [np.nan, np.inf]]),
        np.arange(6).reshape(1, 2, 3),
        np.array([True, False]),
        np.empty(0),
        np.arange(12.0).reshape(3, 4)[:, 1],
    ],
)
def test_arrays_come_back_bit_identical_and_writable(array: np.ndarray):
    again = unpack(pack({"rows": [array]}))["rows"][0]
    assert (again.dtype, again.shape, again.tobytes()) == (array.dtype, array.shape, array.tobytes())
    again[...] = 0


@pytest.mark.parametrize("value", [object(), {1, 2}.__iter__(), np.array(["text"]), np.array([1.0], dtype=np.float32)])
def test_values_of_unsupported_types_are_refused(value: Any):
    with refused(TypeError, "a state", type(value).__name__):
        pack({"value": value})


def array(kind: str, shape: list[int], numbers: bytes) -> bytes:
    return msgspec.msgpack.encode({"rows": Ext(ARRAY, msgspec.msgpack.encode([kind, shape, numbers]))})


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        b"\x91\x01",
        msgspec.msgpack.encode({"rows": Ext(ARRAY + 1, b"")}),
        msgspec.msgpack.encode({"rows": Ext(ARRAY, b"\xc1")}),
        array("<f8", [2], bytes(8)),
        array("<f8", [-1, -1], bytes(8)),
        array("|O", [1], bytes(8)),
        array("|V8", [1], bytes(8)),
    ],
)
def test_garbage_is_refused_in_one_line(payload: bytes):
    with refused(DecodeError, "state"):
        unpack(payload)
