"""Makes a comparison: records of several runs in, one page out."""

from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

from zsim.errors import ReportError
from zsim.record.run_folder import RECORD
from zsim_analysis.report.comparison.comparison import Compared, run_names, runs_id
from zsim_analysis.report.comparison.comparison_figures import comparison_figures
from zsim_analysis.report.comparison.comparison_page import comparison_page
from zsim_analysis.report.make_report import judge

NAMED, NAMES_MAX = 3, 100  # runs whose names the page's own name holds, and characters of them
MARK, MARK_WITHIN = b": comparison</title>", 4_000  # of a page of ours, within its first bytes


def comparison_path(directories: Sequence[Path]) -> Path:
    """Return where the comparison of runs goes: beside the first of them, under a name that no other one has."""
    names = [name.replace("/", "-") for name in run_names(directories)]
    more = f"-and-{len(names) - NAMED}-more" if len(names) > NAMED else ""
    stem = f"compare-{'-'.join(names[:NAMED])[:NAMES_MAX]}{more}"
    folder = directories[0].resolve().parent
    numbered = (folder / f"{stem}{'' if number == 1 else f'-{number}'}.html" for number in count(1))
    return next(path for path in numbered if not _is_of_others(path, directories))


def _is_of_others(page: Path, directories: Sequence[Path]) -> bool:
    """Tell whether a page that is there compares other runs than these."""
    head = _head(page)
    return MARK in head and runs_id(directories).encode() not in head


def _head(page: Path) -> bytes:
    """Return the beginning of a file, nothing where there is none."""
    if not page.is_file():
        return b""
    with page.open("rb") as file:
        return file.read(MARK_WITHIN)


def compare(directories: Sequence[Path], out: Path, progress: Callable[[str], None] = lambda _: None) -> list[Compared]:
    """Read the records of several runs and write the page that compares them.

    Args:
        directories: of the runs, at least two.
        out: of the page; an earlier one is replaced when the new one is whole.
        progress: told in words what is being done.

    Raises:
        RecordError: one of them has no record, or no drone moves on it.
        ReportError: a run is given twice, or the page cannot be written, or would replace something else.
    """
    _check(directories, out)
    runs = []
    for name, directory in zip(run_names(directories), directories, strict=True):
        found = judge(directory / RECORD, lambda text, name=name: progress(f"{name}: {text}"))
        runs.append(Compared(name, directory, *found))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=out.parent, prefix=".report-") as folder:
            _page(runs, Path(folder), progress).replace(out)
    except OSError as error:
        raise ReportError(f"{out}: the report cannot be written ({error.strerror})") from error
    return runs


def _check(directories: Sequence[Path], out: Path) -> None:
    """Refuse what would compare a run with itself, or write over what is no comparison."""
    places = [directory.resolve() for directory in directories]
    for place, directory in enumerate(directories):
        if places[place] in places[:place]:
            raise ReportError(f"{directory}: is given twice; a run is compared with others")
    if out.exists() and MARK not in _head(out):
        raise ReportError(f"{out}: exists and is no comparison of runs; give --out another place")


def _page(runs: Sequence[Compared], folder: Path, progress: Callable[[str], None]) -> Path:
    """Draw the figures, write the page, both into a folder; return where it is."""
    shown = []
    for figure in comparison_figures(runs):
        progress(f"drawing {figure.name}")
        figure.drawing.savefig(folder / figure.name)
        shown.append(figure)
    progress("writing the page")
    page = folder / "new.html"
    page.write_text(comparison_page(runs, shown, folder), encoding="utf-8")
    return page
