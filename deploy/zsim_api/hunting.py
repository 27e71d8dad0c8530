"""Flights of a hunt in which processes die: flown as real processes, by `zsim run`."""

from pathlib import Path

from zsim.errors import RunError
from zsim.output_folder import RECORD
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim_api import run_folder
from zsim_api.flight import COMMAND, LAUNCHER
from zsim_api.programs import Program, search_path


def fly_as_processes(scenario: Scenario, folder: Path) -> None:
    """Fly a resolved scenario as processes of this machine, into a new folder of a run.

    Raises:
        RunError: nothing was recorded; with the last line that `zsim run` printed.
    """
    log = folder / run_folder.LOGS / f"{LAUNCHER}.log"
    log.parent.mkdir(parents=True)
    file = folder / run_folder.SCENARIO
    file.write_text(scenario_file.to_text(scenario), encoding="utf-8")
    words = [*COMMAND, "run", str(file), "--out", str(folder), "--force", "--no-report"]
    program = Program(words, {"PYTHONPATH": search_path(plugin.folders())}, log)
    try:
        code = program.wait()
    finally:
        program.close()
    if not (folder / RECORD).exists():
        said = log.read_text(errors="replace").split("\n")
        last = next((line for line in reversed(said) if line.strip()), f"`zsim run` ended with code {code}")
        raise RunError(f"{folder}: nothing was recorded: {last}")
