"""Markdown tables and pictures of a sheet."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.peers import ROOT
from benchmarks.sheet import Sheet, Spread


def figure(value: float) -> str:
    """Format a value with three significant digits, without an exponent."""
    if value == 0.0:
        return "0"
    if abs(value) >= 1000:
        return f"{float(f'{value:.3g}'):,.0f}".replace(",", " ")
    return f"{value:.3g}"


def spread(found: Spread | None) -> str:
    """Format a spread as "median (minimum to maximum)"."""
    return f"{figure(found.median)} ({figure(found.low)} to {figure(found.high)})" if found else "–"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def ratios(sheet: Sheet, labels: Mapping[str, str], reference: str, size_name: str = "N") -> str:
    """Return a table of the reference's values, and of the others' as multiples of it in the same repeat."""
    sizes = sheet.sizes()
    rows = [[f"{labels[reference]} [{sheet.unit}]", *(spread(sheet.spread(reference, size)) for size in sizes)]]
    for name, label in labels.items():
        if name == reference:
            continue
        if name in sheet.values:
            cells = [_cell(sheet, name, reference, size) for size in sizes]
            rows.append([label, *cells])
        else:
            rows.append([label, f"not measured: {sheet.refused.get(name, 'left out')}", *[""] * (len(sizes) - 1)])
    return table(["", *(f"{size_name} = {size}" for size in sizes)], rows)


def _cell(sheet: Sheet, name: str, reference: str, size: int) -> str:
    """Return the ratio to the reference, or why it is missing."""
    found = sheet.ratio(name, reference, size)
    return spread(found) if found else sheet.refused.get(f"{name}@{size}", "–")


def lines(sheet: Sheet, labels: Mapping[str, str], path: Path, title: str, size_name: str, ours: str = "zsim") -> None:
    """Draw medians with their spread as SVG, in bold for contenders whose names begin with `ours`."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    mpl.rcParams["svg.hashsalt"] = "zsim"  # fixed, so that the same values give the same file
    figure, axes = plt.subplots(figsize=(8.0, 5.0), layout="constrained")
    for number, (name, label) in enumerate(labels.items()):
        found = {size: s for size in sheet.sizes() if (s := sheet.spread(name, size))}
        if not found:
            continue
        middle = [s.median for s in found.values()]
        errors = [[s.median - s.low for s in found.values()], [s.high - s.median for s in found.values()]]
        style = {"linewidth": 2.5, "marker": "o"} if name.startswith(ours) else {"linewidth": 1.0, "marker": "."}
        axes.errorbar(list(found), middle, errors, label=label, capsize=2, color=f"C{number % 10}", **style)
    axes.set(xscale="log", yscale="log", xlabel=size_name, ylabel=sheet.unit, title=title)
    axes.set_xticks(sheet.sizes(), [str(size) for size in sheet.sizes()])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


PAGE = ROOT / "benchmarks" / "README.md"
PICTURES = ROOT / "benchmarks" / "results"


def replaced(text: str, part: str, content: str) -> str:
    """Replace the section of a part in a page; raise ValueError if the page has no such section."""
    begin, end = f"<!-- measured: {part} -->\n", f"<!-- end: {part} -->"
    before, found, rest = text.partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise ValueError(
            f"benchmarks/README.md: has no lines {begin.strip()} and {end}; put them where part {part} goes"
        )
    return f"{before}{begin}{content.strip()}\n{end}{after}"


def update(part: str, content: str, page: Path = PAGE) -> None:
    page.write_text(replaced(page.read_text(), part, content))
