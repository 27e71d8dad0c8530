"""Classes of a script as processes: the bits of one process, their errors, and no process left after Ctrl-C."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import pytest
from federation import PAIR, Federation
from forked_commands import run_here

import zsim
from zsim.errors import RunFailedError

SCRIPT = dedent(
    """
    import sys
    import zsim
    from zsim_agents.formation.control_law import ControlLaw

    class Slow(ControlLaw):
        def rates(self, c, p_W, v_W, c_des, c_dot_des):
            return 0.5 * self.space.difference(c_des, c) + c_dot_des

    class Lander(zsim.Agent):
        reads = ("drone/*/sensor/status",)
        def __init__(self, at_s):
            self.at_s = at_s
        def receive(self, key, message):
            pass
        def step(self, t_ns):
            if self.at_s < 0 and t_ns >= 2_000_000_000:
                raise LookupError("of the script")
            return [self.command(t_ns, "drone2", zsim.land())] if t_ns == self.at_s * 1e9 else []

    def fly(name, at_s, **how):
        return zsim.run("pair.yaml", law=Slow, agents=[Lander(at_s)], out=name, **{'progress': False, **how})
    """
)


def script(folder: Path, text: str) -> subprocess.Popen[str]:
    (folder / "pair.yaml").write_text(PAIR)
    (folder / "flown.py").write_text(SCRIPT + text)
    command = [sys.executable, "flown.py"]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_script_flies_the_same_bits_in_several_processes_and_in_one(tmp_path: Path) -> None:
    text = "for name, how in (('one', {}), ('many', {'processes': True})):\n    print(fly(name, 9.0, **how).truth_sha256)\n"
    said, errors = script(tmp_path, text).communicate()
    one, many = said.split()
    assert one == many, errors
    run = zsim.load(tmp_path / "many")
    assert run.commands("drone2", "mode")["source"].iloc[-1] == "agent.lander"
    assert {process["name"] for process in run.summary.participants} >= {"agent.lander", "controller.main"}
    again = run_here("rerun", str(tmp_path / "many"), "--trust")
    assert again.code == 0, again.stderr
    assert one in again.stdout


def test_an_exception_in_a_process_is_in_its_log_and_in_the_error(tmp_path: Path) -> None:
    program = script(tmp_path, "fly('many', -1.0, processes=True)\n")
    _, errors = program.communicate()
    assert program.returncode == 1
    last = errors.rstrip().splitlines()[-1]
    assert last.startswith("zsim.errors.RunFailedError: agent.lander at 2.00 s: ")
    assert "LookupError: of the script" in last
    log = (tmp_path / "many" / "logs" / "agent.lander.log").read_text()
    assert 'LookupError("of the script")' in log
    assert "Traceback (most recent call last):" in log
    assert zsim.load(tmp_path / "many").duration_s >= 2.0


def test_ctrl_c_ends_the_processes_of_a_script(tmp_path: Path, federation: Federation) -> None:
    program = script(tmp_path, "fly('many', 1e6, processes=True, duration_s=1e5, progress=True)\n")
    assert program.stderr is not None
    assert any("engaged" in line for line in program.stderr)
    os.kill(program.pid, signal.SIGINT)
    _, errors = program.communicate()
    assert "KeyboardInterrupt: interrupted; zsim.load('many')" in errors
    assert zsim.load(tmp_path / "many").summary.record.complete
    federation.nobody_left()


class TwoRates(zsim.ControlLaw):
    def rates(self, c: Any, p_W: Any, v_W: Any, c_des: Any, c_dot_des: Any) -> Any:
        return c[:2]


@pytest.mark.soak  # the next test has the same law and error
def test_a_law_that_fails_before_the_first_gate_fails_the_run(tmp_path: Path, compiled: None) -> None:
    (tmp_path / "pair.yaml").write_text(PAIR)
    with pytest.raises(RunFailedError, match=r"TwoRates\.rates .*\(2,\)"):
        zsim.run(tmp_path / "pair.yaml", law=TwoRates, processes=True, out=tmp_path / "many", progress=False)


def test_a_waiting_test_receives_the_error_of_its_law(tmp_path: Path, forked: None) -> None:
    (tmp_path / "pair.yaml").write_text(PAIR)
    with zsim.Federation(tmp_path / "pair.yaml", law=TwoRates, out=tmp_path / "run") as flight:  # noqa: SIM117
        with pytest.raises(RunFailedError, match=r"TwoRates\.rates .*\(2,\)"):
            flight.wait_until("engaged")


def test_an_injected_fault_starts_at_a_reproducible_gate(tmp_path: Path, forked: None) -> None:
    (tmp_path / "pair.yaml").write_text(PAIR)
    bias = {"kind": "gyro_bias", "target": "drone2", "for_s": 2, "value_deg_s": [3, 0, 0]}
    runs = []
    for name in ("one", "two"):
        delay = {"time.command_delay_gates": 5}
        with zsim.Federation(tmp_path / "pair.yaml", 6, set=delay, out=tmp_path / name) as flight:
            flight.wait_until(5.0)
            flight.inject(bias)
            runs.append(flight.run())
    begun = [run.events.index[run.events.kind == "fault"][0] for run in runs]
    assert begun == [pytest.approx(5.12)] * 2
    assert len({run.truth_sha256 for run in runs}) == 1


class Pushed(zsim.PolicyAgent):
    observe, action, step_s = "estimate", "cluster", 0.1

    def policy(self, observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {agent: 0.3 * np.tanh(seen[:8]) for agent, seen in observations.items()}


def test_a_policy_as_a_process_flies_the_bits_of_its_environment(tmp_path: Path, forked: None) -> None:
    (tmp_path / "pair.yaml").write_text(PAIR)
    how: Any = {"observe": Pushed.observe, "action": Pushed.action, "step_s": Pushed.step_s}
    env = zsim.parallel_env(tmp_path / "pair.yaml", reward=lambda sim, agent: 0.0, duration_s=8, **how)
    seen, _ = env.reset(seed=5)
    while env.agents:
        seen, *_ = env.step(Pushed().policy(seen))
    run = zsim.run(env.sim.source, agents=[Pushed], processes=True, out=tmp_path / "many", progress=False)
    assert run.truth_sha256 == env.sim.truth_sha256
    assert run.commands("drone1")["source"].iloc[-1] == "agent.pushed"
