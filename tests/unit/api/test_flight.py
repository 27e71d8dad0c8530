"""`zsim.run`: agents and laws of the caller, replaced fields, and the report of errors."""

import functools
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from pair_flight import PAIR
from refused import refused

import zsim
from zsim.errors import RunError, ScenarioError, UserCodeError, ZsimError
from zsim.runtime.progress import Screen
from zsim_agents.formation.control_law import ControlLaw
from zsim_analysis.in_process import fly

STATUS = "drone/*/sensor/status"


class Lander(zsim.Agent):
    """An agent that lands d2 at 5 s by default and counts its gates."""

    name = "lander.main"
    reads = (STATUS,)

    def __init__(self, at_s: float = 5.0) -> None:
        self.at_s = at_s
        self.gates = 0

    def receive(self, key: str, message: Any) -> None:
        """Ignore the message."""

    def step(self, t_ns: int) -> list[zsim.Output]:
        self.gates += 1
        return [self.command(t_ns, "d2", zsim.land())] if t_ns == self.at_s * 1e9 else []


class Failing(Lander):
    def step(self, t_ns: int) -> list[zsim.Output]:
        return [] if t_ns < 1e9 else {}["key"]


class Nan(ControlLaw):
    def rates(self, c: Any, p_W: Any, v_W: Any, c_des: Any, c_dot_des: Any) -> Any:
        return c * float("nan")


class Still(ControlLaw):
    def rates(self, c: Any, p_W: Any, v_W: Any, c_des: Any, c_dot_des: Any) -> Any:
        return c * 0.0


class TwoRates(ControlLaw):
    def rates(self, c: Any, p_W: Any, v_W: Any, c_des: Any, c_dot_des: Any) -> Any:
        return c[:2]


def test_a_user_s_agent_runs_beside_the_built_in_ones(tmp_path: Path) -> None:
    lander = Lander()
    run = zsim.run(PAIR, agents=[lander], out=tmp_path / "run", progress=False)
    assert lander.gates == 301
    assert run.commands("d2", "mode").source.tolist()[-1] == "lander.main"
    assert run.status("d2").state.iloc[-1] in ("landing", "landed")
    other = zsim.run(PAIR, agents=[Lander], out=tmp_path / "other", progress=False)
    assert other.truth_sha256 == run.truth_sha256
    assert zsim.run(PAIR, out=tmp_path / "none", progress=False).truth_sha256 != run.truth_sha256


def test_the_end_of_a_flight_is_shown() -> None:
    shown: list[dict[str, Any]] = []

    class Shown(Screen):
        def clock(self, line: dict[str, Any]) -> None:
            shown.append(line)

    fly(zsim.Scenario(**PAIR).resolved, None, screen=Shown(6.0))
    assert (shown[-1]["t_s"], shown[-1]["state"], shown[-1]["phase"]) == (6.0, "stopped", "engaged")


def test_fields_are_replaced_by_path_and_by_keyword(tmp_path: Path) -> None:
    scenario = zsim.Scenario(**PAIR).with_({"environment.wind.gust_m_s": 1.0}, duration_s=1)
    run = zsim.run(scenario, seed=9, out=tmp_path / "run", progress=False, set={"drones.d1.mass_kg": 0.5})
    flown = run.scenario.resolved
    assert (flown.seed, flown.duration_s, flown.environment.wind.gust_m_s) == (9, 1, 1.0)
    assert flown.drones[0].mass_kg == 0.5
    with refused(ScenarioError, "drones.d3.mass_kg=:", "d2"):
        zsim.run(scenario, set={"drones.d3.mass_kg": 1})
    with refused(RunError, "options", "processes=True"):
        zsim.run(scenario, options=["--hosted"])


def test_an_error_in_an_agent_is_raised_and_its_place_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(KeyError) as caught:
        zsim.run(PAIR, agents=[Failing], out=tmp_path / "run", progress=False)
    own = [frame.name for frame in caught.traceback if frame.path == Path(__file__)]
    assert own == [*own[:1], "step"]
    assert caught.traceback[-1].name == "step"
    assert not any("zsim/runtime" in str(frame.path) for frame in caught.traceback)
    assert "lander.main at 1.00 s" in capsys.readouterr().err
    assert zsim.load(tmp_path / "run").duration_s >= 1.0


