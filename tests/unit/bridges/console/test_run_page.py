"""A run on the page, drawn by a private viser that only the test sees."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from refused import has_terms, without_tags

from zsim.contract import keys, messages
from zsim.contract.flight_messages import DroneView, EstimateView, ViewCluster, ViewDrones, ViewEstimates
from zsim.contract.messages import DroneInfo, RotorInfo
from zsim.contract.run_messages import ControlAnswer, Event
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Surface
from zsim.scenario.surroundings import packed
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_bridges.console import console_tables
from zsim_bridges.console import scene as stages
from zsim_bridges.console.console_server import RunPage, picture_rate_hz
from zsim_bridges.console.orders import OrderRequest, RequestOutcome
from zsim_bridges.console.page_cameras import PageCameras
from zsim_bridges.console.page_server import PrivateViser
from zsim_bridges.console.picture import drone_poses
from zsim_bridges.console.run_condition import drone_refusals
from zsim_bridges.console.run_monitor import TimeMonitor

STEP = Path(__file__).parents[4] / "scenarios" / "step.yaml"
SCENARIO = scenario_file.load(STEP)
NAMES = tuple(drone.name for drone in SCENARIO.drones)
CLUSTER = SCENARIO.clusters[0].name
SPACE = scenario_space(SCENARIO, SCENARIO.clusters[0])
LEVEL = (1.0, 0.0, 0.0, 0.0)
ROTORS = (300.0, 300.0, 300.0, 300.0)  # rad/s
ARMS_M = (0.1785,) * 3
DRONES = tuple(DroneInfo(name, "ardrone2") for name in NAMES)
ORIGIN = (0.0, 0.0, 0.0)
OBSTACLES = """
name: field
duration_s: 1
drones: [{name: drone1, position_m: [0, 0, 0]}]
environment:
  obstacles:
    - {name: wall, shape: box, position_m: [5, 0, 0], size_m: [1, 4, 3]}
    - {name: mast, shape: cylinder, position_m: [9, 0, 0], radius_m: 0.2, height_m: 6}
    - {name: balloon, shape: sphere, position_m: [9, 9, 5], radius_m: 1}
