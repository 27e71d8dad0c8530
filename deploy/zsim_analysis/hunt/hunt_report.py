"""Makes the report of a hunt: the violation and its causes, margins over flights, combinations tried; with figures."""

import shlex
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import combinations

import numpy as np
from rich.console import Group
from rich.text import Text

from zsim.errors import ZsimError, printable
from zsim.output_folder import RECORD
from zsim.presentation import Column, FittedTable
from zsim_analysis.bundle.make_bundle import make_bundle
from zsim_analysis.hunt.hunt import (
    BUNDLE,
    SEARCH,
    VIOLATION,
    Hunted,
    HuntFlight,
    HuntRequest,
    HuntSummary,
    cause_text,
    fault_text,
)
from zsim_analysis.hunt.shrink import causes_of
from zsim_analysis.hunt.space import KindSpace
from zsim_analysis.report import figure_style as style
from zsim_analysis.report.make_report import Picture, make_report, rendered, write_report

QUARTERS = 4  # parts of a range, in each of which flights are counted
KINDS_DRAWN = 24  # maximum number of kinds for which the matrix of pairs is drawn


def make_hunt_report(
    hunted: Hunted, progress: Callable[[str], None] = lambda _: None, formats: Sequence[str] = ()
) -> list[str]:
    """Write summary.json, figures and report.html of a hunt, and the report and bundle of its violation.

    Returns:
        Notes on what the bundle lacks, or on why it could not be made.

    Raises:
        ReportError: the folder cannot be written.
    """
    out, summary = hunted.request.out, hunted.summary
    notes: list[str] = []
    if (out / VIOLATION / RECORD).exists():
        make_report(out / VIOLATION, progress, formats)
        progress("bundling the flight")
        try:
            make_bundle(out / VIOLATION, out / BUNDLE, True, True, notes.append)
        except ZsimError as error:
            notes.append(f"no bundle: {error}")
    searched = [each for each in hunted.flown if each.stage == SEARCH]
    write_report(out, summary, figures(summary, searched), partial(page, hunted, searched), progress, formats)
    return notes


def figures(summary: HuntSummary, searched: Sequence[HuntFlight]) -> Iterator[style.ReportFigure]:
    yield _margins(summary, searched)
    kinds = sorted({kind for each in searched for kind in each.case.kinds})
    if 1 < len(kinds) <= KINDS_DRAWN:
        yield _pairs(kinds, searched)


def _margins(summary: HuntSummary, searched: Sequence[HuntFlight]) -> style.ReportFigure:
    figure = style.new_figure(style.PAGE_IN, 1.6 * len(summary.requirements) + 0.4)
    panels = figure.subplots(len(summary.requirements), 1, sharex=True, squeeze=False)[:, 0]
    for i, (axes, text) in enumerate(zip(panels, summary.requirements, strict=True)):
        known = [(each.number, each.margins[i].value, each.margins[i].holds) for each in searched]
        points = np.array([(number, value) for number, value, _ in known if value is not None], float).reshape(-1, 2)
        broken = np.array([not holds for _, value, holds in known if value is not None], bool)
        axes.plot(*points[~broken].T, ".", color=style.BLUE, ms=2.5)
        axes.plot(*points[broken].T, "x", color=style.VERMILION, ms=5)
        if len(points):
            axes.plot(points[:, 0], np.minimum.accumulate(points[:, 1]), color=style.DARK, lw=0.8)
        for number in (number for number, value, _ in known if value is None):
            axes.axvline(number, color=style.VERMILION, lw=0.6)
        axes.axhline(0.0, color=style.GREY, lw=0.8)
        style.dress(axes, "margin")
        axes.set_title(text, fontsize=style.PAPER_PT, color=style.DARK, loc="left")
    panels[-1].set_xlabel("flight", fontsize=style.PAPER_PT)
    caption = (
        "Distance of each flight of the search from violating a requirement, in the unit of its quantities; crosses "
        "are violations. Line: the smallest margin so far. Vertical line: a quantity is unknown, or the flight failed."
    )
    return style.ReportFigure("margins.png", "Margins over the flights", caption, figure)


def _pairs(kinds: Sequence[str], searched: Sequence[HuntFlight]) -> style.ReportFigure:
    min_shares = np.full((len(kinds), len(kinds)), np.nan)
    counts = np.zeros_like(min_shares)
    for each in searched:
        indices = [kinds.index(kind) for kind in each.case.kinds]
        for a, b in (*combinations(indices, 2), *((index, index) for index in indices)):
            row, column = max(a, b), min(a, b)
            min_shares[row, column] = np.nanmin([min_shares[row, column], each.worst.share])
            counts[row, column] += 1
    side = min(style.PAGE_IN, 1.6 + 0.33 * len(kinds))
    figure = style.new_figure(side + 0.6, side)
    axes = figure.subplots()
    image = axes.imshow(100 * min_shares, cmap="viridis", vmin=-100, vmax=100)
    axes.set_xticks(
        range(len(kinds)), [kind.replace("_", " ") for kind in kinds], rotation=90, fontsize=style.PAPER_PT - 1
    )
    axes.set_yticks(range(len(kinds)), [kind.replace("_", " ") for kind in kinds], fontsize=style.PAPER_PT - 1)
    for row, column in zip(*np.nonzero(counts), strict=True):
        colour = "black" if min_shares[row, column] > 0 else "white"
        text = f"{counts[row, column]:.0f}"
        axes.text(column, row, text, ha="center", va="center", fontsize=style.PAPER_PT - 2, color=colour)
    bar = figure.colorbar(image, shrink=0.7)
    bar.set_label("least margin (%)", fontsize=style.PAPER_PT)
    bar.ax.tick_params(labelsize=style.PAPER_PT - 1)
    caption = (
        "Smallest margin of the flights with both kinds, as a share of that of the flight without faults, and their "
        "number; on the diagonal, those of all flights with a kind. Empty: not tried."
    )
    return style.ReportFigure("pairs.png", "Kinds of faults flown together", caption, figure)


