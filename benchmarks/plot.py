"""Pictures of a sheet: one line per contender over the size, both axes logarithmic."""

from collections.abc import Mapping
from pathlib import Path

from benchmarks.sheet import Sheet


def lines(sheet: Sheet, labels: Mapping[str, str], path: Path, title: str, size_name: str, ours: str = "zsim") -> None:
    """Draw medians with their spread; contenders whose name begins with `ours` are drawn bold."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    mpl.rcParams["svg.hashsalt"] = "zsim"  # the same figures give the same file
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
