"""A flight bundled in one file is flown again elsewhere, and differences are reported."""

import importlib
import shutil
import socket
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import pytest
from federation import Federation
from forked_commands import Completed, run_here
from refused import has_terms

from zsim.contract import keys
from zsim.record import RecordReader, RecordWriter
from zsim_analysis.bundle.bundle_file import MODULES, RECORD, open_bundle, write_bundle
from zsim_analysis.report.figure_style import ReportFigure

OWN = """
name: own
seed: 5
duration_s: 4.5
drones:
  - {name: d1, position_m: [0, 0, 0]}
  - {name: d2, position_m: [4, 0, 0]}
agents: {climber: {class: 'climbing.climber:Climber', per: drone}}
"""
CLIMBER = """
import zsim
import heights


class Climber(zsim.Agent):
    reads = ("drone/{drone}/sensor/status",)

    def __init__(self, drone, scenario):
        super().__init__()
        self.drone, self.state = drone, "landed"

    def receive(self, key, message):
        self.state = message.state

    def step(self, t_ns):
        if self.state == "landed":
            return [self.command(t_ns, self.drone, zsim.takeoff())] if t_ns == 100_000_000 else []
        return [self.command(t_ns, self.drone, zsim.velocity(0.1, 0.0, heights.RATE_M_S))]
"""


@pytest.fixture
def flown(federation: Federation) -> Path:
    """Return the run folder of OWN, flown as processes; its class is in a package that imports another module."""
    package = federation.folder / "climbing"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "climber.py").write_text(CLIMBER)
    (federation.folder / "heights.py").write_text("RATE_M_S = 0.2\n")
    federation.run(OWN).ends(with_code=0)
    return federation.out


def forget(folder: Path | None = None) -> None:
    """Remove the modules of OWN from this process and, if given, from a folder."""
    for name in ("heights", "climbing", "climbing.climber"):
        sys.modules.pop(name, None)
    importlib.invalidate_caches()
    if folder:
        (folder / "heights.py").unlink()
        shutil.rmtree(folder / "climbing")


def command(*words: object, code: int = 0) -> Completed:
    done = run_here(*map(str, words))
    assert done.code == code, done
    return done