"""


class Link:
    """A session on which only the test publishes."""

    host = "lab"

    def __init__(self) -> None:
        self.subscribers: list[tuple[str, Callable[[Any], None]]] = []
        self.tell: Callable[[Any], None] = lambda _: None
        self.asked: list[tuple[str, str, dict[str, Any]]] = []

    def declare_subscriber(self, expression: str, callback: Callable[[Any], None]) -> None:
        if expression == keys.EVENT:
            self.tell = callback
        self.subscribers.append((expression, callback))

    def say(self, sample: Any) -> None:
        for expression, callback in self.subscribers[:]:
            if keys.matches(expression, sample.key):
                callback(sample)

    def get(self, expression: str, timeout_s: float = 2.0) -> list[Any]:
        return []

    def request(self, key: str, op: str, source: str, args: dict[str, Any], timeout_s: float) -> ControlAnswer:
        self.asked.append((key, op, args))
        return ControlAnswer(True, "")


class Seen:
    """A run on a page, which is fed messages and drawn picture by picture."""

    def __init__(self, server: Any, watched: bool) -> None:
        self.link: Any = Link()
        health = SimpleNamespace(received=0, refused=0)
        self.observer: Any = SimpleNamespace(
            name="console.1", now_ns=0, end_reason="", health=health, update_clock=lambda _: None, tick=lambda: None
        )
        drones = DRONES
        scenario = STEP.read_text()
        info: Any = SimpleNamespace(
            run_id="r1", rate=1.0, mode="lockstep", drones=drones, scenario=scenario, replay_of="", gate_ns=20_000_000
        )
        server.get_clients = lambda: {0: None} if watched else {}
        self.show = RunPage(server, self.link, info, self.observer, PageCameras(server), 1000.0)

    def draw(self, *samples: tuple[str, Any]) -> dict[str, Any]:
        """Publish samples, draw a picture, and return what is shown."""
        turns = iter((False, True))

        def stopped() -> bool:
            over = next(turns)
            for key, message in () if over else samples:
                self.link.say(SimpleNamespace(key=key, payload=messages.encode(message)))
            return over

        self.show.run(stopped)
        return self.show.state()


@pytest.fixture(scope="module")
def viser() -> Iterator[PrivateViser]:
    made = PrivateViser()
    yield made
    made.close()


@pytest.fixture
def seen(viser: PrivateViser) -> Iterator[Seen]:
    made = Seen(viser.server, watched=True)
    yield made
    made.show.close()


def drones(*names: str, t_ns: int = 20_000_000, away_m: float = 0.0) -> tuple[str, ViewDrones]:
    """Return a view of the named drones, which stand in a triangle; a replay may have only some of them."""
    places = {name: (4.0 * (i == 1) + away_m, 3.0 * (i == 2), 2.0) for i, name in enumerate(NAMES)}
    views = tuple(DroneView(n, places.get(n, ORIGIN), LEVEL, ROTORS, "flying", 80.0) for n in names)
    return keys.VIEW_DRONES, ViewDrones(t_ns, 0, views, ((3.0, 0.0, 0.0),))


def cluster(name: str = CLUSTER, names: tuple[str, ...] = SPACE.names) -> tuple[str, ViewCluster]:
    c = tuple(SPACE.specimen(4.0).tolist())[: len(names)]
    return keys.cluster_view(name), ViewCluster(20_000_000, 0, "engaged", names, c, c, "")


@pytest.mark.parametrize(("drones", "rate", "hz"), [(3, 1.0, 20.0), (50, 1.0, 10.0), (3, 25.0, 10.0), (3, 0.0, 20.0)])
def test_the_picture_rate_falls_with_many_drones_or_a_fast_run(drones: int, rate: float, hz: float):
    assert picture_rate_hz(drones, rate) == hz


def test_the_plan_view_has_the_newest_positions_and_formations(seen: Seen):
    seen.draw(drones(*NAMES[:2]), cluster())
    plan = seen.show.flying.plan(None, complete=True)
    assert [each and each[:2] for each in plan["drones"]] == [[0.0, 0.0], [4.0, 0.0], None]
    assert [(each["name"], each["drones"]) for each in plan["formations"]] == [(CLUSTER, [0, 1, 2])]
    assert (plan["names"], plan["t_s"]) == (list(NAMES), pytest.approx(0.02))
    assert "names" not in seen.show.flying.plan(None, complete=False)


def test_a_drone_is_acquired_from_a_page_and_released(seen: Seen):
    seen.draw(drones(*NAMES))
    flying = seen.show.flying.control
    assert flying.take("page", NAMES[1], take_over=False).state in ("taking", "flying")
    flying.leave("page")
    seen.show.close()
    assert ("world/control", "acquire", {"drone": NAMES[1], "priority": 10}) in seen.link.asked


@pytest.mark.parametrize("watched", [True, False])
def test_a_replay_of_some_drones_shows_those_it_has(viser: PrivateViser, watched: bool):
    seen = Seen(viser.server, watched)
    state = seen.draw(drones(NAMES[1]), cluster())
    assert [drone["name"] for drone in state["drones"]] == [NAMES[1]]
    assert state["clusters"][0]["true"] == {}
    assert seen.draw(drones())["drones"] == []
    assert len(seen.draw(drones(*NAMES, "stranger"))["drones"]) == 4
    seen.show.close()


def test_a_missing_drone_is_hidden_and_the_others_keep_their_places(viser: PrivateViser):
    stage = stages.SceneNodes(viser.server, DRONES, ARMS_M, 3, 1)
    found = drone_poses(drones(NAMES[2])[1], NAMES)
    stage.drones(found, 0.05)
    stage.wind(found)
    ((_, frames),) = stage._airframes
    p_W = np.asarray(frames.batched_positions)
    assert p_W[2].tolist() == [0.0, 3.0, 2.0]
    assert p_W[0].tolist() == p_W[1].tolist() == list(stages.HIDDEN)
    assert np.isfinite(stage._rotors._node.batched_positions).all()
    assert stage._wind.visible
    stage.wind(drone_poses(drones()[1], NAMES))
    assert not stage._wind.visible
    stage.trails(np.ones((2, 2, 3)), np.array([0, 1]))
    stage.trails(np.zeros((0, 2, 3)), np.zeros(0, dtype=np.int64))  # as after a replay has gone back
    assert (np.asarray(stage._trail_node.points)[..., 2] < -100.0).all()


def test_each_drone_is_drawn_with_its_own_rotors(viser: PrivateViser):
    """Two drones come from an old record, which lists no rotors; the third has six rotors of half the size."""
    ends = [(0.09 * math.cos(k), 0.09 * math.sin(k)) for k in np.arange(6) * math.pi / 3]
    six = DroneInfo(NAMES[2], "mine", tuple(RotorInfo(f"r{k}", x, y, 1, 0.05) for k, (x, y) in enumerate(ends)))
    stage = stages.SceneNodes(viser.server, (*DRONES[:2], six), ARMS_M, 3, 1)
    stage.drones(drone_poses(drones(*NAMES)[1], NAMES), 0.05)
    assert [owners.tolist() for owners, _ in stage._airframes] == [[0, 1], [2]]
    places = np.asarray(stage._rotors._node.batched_positions)
    assert len(places) == 4 + 4 + 6
    np.testing.assert_allclose(places[8:, :2] - (0.0, 3.0), ends, atol=1e-6)
    np.testing.assert_allclose(stage._rotors._node.batched_scales[:, 0], [1.0] * 8 + [0.5] * 6)


def test_views_of_an_unknown_formation_are_ignored(seen: Seen):
    fewer = SPACE.names[:-1]
    state = seen.draw(drones(*NAMES), cluster(names=fewer), cluster("strange"))
    assert state["clusters"] == []
    assert seen.observer.health.refused == 2
    state = seen.draw(cluster())
    assert [each["name"] for each in state["clusters"]] == [CLUSTER]
    assert [drone["name"] for drone in state["drones"]] == list(NAMES)
    assert state["clusters"][0]["true"]["p"] == pytest.approx(4.0)
    assert state["t_s"] == pytest.approx(0.02)


def test_estimates_of_unknown_drones_are_ignored(seen: Seen):
    strangers = [EstimateView(f"s{i}", ORIGIN, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0), 0.0, 0.1, {}) for i in range(9)]
    mine = EstimateView(NAMES[0], ORIGIN, (4.0, 0.0, 0.0, 4.0, 0.0, 4.0), 0.0, 0.1, {"gps": (1, 0)})
    view = ViewEstimates(20_000_000, 0, (*strangers, mine))
    state = seen.draw(drones(*NAMES), (keys.estimates_view("estimator.drone1"), view))
    assert state["drones"][0]["sigma_m"] == pytest.approx(2.0)


def test_a_replay_that_goes_back_clears_trails_even_unwatched(viser: PrivateViser):
    seen = Seen(viser.server, watched=False)
    for t_ns, away_m in ((1_000_000_000, 0.0), (2_000_000_000, 5.0)):
        seen.draw(drones(*NAMES, t_ns=t_ns, away_m=away_m))
    assert len(trails(seen)) == len(NAMES)
    seen.draw(drones(*NAMES, t_ns=1_000_000_000, away_m=9.0))
    assert len(trails(seen)) == 0
    seen.show.close()


def trails(seen: Seen) -> np.ndarray:
    assert seen.show._scene.drones is not None
    return seen.show._scene.trails.segments(seen.show._scene.drones.t_ns / 1e9, seen.show._scene.drones.p_W)[0]


def test_refused_commands_of_the_console_are_shown_as_notifications(seen: Seen):
    shown: list[tuple[str, str]] = []
    seen.draw(drones(*NAMES))
    client = SimpleNamespace(add_notification=lambda title, body, **_: shown.append((title, body)))
    seen.show._server.get_clients = lambda: {0: client}  # type: ignore[assignment, dict-item, return-value]
    subject, reason = "drone/drone1/cmd/mode", "age is 800 ms; must be <= 500 ms"
    for source in ("somebody", "console.1"):
        event = Event(0, 0, "refused", source, subject, f"{subject}: {reason}", {"reason": reason})
        seen.link.tell(SimpleNamespace(key=keys.EVENT, payload=messages.encode(event)))
    assert shown == [(f"Refused: {subject}", reason)]
    assert [event.kind for event in seen.show.views.log.newest] == ["refused", "refused"]


def test_a_silent_world_is_shown_and_locks_the_controls(seen: Seen, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(TimeMonitor, "silent_s", 12.0)
    state = seen.draw(drones(*NAMES))
    assert (state["clock"], state["silent_s"]) == ("silent", 12.0)
    head = seen.show.head()
    assert (head["level"], head["age_s"]) == ("silent", 12.0)
    assert has_terms(head["title"], "12 s")
    page = seen.show._page
    locked = [
        *page.forms[CLUSTER]._controls.values(),
        *page.fleet._controls.values(),
        *page.run_form._controls.values(),
    ]
    assert all(control.disabled for control in locked)
    order = seen.show.command(OrderRequest("land", id="one"))  # a silent world may still receive it
    assert order["state"] == "sent"
    assert has_terms(order["reason"], "world", "12 s")
    assert seen.show.head()["orders"][0]["id"] == "one"


def test_a_finished_run_is_shown_with_its_reason(seen: Seen):
    seen.draw(drones(*NAMES), cluster())
    event = Event(30_000_000, 0, "end", "world", "world", "330 s were flown")
    seen.link.tell(SimpleNamespace(key=keys.EVENT, payload=messages.encode(event)))
    seen.draw(drones(*NAMES), cluster())
    head = seen.show.head()
    assert head["level"] == "ended"
    assert has_terms(head["detail"], "330 s")
    assert head["refusals"]["emergency"]
    order = seen.show.command(OrderRequest("emergency"))
    assert order["state"] == "refused"
    assert has_terms(order["reason"], "330 s")


def test_an_emergency_is_shown_in_the_head_of_the_page(seen: Seen):
    key, view = drones(*NAMES)
    stopped = msgspec.structs.replace(view.drones[1], state="emergency", battery_percent=8.0)
    seen.draw((key, msgspec.structs.replace(view, drones=(view.drones[0], stopped, view.drones[2]))), cluster())
    head = seen.show.head()
    assert (head["level"], head["refusals"]["emergency"]) == ("emergency", "")
    alarms = {(alarm["subject"], alarm["name"], alarm["severity"]) for alarm in head["alarms"]}
    assert alarms == {(NAMES[1], "emergency", "red"), (NAMES[1], "battery", "red")}
    assert seen.show._monitor.board.severity_of(NAMES[1]) == "red"
    assert seen.show._monitor.board.severity_of(NAMES[0]) is None
    assert seen.show.command(OrderRequest("acknowledge"))["state"] == "confirmed"
    assert all(alarm["acknowledged"] for alarm in seen.show.head()["alarms"])


def happen(seen: Seen, kind: str, subject: str, **data: Any) -> None:
    event = Event(0, 0, kind, "world", subject, f"{subject}: {kind}", data)
    seen.link.tell(SimpleNamespace(key=keys.EVENT, payload=messages.encode(event)))


def alarmed(seen: Seen) -> list[tuple[Any, ...]]:
    """Return the alarms in the head as (subject, name, whether it is over)."""
    return [(each["subject"], each["name"], each["over_s"] is not None) for each in seen.show.head()["alarms"]]


def drone_rows(seen: Seen) -> str:
    """Return the table of drones that every page shows."""
    return console_tables.drone_table(seen.show._table_rows.drone_rows())


def test_a_death_is_an_alarm_until_the_return_is_acknowledged(seen: Seen):
    seen.draw(drones(*NAMES))
    for kind, is_over in (("death", False), ("drop", False), ("restart", True)):
        happen(seen, kind, "recorder")
        seen.draw(drones(*NAMES))
        assert alarmed(seen) == [("recorder", "dead", is_over)]
    seen.show.command(OrderRequest("acknowledge"))
    assert alarmed(seen) == []


def test_silence_of_the_world_remains_an_alarm_when_it_is_over(seen: Seen, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as patch:
        patch.setattr(TimeMonitor, "silent_s", 12.0)
        seen.draw(drones(*NAMES))
        assert alarmed(seen) == [("world", "silent", False)]
    seen.draw(drones(*NAMES))
    assert alarmed(seen) == [("world", "silent", True)]


def test_a_replay_that_goes_back_clears_later_alarms(seen: Seen):
    seen.draw(drones(*NAMES, t_ns=40_000_000))
    happen(seen, "death", "recorder")
    seen.draw(drones(*NAMES, t_ns=60_000_000))
    assert alarmed(seen)
    seen.draw(drones(*NAMES, t_ns=20_000_000))
    assert alarmed(seen) == []


def flown(change: dict[str, Any], of: str = NAMES[1]) -> tuple[str, ViewDrones]:
    """Return a view of the triangle in which one drone is changed."""
    key, view = drones(*NAMES)
    changed = (msgspec.structs.replace(each, **(change if each.name == of else {})) for each in view.drones)
    return key, msgspec.structs.replace(view, drones=tuple(changed))


def test_an_engaged_formation_names_its_drone_flown_from_the_console(seen: Seen):
    key, view = flown({"commander": "console.run"})
    led = (
        each if each.commander else msgspec.structs.replace(each, commander="controller.main") for each in view.drones
    )
    seen.draw((key, msgspec.structs.replace(view, drones=tuple(led))), cluster())
    assert alarmed(seen) == [(CLUSTER, "other commanders", False)]
    for told in (seen.show.head()["detail"], seen.show._page.phases.content):
        assert has_terms(without_tags(told), "engaged", NAMES[1], "console.run")


def test_an_autonomous_landing_shows_its_cause_until_the_next_command(seen: Seen):
    seen.draw(drones(*NAMES))
    happen(seen, "landing", NAMES[1], cause="battery")
    seen.draw(flown({"state": "landing"}), cluster())
    assert alarmed(seen) == [(NAMES[1], "lands by itself", False)]
    cause = f"{NAMES[1]}: landing"
    assert cause in seen.show.head()["detail"]
    assert cause in drone_rows(seen)
    seen.draw(flown({"state": "landed"}), cluster())
    assert cause in drone_rows(seen)
    happen(seen, "mode", NAMES[1], mode="takeoff")
    seen.draw(flown({"state": "flying"}), cluster())
    assert cause not in drone_rows(seen) + seen.show.head()["detail"]


@pytest.mark.parametrize(
    ("change", "terms"),
    [({"battery_percent": 2.0}, ("2 %",)), ({"orientation_wxyz": (0.0, 1.0, 0.0, 0.0)}, ("180°",))],
)
def test_take_off_is_refused_with_an_empty_battery_or_upside_down(
    seen: Seen, change: dict[str, Any], terms: tuple[str, ...]
):
    seen.draw(flown({"state": "landed", **change}))
    refusal = drone_refusals(seen.show._monitor.condition, NAMES[1])["takeoff"]
    assert has_terms(refusal, NAMES[1], *terms)
    assert any(each[0] == NAMES[1] for each in alarmed(seen))


def test_obstacles_are_drawn_where_the_scenario_puts_them(viser: PrivateViser):
    obstacles = scenario_file.from_text(OBSTACLES).environment.obstacles
    added: dict[str, Any] = {}
    scene: Any = viser.server.scene
    stage = stages.SceneNodes(viser.server, DRONES, ARMS_M, 3, 1)
    for shape in ("box", "cylinder", "icosphere"):
        setattr(scene, f"add_{shape}", lambda name, **look: added.update({name: look["position"]}))
    try:
        stage.obstacles(obstacles)
    finally:
        for shape in ("box", "cylinder", "icosphere"):
            delattr(scene, f"add_{shape}")
    assert added == {
        "/obstacles/wall": (5.0, 0.0, 1.5),
        "/obstacles/mast": (9.0, 0.0, 3.0),
        "/obstacles/balloon": (9.0, 9.0, 5.0),
    }


def test_surfaces_are_drawn_where_the_scenario_puts_them(viser: PrivateViser):
    ramp = Surface(name="ramp", triangles=packed(np.array([[0, 0, 0, 2, 0, 0, 0, 1, 1]], float)), position_m=(5, 6, 7))
    added: dict[str, Any] = {}
    scene: Any = viser.server.scene
    stage = stages.SceneNodes(viser.server, DRONES, ARMS_M, 3, 1)
    scene.add_mesh_simple = lambda name, vertices, faces, **_: added.update({name: vertices[faces].tolist()})
    try:
        stage.surfaces([ramp])
    finally:
        del scene.add_mesh_simple
    assert added == {name: [[[5, 6, 7], [7, 6, 7], [5, 7, 8]]] for name in ("/surfaces/ramp", "/surfaces/ramp/edges")}


def test_an_unwatched_run_draws_its_last_picture_and_sends_the_sliders(viser: PrivateViser):
    seen = Seen(viser.server, watched=False)
    sent: list[float] = []
    for form in seen.show._page.forms.values():
        form.send = sent.append  # type: ignore[method-assign]
    seen.draw(drones(*NAMES), cluster())
    assert len(sent) == 1
    assert seen.show.state()["drones"][0]["state"] == "flying"
    assert "engaged" in seen.show._page.phases.content
    seen.show.close()


def test_requests_to_formations_and_all_refusals_are_in_the_event_log(seen: Seen):
    seen.show._on_outcome(RequestOutcome("main: engage", "", CLUSTER, "engage"))
    assert [event.kind for event in seen.show.views.log.newest] == ["accepted"]
    seen.draw(drones(*NAMES), cluster())
    assert [event.kind for event in seen.show.views.log.newest] == ["done", "accepted"]
    seen.show._server.get_clients = dict  # type: ignore[assignment]  # no page is open
    for outcome in (
        RequestOutcome("main: takeoff", "", "main", "takeoff"),
        RequestOutcome("rate value 2", ""),
        RequestOutcome("main", "not yet"),
    ):
        seen.show._on_outcome(outcome)
    found = [(event.kind, event.text) for event in seen.show.views.log.newest][:2]
    assert [kind for kind, _ in found] == ["refused", "accepted"]
    assert found[0][1] == "main: not yet"
    assert has_terms(found[1][1], "main", "takeoff")
