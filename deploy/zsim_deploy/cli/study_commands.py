"""Studies of many flights.

hunt     searches for a flight that breaks a requirement, and reduces it to the essential
board    compares formation laws in the same scenarios
"""

import signal
import sys
import time
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from typer import BadParameter, Option

from zsim_deploy import INTERRUPTED
from zsim_deploy import arguments as opt
from zsim_deploy.arguments import failed, note, require, say
from zsim_deploy.cli.run_commands import SWEEP_NEEDS

BUDGET_S = 600.0  # if neither --budget nor --flights is given
MOST = 3  # faults of one flight, chosen: software failures seldom need more conditions

app = typer.Typer()


@app.command(rich_help_panel=opt.RUN)
def hunt(
    scenario: opt.ScenarioPath,
    require_: Annotated[
        list[str] | None,
        Option("--require", help="What must hold: 'min_separation_m > 1.5', or module:function. Repeatable."),
    ] = None,
    budget: Annotated[str | None, Option(help="Wall time of the search, as 90s or 10min (default 10min).")] = None,
    flights: Annotated[int | None, Option(min=1, max=10**9, help="Flights of the search.", show_default=False)] = None,
    fault: Annotated[
        list[str] | None,
        Option(help="A kind to draw, and its ranges: 'gust velocity_m_s=1..6' (default all). Repeatable."),
    ] = None,
    without: Annotated[list[str] | None, Option(help="A kind not to draw. Repeatable.")] = None,
    most: Annotated[int, Option(min=0, max=6, help="Faults in one flight.")] = MOST,
    vary: Annotated[
        list[str] | None,
        Option(help="a.b.c=uniform(low,high), … as of a sweep (default wind.gust_m_s=uniform(0,2)). Repeatable."),
    ] = None,
    draws: Annotated[int, Option("--draws", min=0, max=2**62, help="Seed of the draws.")] = 1,
    set_: opt.Set = None,
    seed: opt.Seed = None,
    duration: opt.Duration = None,
    out: Annotated[Path | None, Option(help="Folder (default runs/NAME-hunt-TIME).", show_default=False)] = None,
    workers: opt.Workers = None,
    force: Annotated[
        bool, Option("--force", help="Replace an earlier hunt; accept a folder with other files.")
    ] = False,
) -> None:
    """Search for faults, wind and delays that break a requirement, and shrink them; exit code 1 if any are found."""
    require("hunt", SWEEP_NEEDS)
    from rich.console import Console

    from zsim.errors import ScenarioError
    from zsim.runtime.progress import PipedConsole, cell
    from zsim.scenario.faults import typed_duration_s
    from zsim_analysis.hunt.hunt import HuntRequest, hunt
    from zsim_analysis.hunt.hunt_report import make_hunt_report, terminal_text
    from zsim_analysis.hunt.space import WIND
    from zsim_analysis.sweep.design import read_document
    from zsim_api.flight import fly_as_processes
    from zsim_api.recorded import load

    try:
        budget_s = None if budget is None else typed_duration_s(budget)
    except ValueError as error:
        raise BadParameter(f"--budget {error}") from None
    document, faults = read_document(scenario, set_ or [], seed=seed, duration_s=duration)
    if faults:
        raise ScenarioError(faults)
    name = str(document.get("name", scenario.stem))
    request = HuntRequest(
        document=document,
        source=str(scenario),
        requirements=tuple(require_ or ()),
        out=out or Path("runs") / f"{name}-hunt-{time.strftime('%Y%m%d-%H%M%S')}",
        seed=draws,
        flights=flights,
        budget_s=BUDGET_S if budget_s is None and flights is None else budget_s,
        faults=tuple(fault or ()),
        without=tuple(without or ()),
        vary=tuple(vary or (WIND,)),
        changed=tuple(opt.changed_fields(set_, seed, duration)),
        most=most,
        workers=workers,
        force=force,
        open_run=partial(load, trust=True),
        processes=fly_as_processes,
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    hunted = hunt(request)
    summary = hunted.summary
    with Console(stderr=True).status("drawing …") as status:
        notes = make_hunt_report(hunted, lambda text: status.update(cell(text)))
    for text in notes:
        note(f"note: {text}")
    PipedConsole().print(terminal_text(hunted))
    say(f"report: {request.out / 'report.html'}")
    if summary.interrupted:
        note(f"interrupted; what was found so far is in {request.out}")
        sys.exit(INTERRUPTED)
    if summary.violation:
        raise failed(f"{summary.violation.requirement}: broken; the flight is {request.out / 'violation'}")


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
    workers: opt.Workers = None,
    formats: opt.Formats = None,
    force: Annotated[bool, Option("--force", help="Use a folder that holds other files, too.")] = False,
    papers: Annotated[
        bool, Option("--papers", help="Instead of flying, reproduce figures of the laws' papers and compare numbers.")
    ] = False,
) -> None:
    """Fly formation laws in the same scenarios with the same seeds and sensors: one table, with figures."""
    require("sweep", SWEEP_NEEDS)
    from rich.console import Console

    from zsim.runtime.progress import PipedConsole, cell

    if papers:
        if laws or scenarios or formats:
            raise BadParameter("--papers flies no law in a scenario; leave --laws, --scenarios and --format out")
        from zsim_analysis.board.papers import terminal_table, write_papers

        place = out or Path("runs") / "papers"
        with Console(stderr=True).status("computing …") as status:
            found = write_papers(place, lambda text: status.update(cell(text)))
        PipedConsole().print(terminal_table(found))
        say(f"figures: {place}")
        return
    from zsim_analysis.board.board import LAW_NAMES, BoardRequest, chosen, fly_board, scenario_names
    from zsim_analysis.board.board_report import make_board_report, terminal_text

    wanted = opt.figure_formats(formats)
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
        note(f"interrupted; the same command with --out {folder} continues")
        sys.exit(INTERRUPTED)
    with Console(stderr=True).status("drawing …") as status:
        made = make_board_report(request, rows, lambda text: status.update(cell(text)), wanted)
    PipedConsole().print(terminal_text(made))
    say(f"report: {folder / 'report.html'}")
    say(f"table: {folder / 'board.csv'}")
    failures = [row["failure"] for row in rows if row["failure"]]
    if failures:
        raise failed(f"{len(failures)} of {len(rows)} flights failed: {failures[0]}")
