"""How all figures and pages look, and how they are written: colours, axes, legends, lines, templates, files."""

import base64
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from msgspec import Struct

from zsim.errors import ReportError
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.recorded_flight import Array
from zsim_analysis.report import FORMATS

COLUMN_IN, PAGE_IN = 3.5, 7.16  # widths of a column and of a page of IEEE's conference papers
DPI = 200  # of PNG files
PAPER_PT = 8.0  # of text, points: that of a paper's captions
LETTER_EMS, ENTRY_EMS = 0.6, 3.4  # width of a letter, and of an entry of a legend besides its name, in its text's size
LETTER_PAD_PT = 3.0  # between the letter of a panel and its axes
FONTS: Any = {"pdf.fonttype": 42, "svg.hashsalt": "zsim"}  # TrueType: IEEE takes no Type 3
POINTS = 2000  # per line: more than a page has pixels
# Okabe and Ito's colours, distinct with every kind of colour vision.
BLACK, ORANGE, SKY, GREEN = "#000000", "#e69f00", "#56b4e9", "#009e73"
BLUE, VERMILION, PURPLE = "#0072b2", "#d55e00", "#cc79a7"
GREY, DARK, GRID = "#8c959f", "#444c56", "#c9d1d9"
DESIRED: dict[str, Any] = {"color": BLACK, "lw": 1.0, "ls": (0, (5, 3)), "zorder": 4}
MEASURED: dict[str, Any] = {"color": ORANGE, "lw": 1.1, "zorder": 2}  # seen on both sides of truth where they agree
TRUE: dict[str, Any] = {"color": BLUE, "lw": 0.6, "zorder": 3}


SYMBOLS = {
    "x_c": "$x_c$",
    "y_c": "$y_c$",
    "z_c": "$z_c$",
    "roll": "roll",
    "pitch": "pitch",
    "yaw": "yaw",
    "p": "$p$",
    "q": "$q$",
    "beta": "$\\beta$",
}
GREEK = {"phi": "\\phi", "rho": "\\rho"}


class ReportFigure(Struct, frozen=True):
    """A figure with its file name, and its title and caption on the page."""

    name: str
    title: str
    caption: str
    drawing: Figure

    @property
    def size_px(self) -> tuple[int, int]:
        """Return width and height of its PNG file, which a page needs to lay itself out before the picture is there."""
        width, height = self.drawing.get_size_inches() * self.drawing.dpi
        return round(width), round(height)

    @property
    def is_column(self) -> bool:
        """Tell whether it is as wide as a column, of which a page holds two."""
        return self.drawing.get_size_inches()[0] <= COLUMN_IN

    def png(self) -> bytes:
        """Return the figure as a PNG file; it is laid out then, once for all its files."""
        file = io.BytesIO()
        self.drawing.savefig(file, format="png")
        self.drawing.set_layout_engine("none")
        return file.getvalue()

    def vector(self, form: str) -> bytes:
        """Return the figure as a file of one of `zsim_analysis.report.FORMATS`, the same bytes each time."""
        file = io.BytesIO()
        stamp = "CreationDate" if form == "pdf" else "Date"
        with rc_context(FONTS):
            self.drawing.savefig(file, format=form, metadata={stamp: None})
        return file.getvalue()


Picture = tuple[ReportFigure, bytes]  # a figure and its PNG file


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that lays itself out; nothing of matplotlib's global state is used."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def padded_range(samples: Array, share: float) -> tuple[float, float] | None:
    """Return the range of the finite samples, wider at each end by a share of it; None where it has no width."""
    known = samples[np.isfinite(samples)]
    if not len(known) or known.max() <= known.min():
        return None
    room = share * (known.max() - known.min())
    return float(known.min() - room), float(known.max() + room)


