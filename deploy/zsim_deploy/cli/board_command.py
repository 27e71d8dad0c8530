"""`zsim board`: formation laws compared in the same scenarios."""

import signal
import sys
import time
from pathlib import Path
from typing import Annotated

import typer
from typer import BadParameter, Option

from zsim_analysis.report import FORMATS
from zsim_deploy import INTERRUPTED
from zsim_deploy import arguments as opt
from zsim_deploy.arguments import failed, note, require, say
from zsim_deploy.cli.run_commands import SWEEP_NEEDS

app = typer.Typer()


@app.command(rich_help_panel=opt.RUN)
def board(
    laws: Annotated[
        str | None,
        Option(help="Names with commas, or package.module:Class of your own (default all).", show_default=False),
    ] = None,
    scenarios: Annotated[str | None, Option(help="Names with commas (default all).", show_default=False)] = None,
    seeds: Annotated[int, Option(min=1, max=1000, help="Flights of each law in each scenario.")] = 3,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder (default runs/board-TIME); an unfinished one is continued.")
    ] = None,
    workers: Annotated[int | None, Option(min=1, max=1024, help="Processes (default: one per core).")] = None,
    formats: Annotated[
        str | None, Option("--format", help="pdf, svg or pdf,svg: figures are written so too.", show_default=False)
    ] = None,
    force: Annotated[bool, Option("--force", help="Use a folder that holds other files, too.")] = False,
    papers: Annotated[
        bool, Option("--papers", help="Fly nothing: compute figures of the laws' papers again, numbers side by side.")
    ] = False,
) -> None:
    """Fly formation laws in the same scenarios, with the same seeds and sensors: one table, with figures."""
    require("sweep", SWEEP_NEEDS)
    from rich.console import Console

    from zsim.runtime.progress import PipedConsole, cell

    if papers:
        if laws or scenarios or formats:
            raise BadParameter("--papers flies no law in a scenario; leave --laws, --scenarios and --format out")
        from zsim_analysis.board.paper_figures import terminal_table, write_papers

        place = out or Path("runs") / "papers"
        with Console(stderr=True).status("computing …") as status:
            found = write_papers(place, lambda text: status.update(cell(text)))
        PipedConsole().print(terminal_table(found))
        say(f"figures: {place}")
        return
    from zsim_analysis.board.board import BoardRequest, fly_board
    from zsim_analysis.board.board_report import make_board_report, terminal_text
    from zsim_analysis.board.entries import LAW_NAMES, chosen, scenario_names

    wanted = tuple(formats.split(",")) if formats else ()
    if not set(wanted) <= set(FORMATS):
        raise BadParameter(f"--format is {formats!r}; must be {' or '.join(FORMATS)}, or both with a comma between")
    folder = out or Path("runs") / f"board-{time.strftime('%Y%m%d-%H%M%S')}"
    request = BoardRequest(
        chosen(laws, LAW_NAMES, "--laws", open_to_classes=True),
        chosen(scenarios, scenario_names(), "--scenarios"),
        seeds,
        folder,
        workers,
        force,
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        rows = fly_board(request)
    except KeyboardInterrupt:
        note(f"interrupted; the same command with --out {folder} goes on")
        sys.exit(INTERRUPTED)
    with Console(stderr=True).status("drawing …") as status:
        made = make_board_report(request, rows, lambda text: status.update(cell(text)), wanted)
    PipedConsole().print(terminal_text(made))
    say(f"report: {folder / 'report.html'}")
    say(f"table: {folder / 'board.csv'}")
    failures = [row["failure"] for row in rows if row["failure"]]
    if failures:
        raise failed(f"{len(failures)} of {len(rows)} flights failed: {failures[0]}")
