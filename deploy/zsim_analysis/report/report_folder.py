"""The folder of a report: summary, figures and page, put in place together."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from zsim.errors import ReportError
from zsim_analysis.report.figures.run_figures import Named


def write(
    directory: Path,
    summary: bytes,
    figures: Iterable[Named],
    page: Callable[[Sequence[Named], Path], str],
    progress: Callable[[str], None],
) -> None:
    """Write DIR/summary.json, DIR/figures/*.png and DIR/report.html, all or none of them.

    Args:
        directory: of the run or the sweep.
        summary: content of summary.json.
        figures: drawn one by one.
        page: makes the page of the figures and the folder in which they lie.
        progress: told in words what is being done.

    Raises:
        ReportError: the directory cannot be written.
    """
    try:
        with TemporaryDirectory(dir=directory, prefix=".report-") as new:
            drawn = Path(new) / "figures"
            drawn.mkdir()
            shown = []
            for figure in figures:
                progress(f"drawing {figure.name}")
                figure.drawing.savefig(drawn / figure.name)
                shown.append(figure)
            progress("writing the page")
            (Path(new) / "summary.json").write_bytes(summary)
            (Path(new) / "report.html").write_text(page(shown, drawn), encoding="utf-8")
            _put_in_place(Path(new), directory)
    except OSError as error:
        raise ReportError(f"{directory}: the report cannot be written ({error.strerror})") from error


def _put_in_place(new: Path, directory: Path) -> None:
    """Put a report in its place when all of it is made: a full disk or Ctrl-C leaves no half of one."""
    (directory / "figures").mkdir(exist_ok=True)
    for path in sorted(new.rglob("*.*")):
        path.replace(directory / path.relative_to(new))