def dress(axes: Axes, label: str = "") -> None:
    """Give axes their grid and the label of their y axis."""
    axes.grid(True, color=GRID, lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(which="both", labelsize=PAPER_PT - 1)
    axes.margins(x=0.01)
    if label:
        axes.set_ylabel(label, fontsize=PAPER_PT)


def label_time(axes: Iterable[Axes]) -> None:
    """Label the time axis of axes."""
    for each in axes:
        each.set_xlabel("simulated time (s)", fontsize=PAPER_PT)


def label(name: str) -> str:
    """Return the label of a parameter at an axis, with its unit."""
    stem, _, number = name.partition("_")
    greek = f"${GREEK[stem]}_{{{number}}}$" if stem in GREEK else name
    return f"{SYMBOLS.get(name, greek)} ({unit(name)})"


def line(axes: Axes, x: Array, y: Array, **style: Any) -> None:
    """Draw a line with no more points than are visible."""
    axes.plot(*thinned(x, y), **style)


def letter_panels(panels: Iterable[Axes]) -> None:
    """Name panels, or columns by their uppermost panel, (a), (b) and so on; one alone needs no letter.

    Args:
        panels: in the order of reading, their titles being written already.
    """
    panels = list(panels)
    for number, axes in enumerate(panels if len(panels) > 1 else ()):
        letters = chr(ord("a") + number % 26) * (1 + number // 26)
        place = "center" if axes.get_title() else "left"
        title = axes.get_title(loc=place)
        look: Any = {"fontsize": PAPER_PT, "pad": LETTER_PAD_PT}
        if title:
            axes.set_title(f"({letters}) {title}", loc=place, **look)
        else:
            axes.set_title(f"({letters})", loc=place, ha="right", **look)  # beside all that stands above axes


def legend_above(figure: Figure, axes: Axes, columns: int = 8) -> None:
    """Put the legend above all axes of a figure, where it covers no data: each name once, first those of `axes`."""
    named: dict[str, Any] = {}
    for each in (axes, *figure.axes):
        for handle, name in zip(*each.get_legend_handles_labels(), strict=True):
            named.setdefault(name, handle)
    handles, labels = list(named.values()), list(named)
    if handles:
        longest = (ENTRY_EMS + LETTER_EMS * max(map(len, labels))) * PAPER_PT / 72  # inches
        columns = min(columns, max(1, int(figure.get_size_inches()[0] / longest)))
        figure.legend(
            handles,
            labels,
            loc="outside upper center",
            ncols=min(columns, len(handles)),
            frameon=False,
            fontsize=PAPER_PT,
            columnspacing=1.2,
            handlelength=1.6,
        )


def thinned(x: Array, y: Array, points: int = POINTS) -> tuple[Array, Array]:
    """Return a line of at most `points` points: the least and the greatest of each bin, no extreme lost."""
    if len(x) <= points:
        return x, y
    size = -(-len(x) // (points // 2))
    starts = np.arange(0, len(x), size)
    bins = np.full((len(starts), size), np.nan)
    bins.flat[: len(x)] = y
    unknown = np.isnan(bins)  # as good as any other one of its bin, if there is none that is known
    least, greatest = (np.where(unknown, worst, bins) for worst in (np.inf, -np.inf))
    kept = np.unique((starts + least.argmin(axis=1), starts + greatest.argmax(axis=1)))
    return x[kept], y[kept]


def write_report(
    directory: Path,
    summary: bytes,
    figures: Iterable[ReportFigure],
    page: Callable[[Sequence[Picture]], str],
    progress: Callable[[str], None],
    formats: Sequence[str] = (),
) -> None:
    """Write DIR/summary.json, DIR/figures/*.png and DIR/report.html, all or none of them.

    Files of these figures in other formats, which an earlier report left, are of another drawing and go.

    Args:
        directory: of the run or the sweep.
        summary: content of summary.json.
        figures: drawn one by one.
        page: makes the page of the pictures.
        progress: called with a text at each step.
        formats: of `zsim_analysis.report.FORMATS`, in which figures are written beside their PNG files.

    Raises:
        ReportError: the directory cannot be written.
    """
    with _put_in_place(directory, directory, directory / "figures") as new:
        (new / "figures").mkdir()
        pictures = render(_kept(figures, new / "figures", formats), progress)
        progress("writing the page")
        for figure, png in pictures:
            (new / "figures" / figure.name).write_bytes(png)
        (new / "summary.json").write_bytes(summary)
        (new / "report.html").write_text(page(pictures), encoding="utf-8")
    for figure, _ in pictures:
        _remove_others(directory / "figures" / figure.name, formats)


def write_page(
    out: Path,
    figures: Iterable[ReportFigure],
    page: Callable[[Sequence[Picture]], str],
    progress: Callable[[str], None],
    formats: Sequence[str] = (),
) -> None:
    """Write one page; an earlier one is replaced when the new one is whole. Arguments and errors as `write_report`.

    Figures in other formats come into a folder beside the page, NAME-figures.
    """
    folder = f"{out.stem}-figures"
    with _put_in_place(out.parent, out, out.parent / folder) as new:
        (new / folder).mkdir()
        pictures = render(_kept(figures, new / folder, formats), progress)
        progress("writing the page")
        (new / out.name).write_text(page(pictures), encoding="utf-8")
    for figure, _ in pictures:
        _remove_others(out.parent / folder / figure.name, formats)


def _kept(figures: Iterable[ReportFigure], folder: Path, formats: Sequence[str]) -> Iterator[ReportFigure]:
    """Yield figures when their files in other formats are written."""
    for figure in figures:
        yield figure
        for form in formats:
            (folder / figure.name).with_suffix(f".{form}").write_bytes(figure.vector(form))


def _remove_others(png: Path, formats: Sequence[str]) -> None:
    """Remove the files of a figure in formats other than these."""
    for form in set(FORMATS) - set(formats):
        if (earlier := png.with_suffix(f".{form}")).is_file():
            earlier.unlink()


@contextmanager
def _put_in_place(directory: Path, report: Path, figures: Path) -> Iterator[Path]:
    """Yield a folder whose files come into a directory when all are made: a full disk or Ctrl-C leaves no half of them.

    Raises:
        ReportError: the directory cannot be written, and the line begins with `report`; or `figures` in it is a link,
            through which files would be written, and removed, elsewhere.
    """
    if figures.is_symlink():
        raise ReportError(f"{figures}: is a symbolic link to {figures.readlink()}; must be a folder, remove the link")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=directory, prefix=".report-") as folder:
            yield Path(folder)
            for path in sorted(path for path in Path(folder).rglob("*") if path.is_file()):
                target = directory / path.relative_to(folder)
                target.parent.mkdir(exist_ok=True)
                path.replace(target)
    except OSError as error:
        raise ReportError(f"{report}: the report cannot be written ({error.strerror})") from error


def render(figures: Iterable[ReportFigure], progress: Callable[[str], None]) -> list[Picture]:
    """Draw figures one by one; one that is rendered keeps no drawing in memory."""
    pictures = []
    for figure in figures:
        progress(f"drawing {figure.name}")
        pictures.append((figure, figure.png()))
    return pictures


def template(name: str, package: str = "zsim_analysis.report") -> Template:
    """Return a page's template; what it includes may stand beside it or here."""
    return Environment(
        loader=ChoiceLoader([PackageLoader(package, "."), PackageLoader("zsim_analysis.report", ".")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    ).get_template(name)


def sources(pictures: Iterable[Picture]) -> list[tuple[ReportFigure, str]]:
    """Return each figure with its PNG file as a data URI, which needs no file beside the page."""
    return [(figure, "data:image/png;base64," + base64.b64encode(png).decode()) for figure, png in pictures]
