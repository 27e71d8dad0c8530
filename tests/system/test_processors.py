"""The same bits on every processor: the golden flights under settings of other processors, C libraries and BLAS."""

import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import golden_flights
import pytest
import yaml
from forked_commands import run_here

import zsim
from zsim_deploy.cli.hosts_commands import older_processor

GOLDEN: dict[str, str] = yaml.safe_load(golden_flights.GOLDEN.read_text())
OLDER = older_processor()
GENERIC = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}  # takes a few minutes to compile
BLAS = ("Haswell", "Nehalem", "Sandybridge") if platform.machine() == "x86_64" else ("ARMV8", "NEOVERSEN1")
MIXED = ("step", "swarm", "ring10", "eyes")  # cover a triad, a radio, a template and sightings
BY_SETTING = [{name: value} for name, value in OLDER.items() if name != "OPENBLAS_CORETYPE"]
BY_SETTING += [{"OPENBLAS_CORETYPE": core} for core in BLAS]

LAW = """
import numpy as np
import zsim

class Bent(zsim.ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        pull = 1e3 * (np.exp(np.tan(1e-3 * self.space.difference(c_des, c))) - 1.0)
        mixed = np.eye(len(pull)) + 1e-3 * np.outer(pull, pull)
        return self.space.motion(c, c_dot_des + 0.3 * np.linalg.solve(mixed @ mixed, pull))
"""


def flown(settings: dict[str, str], *names: str) -> dict[str, str]:
    """Return the hashes of golden flights in a process with the given environment variables."""
    command = [sys.executable, "-P", golden_flights.__file__, *names]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **settings})
    assert done.returncode == 0, done.stderr
    return yaml.safe_load(done.stdout)


def golden(*names: str) -> dict[str, str]:
    return {name: GOLDEN[name] for name in names}


@pytest.mark.parametrize("name", golden_flights.scenarios())
def test_every_scenario_reproduces_its_golden_hash(name: str) -> None:
    assert golden_flights.fly(name) == GOLDEN[name]


def test_every_scenario_has_a_golden_hash() -> None:
    assert list(GOLDEN) == list(golden_flights.scenarios())


@pytest.mark.soak  # CI tests all settings together
@pytest.mark.parametrize("settings", BY_SETTING, ids=lambda each: "=".join(*each.items())[:40])
def test_one_processor_setting_does_not_change_the_hash(settings: dict[str, str]) -> None:
    assert flown(settings, "step") == golden("step")


def test_all_processor_settings_together_do_not_change_the_hashes() -> None:
    assert flown(OLDER, *MIXED) == golden(*MIXED)


@pytest.mark.soak
def test_generic_code_and_all_settings_do_not_change_the_hashes() -> None:
    assert flown({**OLDER, **GENERIC}, *GOLDEN) == GOLDEN


SHORT: dict[str, Any] = {
    "name": "short",
    "duration_s": 2,
    "drones": [{"name": "d1", "position_m": [0, 0, 0]}],
    "agents": {"pilot": {"class": "virtual_structure", "parameters": {"takeoff_s": 0.2}}},
}


def test_interpreted_code_gives_the_same_bits_without_warnings(tmp_path: Path) -> None:
    """As in a debugger: lanes without a drone cause no division by 0, and integers wrap around without a warning."""
    compiled = zsim.run(SHORT, out=tmp_path / "compiled", progress=False)
    script = f"import sys, zsim; print(zsim.run({SHORT}, out=sys.argv[1], progress=False).truth_sha256)"
    command = [sys.executable, "-P", "-c", script, str(tmp_path / "interpreted")]
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stderr, done.stdout) == (0, "", f"{compiled.truth_sha256}\n")


def test_doctor_finds_a_law_that_depends_on_the_processor(tmp_path: Path) -> None:
    (tmp_path / "bent.py").write_text(LAW)
    scenario = yaml.safe_load((golden_flights.ROOT / "scenarios" / "step.yaml").read_text())
    scenario["clusters"][0] |= {"law": "bent:Bent", "plan": {**scenario["clusters"][0]["plan"], "takeoff_s": 1}}
    (tmp_path / "bent.yaml").write_text(yaml.safe_dump(scenario))
    done = run_here("doctor", str(tmp_path / "bent.yaml"), "--duration", "12")
    assert done.code == 1
    assert "cmd/velocity" in done.stderr
    assert "differs" in done.stderr
