"""The age of commands as the recorder saw it, for runs whose world did not live to report its own."""

from pathlib import Path

import numpy as np

from zsim.contract import keys
from zsim.record import RecordReader


def command_age_ms(path: Path) -> dict[str, float] | None:
    """Return p50, p99 and max [ms] of the wall time from a drone's status to the command that answers it.

    Both are taken where they reached the recorder; None when no command answers a status on record.
    """
    with RecordReader(path) as reader:
        wanted = {key for key in reader.topics() if keys.leaf(key) in ("status", "velocity")}
        answered: dict[tuple[str, int], int] = {}
        ages_ns = []
        for message in reader.messages(wanted, by_time=False):
            instant = (keys.thing(message.key), message.t_ns)
            if keys.leaf(message.key) == "status":
                answered[instant] = message.wall_ns
            elif instant in answered:
                ages_ns.append(message.wall_ns - answered[instant])
    if not ages_ns:
        return None
    ages = np.array(ages_ns) / 1e6
    p50, p99 = np.percentile(ages, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(ages.max())}
