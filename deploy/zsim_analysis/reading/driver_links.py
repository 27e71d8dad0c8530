"""How good the links to real aircraft were, by what their drivers published."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median

from msgspec import Struct

from zsim.contract import keys
from zsim.contract.flight_messages import LinkState
from zsim.record import RecordReader
from zsim_analysis.reading.recorded_run import decode_or_none


class DriverLink(Struct, frozen=True):
    """The link to one external drone over a run; None for what its driver never knew.

    Attributes:
        peer: address of the aircraft.
        age_max_ms: wall time since the newest datagram, at most, as reported once a second.
        loss_mean_percent, loss_max_percent: of what the aircraft sent.
        round_trip_ms: median.
        lost: how often the aircraft was silent for a second.
        lost_s: for how long in all, of simulated time.
        refused: datagrams that were not understood, or of another, of all drivers one after the other.
    """

    peer: str
    age_max_ms: float | None
    loss_mean_percent: float | None
    loss_max_percent: float | None
    round_trip_ms: float | None
    lost: int
    lost_s: float
    refused: int


def driver_links(path: Path) -> dict[str, DriverLink]:
    """Return the links of a record by drone; none where no drone is external.

    Raises:
        RecordError: no such record.
    """
    reports: dict[str, list[LinkState]] = defaultdict(list)
    with RecordReader(path) as reader:
        wanted = {key for key in reader.topics() if keys.parts(key)[::2] == ("drone", "link")}
        for recorded in reader.messages(wanted, by_time=False) if wanted else ():
            report = decode_or_none(recorded)
            if report is not None:
                reports[keys.thing(recorded.key)].append(report)
    return {drone: _link(of_drone) for drone, of_drone in sorted(reports.items())}


def _link(reports: Sequence[LinkState]) -> DriverLink:
    pairs = list(pairwise(reports))
    ages, losses, trips = (
        [value for report in reports if (value := getattr(report, name)) is not None]
        for name in ("age_ms", "loss_percent", "round_trip_ms")
    )
    return DriverLink(
        peer=reports[-1].peer,
        age_max_ms=max(ages, default=None),
        loss_mean_percent=sum(losses) / len(losses) if losses else None,
        loss_max_percent=max(losses, default=None),
        round_trip_ms=median(trips) if trips else None,
        lost=sum(before.state != "lost" and after.state == "lost" for before, after in pairs),
        lost_s=sum(after.t_ns - before.t_ns for before, after in pairs if before.state == "lost") / 1e9,
        refused=sum(before.refused for before, after in pairs if after.seq == 0) + reports[-1].refused,
    )


def link_text(link: DriverLink) -> str:
    """Return a line about a link."""
    figures = (
        ("loss {:.1f} %", link.loss_mean_percent),
        ("at most {:.1f} %", link.loss_max_percent),
        ("age at most {:.0f} ms", link.age_max_ms),
        ("round trip {:.0f} ms", link.round_trip_ms),
    )
    known = [text.format(value) for text, value in figures if value is not None]
    lost = f"lost {link.lost} times, for {link.lost_s:.1f} s" if link.lost else "never lost"
    refused = [f"{link.refused} messages refused"] if link.refused else []
    return ", ".join([link.peer, *known, lost, *refused])
