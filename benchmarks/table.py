"""Markdown tables of a sheet."""

from collections.abc import Mapping, Sequence

from benchmarks.sheet import Sheet, Spread


def figure(value: float) -> str:
    """Return three significant digits without an exponent."""
    if value == 0.0:
        return "0"
    if abs(value) >= 1000:
        return f"{float(f'{value:.3g}'):,.0f}".replace(",", " ")
    return f"{value:.3g}"


def spread(found: Spread | None) -> str:
    """Return "median (least to greatest)"."""
    return f"{figure(found.median)} ({figure(found.low)} to {figure(found.high)})" if found else "–"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def ratios(sheet: Sheet, labels: Mapping[str, str], reference: str, size_name: str = "N") -> str:
    """Return a table of the reference's values, and every other contender as a multiple of it in the same repeat."""
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
    """Return the ratio, or why there is none."""
    found = sheet.ratio(name, reference, size)
    return spread(found) if found else sheet.refused.get(f"{name}@{size}", "–")