@pytest.mark.parametrize(("law", "terms"), [(Nan, ("nan", "d1")), (TwoRates, ("(2,);", "(8,),"))])
def test_an_invalid_result_of_a_law_is_reported_with_class_and_shapes(
    law: type, terms: tuple[str, ...], tmp_path: Path
) -> None:
    with refused(UserCodeError, f"{law.__module__}:{law.__qualname__}.rates", *terms):
        zsim.run(PAIR, law=law, out=tmp_path / "run", progress=False)


SLOW = functools.partial(Nan, gains=None)


def test_a_law_that_fails_its_rehearsal_leaves_no_folder(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    made = type("Made", (Nan,), {})  # loaded from a module in the folder
    for out in (tmp_path / "run", mine):
        with pytest.raises(UserCodeError):
            zsim.run(PAIR, law=made, out=out, progress=False)
    assert [*tmp_path.rglob("*")] == [mine]
    zsim.run(PAIR, law=type("Made", (Still,), {}), duration_s=1, out=mine, progress=False)
    assert [*mine.glob("zsim_own_*.py")]
    (mine / "notes.txt").write_text("mine")
    with pytest.raises(UserCodeError):
        zsim.run(PAIR, law=made, out=mine, force=True, progress=False)
    assert [*mine.iterdir()] == [mine / "notes.txt"]


MISGIVEN: dict[str, tuple[dict[str, Any], type[ZsimError], tuple[str, ...]]] = {
    "a partial for a law": (
        {"law": SLOW},
        ScenarioError,
        ("law", "functools.partial(<class…", "class", "module:Class"),
    ),
    "a partial for an estimator": (
        {"estimator": SLOW},
        ScenarioError,
        ("estimation.algorithm", "functools.partial(<class…"),
    ),
    "a function for a law": ({"law": lambda space, gains: Nan(space)}, ScenarioError, ("law", "<function", "class")),
    "a law for an agent": ({"agents": [Nan]}, RunError, ("(space", "'space'")),
    "a number for an agent": ({"agents": [5]}, RunError, ("agent", "5", "zsim.Agent")),
    "a name for an agent": ({"agents": ["mine:Lander"]}, RunError, ("agent", "'mine:Lander'", "zsim.Agent")),
    "a partial with another argument": (
        {"agents": [functools.partial(Lander, to_s=3)]},  # pyright: ignore[reportCallIssue]
        RunError,
        ("functools.partial(<class…", "arguments"),
    ),
    "no sequence": ({"agents": Lander}, RunError, ("agents", "<class", "sequence")),
    "a text": ({"agents": "mine:Lander"}, RunError, ("agents", "'mine:Lander'", "sequence")),
}


@pytest.mark.parametrize("case", MISGIVEN)
def test_an_invalid_class_or_agent_is_refused_with_what_is_allowed(case: str) -> None:
    given, kind, terms = MISGIVEN[case]
    with refused(kind, *terms):
        zsim.run(PAIR, progress=False, **given)
    if "agents" in given:
        with refused(kind, *terms):
            zsim.Simulation(PAIR, **given)


def test_an_agent_can_be_created_by_a_partial(tmp_path: Path) -> None:
    agents = [functools.partial(Lander, at_s=1.0)]
    run = zsim.run(PAIR, agents=agents, duration_s=2, out=tmp_path / "run", progress=False)
    assert "lander.main" in run.commands("d2", "mode").source.tolist()


SCRIPT = """
import zsim

class Lander(zsim.Agent):
    reads = ("drone/*/sensor/status",)
    def receive(self, key, message): ...
    def step(self, t_ns):
        if t_ns == 1_000_000_000:
            print("flying", flush=True)
        return []

run = zsim.run({scenario!r}, duration_s=1e5, agents=[Lander], out={out!r}, progress=False)
"""


def test_ctrl_c_ends_a_flight_with_a_complete_record(tmp_path: Path) -> None:
    script = SCRIPT.format(scenario=PAIR, out=str(tmp_path / "run"))
    with subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler) and None,
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "flying\n"
        program.send_signal(signal.SIGINT)
        _, said = program.communicate()
    assert said.rstrip().splitlines()[-1].startswith("KeyboardInterrupt: interrupted; zsim.load(")
    run = zsim.load(tmp_path / "run")
    assert run.duration_s > 1.0
    assert run.summary.record.complete
