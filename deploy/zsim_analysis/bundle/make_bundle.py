"""Makes the bundle of a run from its record, without absolute paths or host names."""

import ast
import base64
import csv
import importlib.metadata
import io
import json
import pickletools
import re
import socket
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import msgspec
from msgspec import UNSET
from packaging.requirements import Requirement

import zsim
from zsim import __version__
from zsim.contract import flight_messages, keys, messages
from zsim.contract.fingerprint import fingerprint, machine, parts
from zsim.errors import PACKAGES, DocumentError, RunError
from zsim.output_folder import record_at, temporary_folder
from zsim.record import RecordReader, RecordWriter
from zsim.record.completeness import record_completeness
from zsim.scenario import scenario_file
from zsim.scenario.faults import listed
from zsim.schema import plugin, yaml_file
from zsim_analysis.bundle import bundle_file as names
from zsim_analysis.bundle.bundle_file import (
    EXTRAS,
    MODULES,
    PART,
    Manifest,
    WrittenBundle,
    refuse_existing,
    write_bundle,
)
from zsim_analysis.reading import recorded_run
from zsim_analysis.reading.recorded_run import GateDigests, OutputHashes, RecordedAgents, RecordedRun, content_of
from zsim_analysis.report import indented_json
from zsim_analysis.report.make_report import figures
from zsim_analysis.report.summary import judge
from zsim_world.run.coordinator import FLIGHT_REQUESTS

PROJECT = "zsim"
BYTES_MAX = 50_000_000  # largest total size of users' modules, which should hold code, not data
MODULE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")
PATH = re.compile(r"(?<![\w./~-])(?:[A-Za-z]:)?[/\\](?:[^\s/\\:;,'\"()]+[/\\])+")  # the folders of an absolute path
FREE_TEXT = ("text", "reason", "error", "failure")  # message fields with free text
WALL_CLOCK_FIELDS = (
    *("run_id", "date", "changed", "versions", "fingerprint", "mode", "real_time_factor", "wall_s", "command_age_ms"),
    *("deadlines", "deadline_misses", "deadline_misses_by", "links", "participants", "events", "events_left_out"),
    *("record", "notes"),
)  # summary fields that describe the circumstances of a flight, not its results


def make_bundle(
    run_path: Path, out: Path | None, with_record: bool, force: bool, note: Callable[[str], None]
) -> WrittenBundle:
    """Write the bundle of a run.

    Args:
        run_path: the folder of the run, or its record.
        out: the bundle file; None: named after the scenario, in the working folder.
        with_record: whether to include the record; may be False only if the scenario alone reproduces the flight.
        force: whether to replace an existing file.
        note: called with a line on each thing that the bundle lacks or does not conceal.

    Raises:
        RunError: the record is not that of a complete flight that can be flown again, the scenario names something
            that a bundle cannot contain, or the file cannot be written.
    """
    record = record_at(run_path)
    completeness = record_completeness(record)
    if not completeness.complete:
        raise RunError(f"{run_path}: the record is {completeness}; must be that of a complete flight")
    with recorded_run.open_run(record) as run:
        out = out or Path(f"{run.scenario.name}{names.SUFFIX}")
        refuse_existing(out, force)  # before figures are drawn, which takes seconds
        _check(run_path, run)
        agents = recorded_run.recorded_agents(run.reader, run.info, run.scenario)
        expected = _Expected(run, agents)
        if not with_record and (reason := agents.why_not or expected.others):
            raise RunError(f"{run_path}: {reason}: only the record has that; omit --no-record")
        own_code = run.scenario.own_code()
        modules = collect_own_modules(own_code)
        lock, needs = package_pins(modules.packages)
        if lacking := sorted(modules.packages - {each.partition("==")[0].replace("-", "_") for each in needs}):
            note(f"{', '.join(lacking)}: not in a package index under this name; must be installed to fly the bundle")
        hosts = _Hosts(run.reader)
        folder = temporary_folder("bundle-")
        members: dict[str, Path | bytes] = {names.SCENARIO: run.info.scenario.encode(), **modules.files}
        members[names.LOCK] = "".join(f"{line}\n" for line in lock).encode()
        record_copy = folder / names.RECORD
        _copy_record(run.reader, record_copy, hosts, bool(modules.files), note)
        if with_record:
            members[names.RECORD] = record_copy
        else:
            members[names.GATES] = expected.digests.csv()
        was_flown_here = fingerprint() == run.info.fingerprint and hosts.are_only(socket.gethostname())
        if not was_flown_here:
            note("flown on a machine or by a version other than this one: the bundle does not name the machine")
        _add_figures(members, record_copy)
        manifest = Manifest(
            format=names.FORMAT,
            zsim=run.info.version,
            commit=zsim.commit() if run.info.version == __version__ else "",
            name=run.scenario.name,
            seed=run.scenario.seed,
            duration_s=run.scenario.duration_s,
            scenario_sha256=run.info.scenario_sha256,
            truth_sha256=agents.truth_sha256 or "",
            outputs=expected.hashes.hexdigests(),
            until_ns=recorded_run.answered_until_ns(run.reader, run.info),
            own_code=own_code,
            needs=needs,
            not_run_again=agents.why_not,
            fingerprints=sorted({run.info.fingerprint, *agents.fingerprints}),
            machine={**machine(), **parts()} if was_flown_here else {},
            files={},
        )
        members[names.README] = _readme(manifest, members).encode()
        return write_bundle(out, manifest, members, force)