# Page


def page(hunted: Hunted, searched: Sequence[HuntFlight], pictures: Sequence[Picture]) -> str:
    summary, space = hunted.summary, hunted.space
    violation = summary.violation
    return rendered(
        "hunt.html.j2",
        pictures,
        "zsim_analysis.hunt",
        summary=summary,
        facts=facts(hunted.request, summary),
        found=[cause_text(violation.found, each) for each in causes_of(violation.found)] if violation else [],
        faults=[fault_text(fault) for fault in violation.shrunk.faults] if violation else [],
        command=command(hunted),
        record=f"{VIOLATION}/report.html",
        number=number,
        kinds=[kind_row(space.kinds[name], searched) for name in space.kinds],
        causes=[(each.text, number(each.without), number(each.alone)) for each in violation.causes]
        if violation
        else [],
        stages=[(each.name, each.flights, f"{each.wall_s:.1f}") for each in summary.stages],
    )


def facts(request: HuntRequest, summary: HuntSummary) -> list[tuple[str, str]]:
    budget = [f"{request.flights} flights"] if request.flights is not None else []
    budget += [f"{request.budget_s:g} s"] if request.budget_s is not None else []
    return [
        ("Scenario", summary.scenario),
        ("Required", "; ".join(summary.requirements)),
        ("Verdict", summary.verdict),
        ("Drawn with seed", f"{summary.seed}, within {' and '.join(budget) or 'no limit'}"),
        ("Flights", f"{summary.flights} in {summary.wall_s:.0f} s"),
        ("Version", summary.version),
    ]


def kind_row(space: KindSpace, searched: Sequence[HuntFlight]) -> list[str]:
    """Return the row of a kind: its flights, smallest margin, targets, and flights by quarter of each range."""
    matching = [(each, fault) for each in searched for fault in each.case.faults if fault["kind"] == space.name]
    min_share = min((each.worst.share for each, _ in matching), default=None)
    targets = {fault["target"] for _, fault in matching}
    parts = [f"{len(targets)} of {len(space.knobs['target'].choices)} targets"] if matching else []
    for name, knob in space.knobs.items():
        if matching and knob.shape != "choice":
            positions = [knob.position(fault[name]) for _, fault in matching if fault.get(name) is not None]
            quarters = np.histogram(positions, QUARTERS, (0.0, 1.0))[0]
            parts.append(f"{name} {'/'.join(map(str, quarters))}")
    return [space.name, str(len(matching)), "–" if min_share is None else f"{min_share:.0%}", ", ".join(parts)]


def number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"


def command(hunted: Hunted) -> str:
    """Return the command that repeats the violation; empty if nothing was violated."""
    request, violation = hunted.request, hunted.summary.violation
    set_options = [word for change in request.changed for word in ("--set", change)]
    return (
        shlex.join(["zsim", "run", request.source, *set_options, *violation.options, "--in-process"])
        if violation
        else ""
    )


def terminal_text(hunted: Hunted) -> Group:
    """Return the violation with its causes, and the combinations tried, for the terminal."""
    summary = hunted.summary
    names = {1: "kinds", 2: "pairs", 3: "triples"}
    tried = ", ".join(f"{each.tried} of {each.possible} {names[each.together]}" for each in summary.coverage)
    lines: list[Text | FittedTable] = [
        Text(printable(f"{summary.flights} flights in {summary.wall_s:.0f} s; tried: {tried}"))
    ]
    stages = [[each.name, str(each.flights), f"{each.wall_s:.1f} s"] for each in summary.stages]
    lines.append(FittedTable([Column("stage", "name"), Column("flights"), Column("time")], stages, "What it took"))
    if found := summary.violation:
        columns = [Column("cause", "text"), Column("without it"), Column("with it alone")]
        rows = [[each.text, number(each.without), number(each.alone)] for each in found.causes]
        title = (
            f"{found.requirement}: violated in flight {found.number}, margin {found.unknown or number(found.margin)}"
        )
        lines.append(FittedTable(columns, rows, title, "margins; < 0: violated"))
        lines.append(Text(printable(f"fly it again: {command(hunted)}")))
    return Group(*lines)
