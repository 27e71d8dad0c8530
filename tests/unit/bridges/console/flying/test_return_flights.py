"""Drones and formations that fly back to where they started: when they land, and what ends a return."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from zsim.contract.views import ViewCluster
from zsim.scenario import scenario_file
from zsim_bridges.console.manual_flight import DronePose, DroneSight, FlightAnswer
from zsim_bridges.console.page_flying import ReturnFlights

SCENARIO = scenario_file.load(Path(__file__).parents[5] / "scenarios" / "step.yaml")
NAMES = ("x_c", "y_c", "z_c")


class Returns:
    """Returns in a run that only the test performs."""

    def __init__(self) -> None:
        self.said: list[Any] = []
        self.notes: list[tuple[str, str]] = []
        self.requests = 0
        self.answer = FlightAnswer("drone1", "taking")
        self.is_sent = False
        self.sight = DroneSight("flying", "console.1", DronePose((5.0, 5.0, 10.0), 0.0))
        self.view = ViewCluster(0, 0, "engaged", NAMES, (5.0, -5.0, 15.0), (5.0, -5.0, 15.0), "")
        client: Any = SimpleNamespace(
            request_cluster=self._request, requests_to=lambda _: self.requests,
            send_mode=lambda drones, mode: self.said.append((mode, drones)),
        )  # fmt: skip
        control: Any = SimpleNamespace(
            take=lambda page, drone, over: self.answer, steer=lambda page, stick: self.answer,
            leave=lambda page: self.said.append("leave"), go=self._go, is_on_way=lambda page: self.is_sent,
        )  # fmt: skip
        self.flights = ReturnFlights(
            SCENARIO,
            client,
            control,
            lambda _: self.sight,
            lambda: {"main": self.view},
            lambda *n: self.notes.append(n),
        )

    def _request(self, cluster: str, op: str, **args: Any) -> None:
        self.requests += 1
        self.said.append((op, args))

    def _go(self, page: Any, x_m: float, y_m: float) -> None:
        self.is_sent = True
        self.said.append(("go", x_m, y_m))

    def tick(self) -> list[Any]:
        self.said.clear()
        self.flights.tick()
        return list(self.said)

    def fly_to(self, x_m: float, y_m: float, desired: tuple[float, float] | None = None) -> None:
        value = (x_m, y_m, 15.0)
        goal = value if desired is None else (*desired, 15.0)
        self.view = ViewCluster(0, 0, "engaged", NAMES, value, goal, "")


@pytest.fixture
def returns() -> Returns:
    return Returns()


def test_a_drone_is_sent_over_its_start_and_lands_there(returns: Returns):
    returns.flights.request_drones(["drone1"])
    assert returns.tick() == []  # it is being taken
    returns.answer = FlightAnswer("drone1", "flying")
    assert returns.tick() == [("go", 0.0, 1.5)]
    assert returns.tick() == []
    returns.sight = DroneSight("flying", "console.1", DronePose((0.2, 1.3, 10.0), 0.0))
    assert returns.tick() == ["leave", ("land", ["drone1"])]
    assert returns.tick() == []
    assert returns.notes == []


def test_a_drone_that_somebody_else_takes_does_not_land(returns: Returns):
    returns.flights.request_drones(["drone1"])
    returns.answer = FlightAnswer("drone1", "none", "drone1 is flown by driver.x now")
    assert returns.tick() == []
    assert [subject for subject, _ in returns.notes] == ["drone1"]
    returns.sight = DroneSight("flying", "driver.x", DronePose((0.0, 1.5, 10.0), 0.0))
    assert returns.tick() == []


def test_a_drone_that_may_not_be_taken_says_why(returns: Returns):
    returns.answer = FlightAnswer("drone1", "none", "drone1 is landed")
    returns.flights.request_drones(["drone1"])
    assert returns.notes == [("drone1", "drone1 is landed")]
    assert returns.tick() == []


def test_a_formation_is_led_over_the_middle_of_its_starts_and_lands_there(returns: Returns):
    returns.flights.request_formation("main")
    assert returns.said == [("target", {"values": {"x_c": 0.0, "y_c": -0.5}})]
    assert returns.tick() == []
    returns.fly_to(0.0, -0.5, desired=(2.0, -2.0))  # it happens to be there, on its way
    assert returns.tick() == []
    returns.fly_to(0.1, -0.4, desired=(0.0, -0.5))
    assert returns.tick() == [("land", {})]
    assert returns.tick() == []


@pytest.mark.parametrize("how", ["request", "elsewhere", "held", "refused"])
def test_a_formation_that_does_not_return_any_more_does_not_land(returns: Returns, how: str):
    returns.flights.request_formation("main")
    returns.fly_to(1.0, -1.0)
    assert returns.tick() == []
    if how == "request":
        returns.requests += 1
    elif how == "elsewhere":
        returns.fly_to(4.0, -4.0)
    elif how == "held":
        returns.view = ViewCluster(0, 0, "held", NAMES, (0.0, -0.5, 15.0), (0.0, -0.5, 15.0), "")
    else:
        returns.flights.refused("main")
    assert returns.tick() == []
    returns.fly_to(0.0, -0.5)
    assert returns.tick() == []
    assert bool(returns.notes) == (how in ("elsewhere", "held"))
