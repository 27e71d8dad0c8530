"""A block: numbers of eight drones side by side, so that an instruction works on all of them.

It is one array; `block[LANES * column + k]` is drone k's. Its length and columns are constants, so that the compiler
needs neither a check of overlaps nor a rest. What it makes of a loop over the lanes are the operations of one drone, in
their order: the results are the same to the last bit.
"""

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector
from zsim_world.state.vehicle import Row

LANES = 8  # doubles in a register of 512 bit, or in two of 256
# Every block begins with the parameters of its drones (vehicle.py)


def blocks(columns: int, *constants: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the blocks of N drones, (blocks, LANES * columns), with what does not change; all else is 0.

    Args:
        columns: of a block.
        constants: (N, any), side by side from column 0 on. Lanes without a drone get those of the last one.
    """
    known = np.concatenate(constants, axis=1)
    count = -(-len(known) // LANES)
    drone = np.minimum(np.arange(count * LANES), len(known) - 1).reshape(count, LANES)
    made = np.zeros((count, columns, LANES))
    made[:, : known.shape[1]] = known[drone].swapaxes(1, 2)
    return made.reshape(count, -1)


@inlined
def row(block: NDArray, k: int) -> Row:
    """Return the parameters of the drone in lane k."""
    a, b, c, d = four(block, 0, k), four(block, 4, k), four(block, 8, k), four(block, 12, k)
    return a + b + c + d + four(block, 16, k) + vector(block, 20, k)


@inlined
def vector(block: NDArray, at: int, k: int) -> Vector:
    """Return three numbers of the drone in lane k, from column `at` on."""
    return (block[LANES * at + k], block[LANES * (at + 1) + k], block[LANES * (at + 2) + k])


@inlined
def four(block: NDArray, at: int, k: int) -> Quaternion:
    """Return four numbers of the drone in lane k."""
    a, b, c = vector(block, at, k)
    return (a, b, c, block[LANES * (at + 3) + k])


@inlined
def put(block: NDArray, at: int, k: int, a: Vector) -> None:
    """Write three numbers of the drone in lane k."""
    block[LANES * at + k], block[LANES * (at + 1) + k], block[LANES * (at + 2) + k] = a


@inlined
def put_four(block: NDArray, at: int, k: int, a: Quaternion) -> None:
    """Write four numbers of the drone in lane k."""
    put(block, at, k, (a[0], a[1], a[2]))
    block[LANES * (at + 3) + k] = a[3]