def test_a_bundle_is_reproducible_and_rerun_elsewhere(
    federation: Federation, flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OWN is flown as processes and in one process; both are bundled, and the first is rerun without OWN's modules.

    Expected: a bundle has the same bytes each time and, without the record, however OWN was flown; it holds no trace of
    this machine; without --trust it is refused in one line; with or without the record, it is rerun to the same bits.
    """
    once, twice, bare, other = (tmp_path / f"{name}.zsim" for name in ("once", "twice", "bare", "other"))
    command("bundle", flown, "-o", once)
    command("bundle", flown, "-o", twice)
    assert once.read_bytes() == twice.read_bytes()
    command("bundle", flown, "-o", once, code=2)
    monkeypatch.setattr(ReportFigure, "png", lambda figure: figure.name.encode())  # saves a second per bundle
    command("bundle", flown, "-o", bare, "--no-record")
    alone = federation.folder / "alone"
    command("run", federation.folder / "scenario.yaml", "--in-process", "--no-report", "--out", alone)
    command("bundle", alone, "-o", other, "--no-record")
    assert bare.read_bytes() == other.read_bytes()

    with open_bundle(once) as (manifest, folder):
        assert {f"{MODULES}/heights.py", f"{MODULES}/climbing/climber.py", "figures/drones.csv"} <= set(manifest.files)
        assert set(manifest.outputs) == {f"drone/{d}/{of}" for d in ("d1", "d2") for of in OUTPUTS}
        assert list(places_of(folder / RECORD, str(federation.folder), socket.gethostname())) == []
    assert str(federation.folder).encode() not in once.read_bytes()

    forget(federation.folder)
    monkeypatch.chdir(tmp_path)
    refusal = command("rerun", once, code=2)
    assert has_terms(refusal.stderr, "once.zsim", "climbing.climber:Climber", "--trust")
    for bundle in (once, bare):
        done = command("rerun", bundle, "--trust")
        assert has_terms(done.stdout, "truth_sha256", manifest.truth_sha256)
        assert has_terms(done.stdout, "own", "4.5", "s", "2", "drones")


OUTPUTS = ("estimate", "cmd/mode", "cmd/velocity")


def places_of(record: Path, folder: str, host: str) -> list[str]:
    """Return the keys of a record's messages with a text that contains `folder` or equals `host`."""
    with RecordReader(record) as reader:
        contents = ((each.key, msgpack.unpackb(each.payload)) for each in reader.messages(by_time=False))
        return [key for key, content in contents if any(folder in text or text == host for text in texts(content))]


def texts(content: Any) -> list[str]:
    if isinstance(content, dict | list):
        return [text for each in (content.values() if isinstance(content, dict) else content) for text in texts(each)]
    return [content] if isinstance(content, str) else []


def test_differences_in_a_rerun_are_reported(flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bundles of OWN differ from their rerun in an estimate, in the truth, or in the digest of the commands.

    Expected: a line gives the key, the instant and, where there is a record, the field with both values; another gives
    what is known of the machines. A cut record cannot be bundled, nor, without its record, a run that others steered.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("zsim_analysis.bundle.make_bundle.figures", lambda *_: iter(()))

    def shifted(key: str, content: dict[str, Any]) -> dict[str, Any]:
        if key == "drone/d2/estimate" and content["t_ns"] == 1_000_000_000:
            content["position_m"][1] = 7.5
        return content

    command("bundle", doctored(flown, tmp_path / "estimate", shifted), "-o", "estimate.zsim")
    done = command("rerun", "estimate.zsim", "--trust", code=1)
    assert has_terms(done.stderr.splitlines()[-1], "drone/d2/estimate", "1.00", "position_m[1]", "7.5", "record")
    assert has_terms(done.stderr, "machines")

    def elsewhere(key: str, content: dict[str, Any]) -> dict[str, Any]:
        if key == "drone/d1/truth" and content["t_ns"] == 2_000_000_000:
            content["velocity_m_s"][2] = 9.5
        return content

    command("bundle", doctored(flown, tmp_path / "truth", elsewhere), "-o", "truth.zsim")
    done = command("rerun", "truth.zsim", "--trust", code=1)
    assert has_terms(done.stderr.splitlines()[-1], "d1", "2.000", "velocity_m_s[2]", "9.5", "drone/d1/truth")

    command("bundle", flown, "-o", "bare.zsim", "--no-record")
    forget()
    faster = resealed(Path("bare.zsim"), f"{MODULES}/heights.py", b"RATE_M_S = 0.3\n")
    done = command("rerun", faster, "--trust", code=1)
    assert has_terms(done.stderr.splitlines()[-1], "truth", "drone/d1/cmd/velocity", "gate")

    def steered(key: str, content: dict[str, Any]) -> dict[str, Any]:
        if key == "drone/d1/cmd/velocity" and content["t_ns"] == 4_000_000_000:
            content["source"] = "operator.pilot"
        return content

    done = command("bundle", doctored(flown, tmp_path / "steered", steered), "--no-record", code=2)
    assert has_terms(done.stderr, "operator.pilot", "--no-record")
    cut = tmp_path / "cut.mcap"
    whole = (flown / RECORD).read_bytes()
    cut.write_bytes(whole[: len(whole) // 2])
    assert has_terms(command("bundle", cut, code=2).stderr, "cut.mcap", "incomplete")


def doctored(run: Path, into: Path, change: Callable[[str, dict[str, Any]], dict[str, Any]]) -> Path:
    """Rewrite the record of a run with messages changed."""
    into.mkdir()
    with RecordReader(run / RECORD) as reader, RecordWriter(into / RECORD) as writer:
        for each in reader.messages(by_time=False):
            payload = msgpack.packb(change(each.key, msgpack.unpackb(each.payload))) or b""
            writer.add(each.key, payload, "", each.t_ns, each.wall_ns)
        assert keys.INFO in reader.topics()
    return into


def resealed(bundle: Path, name: str, content: bytes) -> Path:
    """Rewrite a bundle with one member replaced and a valid seal, as a forger would."""
    with open_bundle(bundle) as (manifest, _), zipfile.ZipFile(bundle) as archive:
        members: dict[str, Any] = {each: archive.read(each) for each in manifest.files}
    return write_bundle(bundle.with_name("resealed.zsim"), manifest, {**members, name: content}, force=False).path
