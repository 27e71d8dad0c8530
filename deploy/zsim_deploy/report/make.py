"""Makes a report: record in, summary, figures and page out."""

from collections.abc import Callable
from pathlib import Path

from zsim.errors import ReportError
from zsim_deploy.report.figures import figures
from zsim_deploy.report.flight import Flight
from zsim_deploy.report.formation import Formation, formation
from zsim_deploy.report.page import page
from zsim_deploy.report.reading import read_flight
from zsim_deploy.report.summary import Summary, summarise

RECORD = "run.mcap"


def judge(record: Path, progress: Callable[[str], None] = lambda _: None) -> tuple[Flight, list[Formation], Summary]:
    """Return what a record says, and what that amounts to; nothing is written.

    Raises:
        RecordError: there is no record.
    """
    progress("reading the record")
    flight = read_flight(record)
    progress("computing the formation's errors")
    formations = [found for states in flight.clusters if (found := formation(states, flight.tracks))]
    return flight, formations, summarise(flight, formations, record)


def make_report(directory: Path, progress: Callable[[str], None] = lambda _: None) -> Summary:
    """Read DIR/run.mcap, write DIR/summary.json, DIR/figures/*.png and DIR/report.html.

    Args:
        directory: the run directory.
        progress: told in words what is being done.

    Raises:
        RecordError: there is no record.
        ReportError: the directory cannot be written.
    """
    flight, formations, summary = judge(directory / RECORD, progress)
    try:
        (directory / "summary.json").write_bytes(summary.json())
        (directory / "figures").mkdir(exist_ok=True)
        shown = []
        for figure in figures(flight, formations, summary.window_s):
            progress(f"drawing {figure.name}")
            figure.drawing.savefig(directory / "figures" / figure.name)
            shown.append(figure)
        progress("writing the page")
        (directory / "report.html").write_text(page(summary, shown, directory / "figures"), encoding="utf-8")
    except OSError as error:
        raise ReportError(f"{directory}: the report cannot be written ({error.strerror})") from error
    return summary
