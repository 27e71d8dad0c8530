"""One run on the page, drawn by a viser of its own that nobody looks at but the test."""

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
    """A session on which only the test speaks."""

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
    """A run on a page: its messages, a picture after the other."""

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
        """Say something, draw a picture, and return what is shown."""
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
    """A triangle, or what a replay has of it."""
    places = {name: (4.0 * (i == 1) + away_m, 3.0 * (i == 2), 2.0) for i, name in enumerate(NAMES)}
    views = tuple(DroneView(n, places.get(n, ORIGIN), LEVEL, ROTORS, "flying", 80.0) for n in names)
    return keys.VIEW_DRONES, ViewDrones(t_ns, 0, views, ((3.0, 0.0, 0.0),))


def cluster(name: str = CLUSTER, names: tuple[str, ...] = SPACE.names) -> tuple[str, ViewCluster]:
    c = tuple(SPACE.specimen(4.0).tolist())[: len(names)]
    return keys.cluster_view(name), ViewCluster(20_000_000, 0, "engaged", names, c, c, "")


@pytest.mark.parametrize(("drones", "rate", "hz"), [(3, 1.0, 20.0), (50, 1.0, 10.0), (3, 25.0, 10.0), (3, 0.0, 20.0)])
def test_pictures_are_as_many_as_an_eye_can_follow(drones: int, rate: float, hz: float):
    assert picture_rate_hz(drones, rate) == hz


def test_the_view_from_above_has_the_newest_of_all(seen: Seen):
    seen.draw(drones(*NAMES[:2]), cluster())
    plan = seen.show.flying.plan(None, whole=True)
    assert [each and each[:2] for each in plan["drones"]] == [[0.0, 0.0], [4.0, 0.0], None]
    assert [(each["name"], each["drones"]) for each in plan["formations"]] == [(CLUSTER, [0, 1, 2])]
    assert (plan["names"], plan["t_s"]) == (list(NAMES), pytest.approx(0.02))
    assert "names" not in seen.show.flying.plan(None, whole=False)


def test_a_drone_is_taken_from_a_page_and_given_back(seen: Seen):
    seen.draw(drones(*NAMES))
    flying = seen.show.flying.control
    assert flying.take("page", NAMES[1], over=False).state in ("taking", "flying")
    flying.leave("page")
    seen.show.close()
    assert ("world/control", "acquire", {"drone": NAMES[1], "priority": 10}) in seen.link.asked


@pytest.mark.parametrize("watched", [True, False])
def test_a_replay_of_some_drones_is_shown_as_far_as_it_goes(viser: PrivateViser, watched: bool):
    seen = Seen(viser.server, watched)
    state = seen.draw(drones(NAMES[1]), cluster())
    assert [drone["name"] for drone in state["drones"]] == [NAMES[1]]
    assert state["clusters"][0]["true"] == {}
    assert seen.draw(drones())["drones"] == []
    assert len(seen.draw(drones(*NAMES, "stranger"))["drones"]) == 4
    seen.show.close()


def test_a_drone_that_is_missing_is_hidden_and_the_others_keep_their_places(viser: PrivateViser):
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
    stage.trails(np.zeros((0, 2, 3)), np.zeros(0, dtype=np.int64))  # a replay has gone back
    assert (np.asarray(stage._trail_node.points)[..., 2] < -100.0).all()


def test_each_drone_is_drawn_with_the_rotors_that_it_has(viser: PrivateViser):
    """Beside two of an old record, which names none, one of six rotors, half as large."""
    ends = [(0.09 * math.cos(k), 0.09 * math.sin(k)) for k in np.arange(6) * math.pi / 3]
    six = DroneInfo(NAMES[2], "mine", tuple(RotorInfo(f"r{k}", x, y, 1, 0.05) for k, (x, y) in enumerate(ends)))
    stage = stages.SceneNodes(viser.server, (*DRONES[:2], six), ARMS_M, 3, 1)
    stage.drones(drone_poses(drones(*NAMES)[1], NAMES), 0.05)
    assert [owners.tolist() for owners, _ in stage._airframes] == [[0, 1], [2]]
    places = np.asarray(stage._rotors._node.batched_positions)
    assert len(places) == 4 + 4 + 6
    np.testing.assert_allclose(places[8:, :2] - (0.0, 3.0), ends, atol=1e-6)
    np.testing.assert_allclose(stage._rotors._node.batched_scales[:, 0], [1.0] * 8 + [0.5] * 6)


def test_views_of_another_controller_are_left_out(seen: Seen):
    fewer = SPACE.names[:-1]
    state = seen.draw(drones(*NAMES), cluster(names=fewer), cluster("strange"))
    assert state["clusters"] == []
    assert seen.observer.health.refused == 2
    state = seen.draw(cluster())
    assert [each["name"] for each in state["clusters"]] == [CLUSTER]
    assert [drone["name"] for drone in state["drones"]] == list(NAMES)
    assert state["clusters"][0]["true"]["p"] == pytest.approx(4.0)
    assert state["t_s"] == pytest.approx(0.02)


def test_estimates_of_strangers_are_left_out(seen: Seen):
    strangers = [EstimateView(f"s{i}", ORIGIN, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0), 0.0, 0.1, {}) for i in range(9)]
    mine = EstimateView(NAMES[0], ORIGIN, (4.0, 0.0, 0.0, 4.0, 0.0, 4.0), 0.0, 0.1, {"gps": (1, 0)})
    view = ViewEstimates(20_000_000, 0, (*strangers, mine))
    state = seen.draw(drones(*NAMES), (keys.estimates_view("estimator.drone1"), view))
    assert state["drones"][0]["sigma_m"] == pytest.approx(2.0)