def _check(run_path: Path, run: RecordedRun) -> None:
    """Raise RunError for a run that cannot be flown again elsewhere."""
    reader, info, scenario = run
    if reader.damaged:
        raise RunError(f"{run_path}: the record is damaged: {reader.damaged[0]}; must be intact")
    if info.replay_of:
        raise RunError(f"{run_path}: is the record of a replay; give that of run {info.replay_of}")
    if external := scenario.external():
        raise RunError(
            f"{run_path}: has drones whose bodies are external ({listed(external)}); they cannot be flown again"
        )
    if scenario_file.sha256(info.scenario) != info.scenario_sha256:
        raise RunError(f"{run_path}: its scenario does not match its recorded hash; must be as the world recorded it")
    for path, value in _texts(yaml_file.value(info.scenario)):
        if PATH.match(value):
            raise RunError(
                f"{run_path}: {path} is {value!r}, an absolute path, which no other machine has; must be relative"
            )


def _texts(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the texts in a document, with their paths."""
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, dict):
        for name, each in value.items():
            yield from _texts(each, f"{path}.{name}".lstrip("."))
    elif isinstance(value, list):
        for index, each in enumerate(value):
            yield from _texts(each, f"{path}[{index}]")


class _Expected:
    """Expected results of a rerun: `hashes` of the agents' outputs, and `digests` of outputs and truth, gate by gate.

    `others` names the inputs of the flight that did not come from the scenario; empty if all did.
    """

    def __init__(self, run: RecordedRun, agents: RecordedAgents) -> None:
        reader, info, scenario = run
        until_ns = recorded_run.answered_until_ns(reader, info)
        self.hashes, self.digests = OutputHashes(until_ns), GateDigests(until_ns)
        senders: set[str] = {"a request to a controller"} if agents.requests else set()
        for gate in recorded_run.gates(reader, [drone.name for drone in scenario.drones]):
            for recorded in gate.inputs:
                message = recorded_run.decode_or_none(recorded)
                if recorded.key == keys.EVENT:
                    if message is not None and message.kind == "control" and message.subject in FLIGHT_REQUESTS:
                        senders.add(f"{message.subject} by {message.source}")
                elif message is not None and recorded_run.is_answer(recorded.key):
                    sender = recorded_run.sender_of(recorded.key, message)
                    if sender in agents.names:
                        self.hashes.add(recorded.key, recorded.t_ns, content := content_of(message))
                        self.digests.add(recorded.key, recorded.t_ns, content)
                    else:
                        senders.add(f"outputs of {sender}")
                elif isinstance(message, flight_messages.Sightings):
                    senders.add(f"sightings of {message.source}")
            for drone, payload in gate.truth.items():
                self.digests.add(keys.truth(drone), gate.t_ns, payload)
        if scenario.own_programs or scenario.gates("camera"):
            senders.add("outputs of programs or cameras")
        ended_ns = until_ns + info.gate_ns + info.command_delay_ns
        if ended_ns + info.gate_ns <= scenario.duration_s * 1e9:
            senders.add(f"an early end, after {ended_ns / 1e9:g} of {scenario.duration_s:g} s")
        self.others = f"the flight had {', '.join(sorted(senders))}" if senders else ""


class _Hosts:
    """The hosts of a run, and the placeholders for their names in a bundle."""

    def __init__(self, reader: RecordReader) -> None:
        joins = (key for key in reader.topics() if keys.matches("process/*/join", key))
        decoded = (recorded_run.decode_or_none(each) for each in reader.messages(set(joins), by_time=False))
        self._names = dict.fromkeys(join.host for join in decoded if join is not None)
        self._stands_for = {name: f"host{count}" for count, name in enumerate(self._names, start=1)}
        spelled = "|".join(re.escape(name) for name in sorted(self._names, key=len, reverse=True) if name)
        self._pattern = re.compile(rf"(?<![\w.-])({spelled})(?![\w-])") if spelled else None

    def are_only(self, name: str) -> bool:
        return set(self._names) == {name}

    def removed(self, value: Any, field: str = "") -> Any:
        """Return a part of a message with host names replaced and folders removed."""
        if isinstance(value, dict):
            return {name: self.removed(each, str(name)) for name, each in value.items()}
        if isinstance(value, list):
            return [self.removed(each, field) for each in value]
        if not isinstance(value, str):
            return value
        if field == "host":
            return self._stands_for.setdefault(value, f"host{len(self._stands_for) + 1}")
        if field in FREE_TEXT:
            text = PATH.sub("", value)
            return self._pattern.sub(lambda match: self._stands_for[match[0]], text) if self._pattern else text
        return value


def _copy_record(
    reader: RecordReader, into: Path, hosts: _Hosts, has_modules: bool, note: Callable[[str], None]
) -> None:
    """Copy a record without host names and folders, but leave unchanged what drones and agents have published."""
    own_host = socket.gethostname().encode()
    noted: set[str] = set()
    with RecordWriter(into) as writer:
        for key, payload, t_ns, wall_ns in reader.messages(by_time=False):
            kind, _, leaf = keys.parts(key)
            if key == keys.INFO:
                payload = _without_folders(payload, has_modules)
            elif kind in ("clock", "world", "process") and key != keys.FAULTS and leaf not in ("done", "snapshot"):
                try:
                    content = msgpack.unpackb(payload)
                except (ValueError, msgpack.UnpackException):
                    content = None
                cleaned = hosts.removed(content)
                payload = payload if cleaned == content else msgpack.packb(cleaned) or b""
            elif len(own_host) > 3 and key not in noted and own_host in payload:
                noted.add(key)
                note(f"{key}: contains the name of this machine, and is bundled unchanged")
            writer.add(key, payload, messages.encoding(key), t_ns, wall_ns)


def _without_folders(payload: bytes, has_modules: bool) -> bytes:
    info = messages.decode(keys.INFO, payload)
    changed = info.changed if info.changed is UNSET else tuple(PATH.sub("", each) for each in info.changed)
    folders = (names.MODULES,) if has_modules else UNSET
    return messages.encode(msgspec.structs.replace(info, module_folders=folders, changed=changed))


# What a flight needs from this machine: users' modules, and packages with their versions
#
# Nothing is imported: modules are located as Python locates them, and their imports are read from their source. Imports
# whose names are assembled at run time are not found.


class OwnModules(NamedTuple):
    """Users' modules that are not in installed packages, by path in a bundle; and the packages that they import."""

    files: dict[str, Path]
    packages: set[str]  # names as in imports, up to the first dot


def collect_own_modules(names: Iterable[str]) -> OwnModules:
    """Return users' modules: those of the given classes, functions and modules, and all that these import in turn.

    Args:
        names: as returned by `Scenario.own_code`.

    Raises:
        DocumentError: a module is not found.
        RunError: the modules are too large or cannot be read.
    """
    modules = OwnModules({}, set())
    pending = [(name.partition(":")[0], True) for name in names]
    seen = set(PACKAGES) | set(sys.stdlib_module_names)
    while pending:
        name, is_needed = pending.pop()
        package = name.partition(".")[0]
        if package in seen:
            continue
        seen.add(package)
        try:
            spec = plugin.located(package, f"module {package}")
        except DocumentError:
            if is_needed:
                raise
            continue  # an optional import
        locations = (
            [Path(spec.origin)] if spec.origin else [Path(each) for each in spec.submodule_search_locations or ()]
        )
        if spec.origin in ("built-in", "frozen") or any(plugin.is_library(f"{location}") for location in locations):
            modules.packages.add(package)
            continue
        for path, inside in _sources(package, locations):
            modules.files[f"{MODULES}/{inside}"] = path
            if path.suffix == ".py":
                pending += [(each, False) for each in _imports(path)]
    size = sum(path.stat().st_size for path in modules.files.values())
    if size > BYTES_MAX:
        raise RunError(f"the scenario's own modules have {size} bytes; must be <= {BYTES_MAX}; keep data elsewhere")
    return modules


def _sources(package: str, locations: Iterable[Path]) -> Iterator[tuple[Path, str]]:
    """Yield the files of a module or a package, with their paths relative to the folder that contains it."""
    for location in locations:
        if location.is_file() and location.name != "__init__.py":
            yield location, location.name
            continue
        folder = location if location.is_dir() else location.parent
        for path in sorted(folder.rglob("*")):
            inside = path.relative_to(folder)
            is_valid_name = all(PART.fullmatch(part) for part in inside.parts)
            if is_valid_name and "__pycache__" not in inside.parts and path.is_file():
                yield path, f"{package}/{inside.as_posix()}"


def _imports(path: Path) -> set[str]:
    """Return the modules that a module imports; for one generated for a notebook's class, also those in its pickle."""
    try:
        tree = ast.parse(path.read_bytes())
    except (OSError, SyntaxError, ValueError) as error:
        raise RunError(f"{path}: cannot be read ({error})") from error
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    if path.name.startswith(plugin.MADE):
        texts = [
            node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
        ]
        pickled = base64.b64decode(max(texts, key=len))
        strings = {arg for _, arg, _ in pickletools.genops(pickled) if isinstance(arg, str)}
        names |= set(filter(MODULE.fullmatch, strings))
    return names


def package_pins(packages: Iterable[str] = ()) -> tuple[list[str], list[str]]:
    """Return lines NAME==VERSION for all packages that zsim and the given ones need, and those for the given ones.

    A package that was not installed from an index has no line.

    Args:
        packages: names as in imports.
    """
    by_import = importlib.metadata.packages_distributions()
    own_packages = {_canonical(name) for each in packages for name in by_import.get(each, ())}
    pins: dict[str, str] = {}
    pending = [(PROJECT, frozenset(EXTRAS)), *((name, frozenset[str]()) for name in sorted(own_packages))]
    seen: set[tuple[str, frozenset[str]]] = set()
    while pending:
        name, extras = pending.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            installed = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        is_from_index = "+" not in installed.version and not json.loads(installed.read_text("direct_url.json") or "{}")
        if name != PROJECT and is_from_index:
            pins[name] = f"{name}=={installed.version}"
        for line in installed.requires or ():
            needed = Requirement(line)
            if needed.marker is None or any(needed.marker.evaluate({"extra": extra}) for extra in extras or ("",)):
                pending.append((_canonical(needed.name), frozenset(needed.extras)))
    return sorted(pins.values()), sorted(pins[name] for name in own_packages if name in pins)


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()  # PEP 503


# Figures, results, README


def _add_figures(members: dict[str, Path | bytes], record: Path) -> None:
    """Add the report's figures, the curves of each as a table, and the numbers of the summary."""
    flight, formations, summary = judge(record, answers=True)
    for figure in figures(flight, formations, summary):
        members[f"{names.FIGURES}/{figure.name}"] = figure.png()
        members[f"{names.FIGURES}/{Path(figure.name).stem}.csv"] = _curve_table(figure.drawing)
    results = {name: value for name, value in msgspec.to_builtins(summary).items() if name not in WALL_CLOCK_FIELDS}
    members[names.RESULTS] = indented_json(results, "sorted")


def _curve_table(drawing: Any) -> bytes:
    """Return the curves of a figure as a table: panel, curve, x, y."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["panel", "curve", "x", "y"])
    for number, axes in enumerate(drawing.axes):
        panel = axes.get_ylabel() or number
        for count, curve in enumerate(axes.lines):
            label = curve.get_label()
            name = str(count) if label.startswith("_") else label
            writer.writerows([panel, name, f"{x:.9g}", f"{y:.9g}"] for x, y in zip(*curve.get_data(), strict=True))
    return file.getvalue().encode()


README = """# {name}

A flight of zsim, a co-simulator of drone formations, in one file: an ordinary zip archive.

To fly it again with zsim {zsim}{commit}, and check that every bit is the same:

    zsim rerun FILE{trust}

`--install` first creates an environment with the package versions of `{lock}`. A file that was changed is refused.

| | |
|---|---|
| scenario | `{scenario}`, as flown: {duration_s:g} s, seed {seed} |
| SHA-256 of the truth of all drones | `{truth_sha256}` |
| SHA-256 of the agents' outputs, by key | in `{manifest}` |
| flown on | {machine} |

| file | |
|---|---|
{files}

{code}
"""
WHAT = {
    names.SCENARIO: "the scenario, with all defaults and the seed",
    names.LOCK: "versions of the packages installed when the flight was bundled",
    names.RECORD: "every message of the flight: MCAP, opened by `zsim report`, Foxglove, or any MCAP library",
    names.GATES: "in place of the record: a checksum of each key at each gate, by which a difference is found",
    names.RESULTS: "errors of the formation, separations, and deviations of the flight from its plan",
    names.FIGURES: "the figures of the report, each with its curves as a table",
    names.MODULES: "the scenario's own Python modules, which run when it is flown again",
    names.MANIFEST: "the contents of the bundle, the SHA-256 of each part, and the results that a rerun must reproduce",
}


def _readme(manifest: Manifest, members: Mapping[str, Any]) -> str:
    parts_of = dict.fromkeys(name.partition("/")[0] for name in sorted([*members, names.MANIFEST]))
    code_text = ", ".join(manifest.own_code)
    own = f"The scenario names code of its own ({code_text}), which is run only with `--trust`: read it first."
    if any(Path(name).name.startswith(plugin.MADE) for name in members):
        own += (
            " The bundle contains classes of a notebook, pickled by Python; only the same version of Python reads them."
        )
    if manifest.not_run_again:
        own += f"\n\nIts agents are not run again; their commands are read from the record: {manifest.not_run_again}."
    return README.format(
        name=manifest.name,
        zsim=manifest.zsim,
        commit=f" (commit {manifest.commit})" if manifest.commit else "",
        trust=" --trust" if manifest.own_code else "",
        lock=names.LOCK,
        scenario=names.SCENARIO,
        duration_s=manifest.duration_s,
        seed=manifest.seed,
        truth_sha256=manifest.truth_sha256,
        manifest=names.MANIFEST,
        machine=", ".join(f"{name} {value}" for name, value in manifest.machine.items()) or "another machine",
        files="\n".join(f"| `{name}` | {WHAT[name]} |" for name in parts_of),
        code=own if manifest.own_code or manifest.not_run_again else "The scenario names no code of its own.",
    )
