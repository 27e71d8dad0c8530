"""One colour per drone, the same in reports, the console and exports, distinct with every kind of colour vision.

Few drones have the colours of Okabe and Ito (2008); more have those of viridis (van der Walt, Smith 2015) from the
first drone of the scenario to the last, without its yellow, which white paper swallows.
"""

from collections.abc import Collection
from functools import lru_cache
from itertools import pairwise

FEW = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
MANY = ("#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151")  # 0 to 0.8


@lru_cache
def drone_colours(count: int) -> tuple[str, ...]:
    """Return the colours `#rrggbb` of so many drones, in the order of the scenario."""
    if count <= len(FEW):
        return FEW[:count]
    return tuple(_between(i / (count - 1)) for i in range(count))


def colours_of(drones: Collection[str]) -> dict[str, str]:
    """Return the colour of each drone by its name; they are in the order of the scenario."""
    return dict(zip(drones, drone_colours(len(drones)), strict=True))


def _between(share: float) -> str:
    """Return a colour of MANY, 0 the first one and 1 the last one."""
    place = min(int(share * (len(MANY) - 1)), len(MANY) - 2)
    low, high = list(pairwise(MANY))[place]
    part = share * (len(MANY) - 1) - place
    return "#" + "".join(f"{round(a + part * (b - a)):02x}" for a, b in zip(rgb(low), rgb(high), strict=True))


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of `#rrggbb`."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return red, green, blue
