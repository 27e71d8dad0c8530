"""Table I of the paper is shown only for complete, engaged flights of Test 1, with its drones, sensors and plan."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import synthetic_record
from synthetic_record import SCENARIOS, Flown

from zsim.contract.run_messages import Event
from zsim.scenario import scenario_file
from zsim_analysis.reading.formation import Formation, formations_of
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.report.summary import PAPER_TABLE_1, flies_paper_test, paper_table, paper_table_of
from zsim_analysis.sweep.design import SweepDesign, make_plan, read_document
from zsim_analysis.sweep.sweep_summary import SweepResults

WINDOW_S = (120.0, 320.0)
UNLIKE = (
    "sensors.gps.position_m.noise=4",
    "sensors.preset=ardrone2",
    "drones.drone2.sensors.imu.accel_m_s2.noise=0.1",
    "drones.drone1.mass_kg=0.6",
    "drones.drone1.model=crazyflie2",
    "environment.wind.gust_m_s=2",
    "environment.wind.steady_m_s=[1, 0, 0]",
    "clusters.main.plan.target.p=5",
    "clusters.main.plan.land_s=300",
    "clusters.main.plan.trajectory={start_s: 60, expressions: {x_c: '5*t'}}",
    "report.window_s=[20, 320]",
    "report.window_s=[120, 140]",
    "duration_s=310",
    'faults=[{"kind": "gps_bias", "target": "drone1", "at_s": 1, "for_s": 0.5, "value_m": [3, 0, 0]}]',
)


def stands(*overrides: str, scenario: str = "step") -> bool:
    return bool(paper_table(scenario_file.load(SCENARIOS / f"{scenario}.yaml", overrides), "main"))


def test_table_1_is_shown_for_test_1_of_any_name_but_not_for_test_2() -> None:
    for overrides in ((), ("name=mine", "seed=7"), ("sensors.as_printed=true",), ("duration_s=400",)):
        assert stands(*overrides)
    assert not stands(scenario="trajectory")


@pytest.mark.parametrize("override", UNLIKE)
def test_table_1_is_not_shown_for_another_scenario(override: str) -> None:
    assert not stands(override)


def flies(*overrides: str, scenario: str) -> bool:
    flown = Flown(duration_s=0.1, scenario=scenario, overrides=overrides)
    return flies_paper_test(synthetic_record.flight(synthetic_record.traffic(flown)), "main")


@pytest.mark.parametrize("scenario", ["step", "trajectory"])
def test_figures_get_the_paper_s_numbers_for_both_tests_and_any_window(scenario: str) -> None:
    assert flies(scenario=scenario)
    assert flies("report.window_s=[20, 30]", "name=mine", scenario=scenario)
    for other in ("environment.wind.gust_m_s=2", "sensors.preset=ardrone2", "drones.drone1.mass_kg=0.6"):
        assert not flies(other, scenario=scenario)


def test_test_2_is_recognised_by_equation_4_in_any_notation() -> None:
    expressions = "clusters.main.plan.trajectory.expressions"
    assert flies(f"{expressions}.p=2*2", f"{expressions}.x_c='5*sin(2*pi*f*t + pi/2)'", scenario="trajectory")
    assert not flies(f"{expressions}.p=5", scenario="trajectory")
    assert not flies("clusters.main.plan.trajectory.constants.f=0.02", scenario="trajectory")


@pytest.fixture(scope="module")
def flown() -> tuple[RecordedFlight, Formation]:
    """Return a flight recorded as Test 1, and a formation that is engaged throughout the report's window."""
    flight = synthetic_record.flight(synthetic_record.traffic(Flown(duration_s=1.0)))
    (formation,) = formations_of(flight)
    return flight, replace(formation, t_s=np.linspace(*WINDOW_S, len(formation.t_s)))


def test_table_1_is_shown_only_for_a_complete_engaged_flight(flown: tuple[RecordedFlight, Formation]) -> None:
    assert paper_table_of(*flown, WINDOW_S) == PAPER_TABLE_1
    flight, formation = flown
    cut = replace(flight, completeness=msgspec.structs.replace(flight.completeness, closed=False))
    fault = replace(flight, events=[Event(10**9, 0, "fault", "world", "drone2", "begins", {"id": 1})])
    held = replace(formation, phases=["held", *formation.phases[1:]])
    assert paper_table_of(cut, formation, WINDOW_S) == {}
    assert paper_table_of(fault, formation, WINDOW_S) == {}
    assert paper_table_of(flight, held, WINDOW_S) == {}
    assert paper_table_of(flight, formation, (120.0, 200.0)) == {}


@pytest.mark.parametrize(
    ("vary", "there"),
    [
        ("seed", True),
        ("estimation.magnetometer=true,false", True),
        ("sensors.gps.position_m.noise=2,4", False),
        ("sensors.gps.position_m.noise=uniform(1,2)", False),
    ],
)
def test_table_1_is_shown_for_a_sweep_only_if_all_runs_are_test_1(vary: str, there: bool) -> None:
    document, faults = read_document(SCENARIOS / "step.yaml", [])
    plan = make_plan("step.yaml", document, [vary], 2, False, lambda run, of: None, faults)
    assert bool(SweepResults(SweepDesign(plan), []).paper_std) is there