def test_trails_of_a_replay_that_goes_back_before_anybody_looks_go_too(viser: PrivateViser):
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


def test_what_the_world_refuses_of_the_console_s_commands_is_shown_in_the_corner(seen: Seen):
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


def test_a_world_that_is_gone_is_told_on_the_page(seen: Seen, monkeypatch: pytest.MonkeyPatch):
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
    order = seen.show.command(OrderRequest("land", id="one"))  # whoever is silent may hear it yet
    assert order["state"] == "sent"
    assert has_terms(order["reason"], "world", "12 s")
    assert seen.show.head()["orders"][0]["id"] == "one"


def test_a_run_that_is_over_is_told_with_its_reason(seen: Seen):
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


def test_an_emergency_is_in_the_head_of_the_page(seen: Seen):
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
    """Return the alarms in the head: subject, name, whether it is over."""
    return [(each["subject"], each["name"], each["over_s"] is not None) for each in seen.show.head()["alarms"]]


def drone_rows(seen: Seen) -> str:
    """Return what every page shows of the drones."""
    return console_tables.drone_table(seen.show._table_rows.drone_rows())


def test_the_death_of_a_process_is_an_alarm_until_it_is_back_and_acknowledged(seen: Seen):
    seen.draw(drones(*NAMES))
    for kind, is_over in (("death", False), ("drop", False), ("restart", True)):
        happen(seen, kind, "recorder")
        seen.draw(drones(*NAMES))
        assert alarmed(seen) == [("recorder", "dead", is_over)]
    seen.show.command(OrderRequest("acknowledge"))
    assert alarmed(seen) == []


def test_a_world_that_was_silent_is_an_alarm_until_it_is_acknowledged(seen: Seen, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as patch:
        patch.setattr(TimeMonitor, "silent_s", 12.0)
        seen.draw(drones(*NAMES))
        assert alarmed(seen) == [("world", "silent", False)]
    seen.draw(drones(*NAMES))
    assert alarmed(seen) == [("world", "silent", True)]


def test_alarms_of_later_times_are_forgotten_by_a_replay_that_goes_back(seen: Seen):
    seen.draw(drones(*NAMES, t_ns=40_000_000))
    happen(seen, "death", "recorder")
    seen.draw(drones(*NAMES, t_ns=60_000_000))
    assert alarmed(seen)
    seen.draw(drones(*NAMES, t_ns=20_000_000))
    assert alarmed(seen) == []


def flown(change: dict[str, Any], of: str = NAMES[1]) -> tuple[str, ViewDrones]:
    """Return a view of the triangle with one drone changed."""
    key, view = drones(*NAMES)
    changed = (msgspec.structs.replace(each, **(change if each.name == of else {})) for each in view.drones)
    return key, msgspec.structs.replace(view, drones=tuple(changed))


def test_a_formation_with_a_drone_flown_by_hand_is_not_told_to_be_engaged_alone(seen: Seen):
    key, view = flown({"commander": "console.run"})
    led = (
        each if each.commander else msgspec.structs.replace(each, commander="controller.main") for each in view.drones
    )
    seen.draw((key, msgspec.structs.replace(view, drones=tuple(led))), cluster())
    assert alarmed(seen) == [(CLUSTER, "other commanders", False)]
    for told in (seen.show.head()["detail"], seen.show._page.phases.content):
        assert has_terms(without_tags(told), "engaged", NAMES[1], "console.run")


def test_a_drone_that_lands_by_itself_tells_why_until_it_is_commanded(seen: Seen):
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
def test_no_take_off_of_a_drone_that_is_empty_or_on_its_back(
    seen: Seen, change: dict[str, Any], terms: tuple[str, ...]
):
    seen.draw(flown({"state": "landed", **change}))
    refusal = drone_refusals(seen.show._monitor.condition, NAMES[1])["takeoff"]
    assert has_terms(refusal, NAMES[1], *terms)
    assert any(each[0] == NAMES[1] for each in alarmed(seen))


def test_obstacles_stand_where_the_scenario_says(viser: PrivateViser):
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


def test_a_run_that_nobody_watched_leaves_its_last_picture_and_sends_what_was_moved_now_or_never(viser: PrivateViser):
    seen = Seen(viser.server, watched=False)
    sent: list[float] = []
    for form in seen.show._page.forms.values():
        form.send = sent.append  # type: ignore[method-assign]
    seen.draw(drones(*NAMES), cluster())
    assert len(sent) == 1
    assert seen.show.state()["drones"][0]["state"] == "flying"
    assert "engaged" in seen.show._page.phases.content
    seen.show.close()


def test_what_formations_were_asked_for_is_among_the_events_and_refusals_on_every_page(seen: Seen):
    seen.show._on_outcome(RequestOutcome("main: engage", "", CLUSTER, "engage"))
    assert [event.kind for event in seen.show.views.log.newest] == ["accepted"]
    seen.draw(drones(*NAMES), cluster())
    assert [event.kind for event in seen.show.views.log.newest] == ["done", "accepted"]
    seen.show._server.get_clients = dict  # type: ignore[assignment]  # nobody looks
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
