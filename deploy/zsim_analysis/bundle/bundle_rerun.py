"""Flies a bundle again and compares the results with those stated in it."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from zsim import __version__
from zsim.contract import keys
from zsim.contract.fingerprint import fingerprint, machine, parts
from zsim.contract.framing import GateMessages
from zsim.errors import RunError
from zsim.record import RecordReader
from zsim.runtime.progress import PERIOD_S, Screen
from zsim.runtime.rate_limit import RateLimit
from zsim.scenario import scenario_file
from zsim.scenario.faults import listed
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim_agents.hosting import agents_of
from zsim_analysis.bundle import bundle_file as names
from zsim_analysis.bundle.bundle_file import Manifest, differing_packages, open_bundle, pins_of
from zsim_analysis.in_process import InProcessFlight
from zsim_analysis.reading import recorded_run
from zsim_analysis.reading.recorded_run import GateDigests, OutputHashes, content_of, first_difference
from zsim_analysis.rerun import rerun_record

Say = Callable[[str], None]
SHOWN = 8  # maximum number of differences listed in a line


def rerun_bundle(path: Path, commands_only: bool, say: Say, note: Say) -> str:
    """Fly a bundle again; return how the truth or an agent's outputs differ, empty if all are bit-identical.

    Args:
        path: path of the bundle.
        commands_only, say, note: as in `rerun_record`.

    Raises:
        RunError: the file is not a bundle or was changed, its scenario names code that may not be run, or
            `commands_only` is given for a bundle without a record.
        ScenarioError, RecordError: this version cannot read the bundle's scenario or record.
    """
    with open_bundle(path) as (manifest, folder):
        scenario = check_content(path, manifest, folder)
        lock = pins_of((folder / names.LOCK).read_text("utf-8"), f"{path}: {names.LOCK}")
        if differing := differing_packages([*lock, *manifest.needs]):
            note(f"packages differ: {_shown(differing)}; --install creates an environment with those of the bundle")
        if (folder / names.RECORD).exists():
            outputs = None if commands_only or manifest.not_run_again else manifest.outputs
            fault = rerun_record(folder / names.RECORD, commands_only, say, note, outputs)
        elif commands_only:
            raise RunError(f"{path}: has no {names.RECORD} with commands; omit --commands-only")
        else:
            if manifest.zsim != __version__:
                note(f"flown by zsim {manifest.zsim}, flown again by {__version__}: the same bits are not guaranteed")
            fault = _fly_again(manifest, folder, scenario, say)
        if fault:
            _note_machines(manifest, note)
        else:
            say(f"bit-identical: {manifest.name}, {manifest.duration_s:g} s, {len(scenario.drones)} drones")
        return fault


def check_content(path: Path, manifest: Manifest, folder: Path) -> Scenario:
    """Return the scenario of a bundle after checking that it matches the manifest and record and may be flown here.

    Raises:
        RunError: the scenario does not match the manifest or record, or names code that may not be run; or the bundle
            has neither record nor gates.
    """
    try:
        text = (folder / names.SCENARIO).read_text("utf-8")
    except UnicodeDecodeError as error:
        raise RunError(f"{path}: {names.SCENARIO} is not UTF-8 text ({error.reason})") from error
    if scenario_file.sha256(text) != manifest.scenario_sha256:
        raise RunError(f"{path}: was changed: the hash of {names.SCENARIO} does not match {names.MANIFEST}")
    record = folder / names.RECORD
    if record.exists():
        with RecordReader(record) as reader:
            recorded = reader.last(keys.INFO)
        info = recorded_run.decode_or_none(recorded) if recorded else None
        if info is None or info.scenario != text:
            raise RunError(f"{path}: was changed: {names.RECORD} does not match {names.SCENARIO}")
    elif not (folder / names.GATES).exists():
        raise RunError(f"{path}: contains neither {names.RECORD} nor {names.GATES}; must contain one of them")
    scenario = scenario_file.from_text(text)
    if (own := scenario.own_code()) and not plugin.may_import():
        raise RunError(f"{path}: its scenario names {listed(own)}: code that is run only with --trust")
    return scenario


def _fly_again(manifest: Manifest, folder: Path, scenario: Scenario, say: Say) -> str:
    """Fly the scenario of a bundle without a record; return how the results differ, empty if they do not."""
    plugin.search(folder / names.MODULES)
    flight = InProcessFlight(scenario)
    say(f"run again: world, {', '.join(agents_of(scenario))}")
    with Screen(scenario.duration_s) as screen:
        watch = _Watch(flight, manifest, screen)
        flight.run([watch])
    sha256, outputs = flight.world.result()["truth_sha256"], watch.hashes.hexdigests()
    differing = [key for key in sorted({*manifest.outputs, *outputs}) if manifest.outputs.get(key) != outputs.get(key)]
    if sha256 == manifest.truth_sha256 and not differing:
        say(f"truth_sha256 is the same: {sha256}")
        say(f"the agents' outputs are the same, on {len(outputs)} keys")
        return ""
    summary = "truth differs" if sha256 != manifest.truth_sha256 else f"outputs differ on {listed(differing)}"
    try:
        difference = first_difference((folder / names.GATES).read_bytes(), watch.digests.csv())
    except (ValueError, UnicodeError) as error:
        raise RunError(f"{names.GATES} cannot be read ({error}); must be as `zsim bundle` wrote it") from error
    if difference is None:
        return f"{summary}, in the last gates, which are not in {names.GATES}"
    t_ns, key = difference
    gate = f"gate {t_ns // flight.info.gate_ns} at {t_ns / 1e9:.2f} s"
    return f"{summary}, first {key} at {gate}; without a record, the field is unknown"


class _Watch:
    """Hashes the messages of a flight, as `make_bundle` hashes those of a record."""

    def __init__(self, flight: InProcessFlight, manifest: Manifest, screen: Screen) -> None:
        self.hashes, self.digests = OutputHashes(manifest.until_ns), GateDigests(manifest.until_ns)
        self._truth = {keys.truth(drone.name) for drone in flight.info.drones}
        self._screen, self._throttle, self._start_s = screen, RateLimit(PERIOD_S), time.monotonic()

    def add_message(self, key: str, message: Any, wall_ns: int) -> None:
        """Hash an agent's output."""
        if recorded_run.is_answer(key):
            self.hashes.add(key, message.t_ns, content := content_of(message))
            self.digests.add(key, message.t_ns, content)

    def add_gate(self, gate: GateMessages, wall_ns: int) -> None:
        """Hash the truth of a gate."""
        if self._throttle.spend():
            rate = gate.t_ns / 1e9 / max(1e-9, time.monotonic() - self._start_s)
            self._screen.clock({"t_s": gate.t_ns / 1e9, "rate": rate, "state": "again", "phase": "", "waiting_for": []})
        for (key, payload), t_ns in zip(gate.pairs, gate.stamps.tolist(), strict=True):
            if key in self._truth:
                self.digests.add(key, t_ns, payload)


def _note_machines(manifest: Manifest, note: Say) -> None:
    """Note the differences between the machine that flew the bundle and this one."""
    this_machine = {**machine(), **parts()}
    if not manifest.machine:
        fingerprints = f"its fingerprint is {', '.join(manifest.fingerprints)}, here {fingerprint()}"
        note(f"the machine that flew the bundle is unknown; {fingerprints}")
    elif differing := [
        f"{name} {manifest.machine.get(name, 'none')}, here {this_machine.get(name, 'none')}"
        for name in sorted({*manifest.machine, *this_machine})
        if manifest.machine.get(name) != this_machine.get(name)
    ]:
        note(f"the machines differ: {_shown(differing)}")
    else:
        note("the machines do not differ in any known respect")


def _shown(differing: list[str]) -> str:
    omitted = len(differing) - SHOWN
    return "; ".join(differing[:SHOWN]) + (f"; and {omitted} more" if omitted > 0 else "")
