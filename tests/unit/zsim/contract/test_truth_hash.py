"""The hash of a flight: the contract's bytes, written down again with `struct`."""

import hashlib
import struct

import numpy as np
import pytest

from zsim.contract.fingerprint import TruthHash

DRONES = 3
WIDTHS = (3, 3, 4, 3)


def instants(count: int) -> list[tuple[int, list[np.ndarray]]]:
    rng = np.random.default_rng(1)
    return [(i * 20_000_000, [rng.normal(size=(DRONES, width)) for width in WIDTHS]) for i in range(count)]


def digest(states: list[tuple[int, list[np.ndarray]]]) -> str:
    truth = TruthHash(DRONES)
    for t_ns, arrays in states:
        truth.add(t_ns, np.hstack(arrays))
    return truth.hexdigest()


def test_the_bytes_are_the_contract_s():
    """Instants in time order, drones in scenario order: t_ns, position, velocity, orientation, angular velocity."""
    states = instants(100)  # more than are held back
    wanted = hashlib.sha256()
    for t_ns, arrays in states:
        for drone in range(DRONES):
            numbers = [float(x) for array in arrays for x in array[drone]]
            wanted.update(struct.pack("<q13d", t_ns, *numbers))
    assert digest(states) == wanted.hexdigest()


def test_nothing_flown_is_the_hash_of_nothing():
    assert TruthHash(DRONES).hexdigest() == hashlib.sha256(b"").hexdigest()


def test_layout_and_byte_order_of_the_arrays_do_not_matter():
    states = instants(2)
    turned = [(t, [np.asfortranarray(a).astype(">f8") for a in arrays]) for t, arrays in states]
    assert digest(turned) == digest(states)


@pytest.mark.parametrize("array", range(len(WIDTHS)))
@pytest.mark.parametrize("drone", range(DRONES))
def test_the_last_bit_of_every_number_counts(array: int, drone: int):
    states, changed = instants(2), instants(2)
    for column in range(WIDTHS[array]):
        values = changed[1][1][array]
        before = values[drone, column]
        values[drone, column] = np.nextafter(before, np.inf)
        assert digest(changed) != digest(states)
        values[drone, column] = before
    assert digest(changed) == digest(states)


def test_time_and_order_count():
    states = instants(3)
    assert digest(states[::-1]) != digest(states)
    assert digest([(t + 1, arrays) for t, arrays in states]) != digest(states)
    assert digest([(t, [array[::-1] for array in arrays]) for t, arrays in states]) != digest(states)


def test_the_hash_may_be_asked_on_the_way():
    truth = TruthHash(DRONES)
    for t_ns, arrays in instants(4):
        truth.add(t_ns, np.hstack(arrays))
        truth.hexdigest()
    assert truth.hexdigest() == digest(instants(4))
