"""A real console on a run that the test plays: its pages require a browser but no federation."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
from federation import free_port
from wire import PATIENCE_S

from zsim.contract import keys, messages
from zsim.contract.flight_messages import DroneState, DroneView, EstimateView, ViewCluster, ViewDrones, ViewEstimates
from zsim.contract.messages import DroneInfo
from zsim.contract.run_messages import Clock, ControlAnswer, Event
from zsim.scenario import scenario_file
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_bridges.console.console_server import Console
from zsim_bridges.console.page_server import ListenAddress

STEP = Path(__file__).parents[2] / "scenarios" / "step.yaml"
PICTURES_HZ = 100.0  # picture rate while the past is performed; each picture adds one point to the plots
PAST_STEP_S = 0.5  # simulated time between two pictures of the past
PRESENT_S = 0.5  # wall and simulated time between two later pictures: a browser without a graphics card renders slowly
GATE_NS = 20_000_000
LOOK_S = 0.5  # wall time between two checks that the console is alive
LEVEL = (1.0, 0.0, 0.0, 0.0)
ROTORS = (300.0, 300.0, 300.0, 300.0)  # rad/s
COVARIANCE_M2 = (0.04, 0.0, 0.0, 0.04, 0.0, 0.09)
GPS = {
    "gps": (700, 3),
    "baro": (3000, 0),
    "mag": (3000, 0),
    "imu": (30000, 0),
    "sonar": (0, 120),
}  # numbers of samples used and refused
APART_M = 4.0  # distance between drones unless the scenario's target sets another
SWAY_M, SWAY_S = 0.4, 25.0  # amplitude and period of the drones' sway, which gives the plots curves


class StagedLink:
    """A session on which only the test publishes."""

    host = "lab"

    def __init__(self) -> None:
        self.subscribers: list[tuple[str, Callable[[Any], None]]] = []
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.clock: Clock | None = None
        self.timeline: dict[str, Any] = {}
        self.views_at: Callable[[float], list[tuple[str, Any]]] = lambda _: []

    def declare_subscriber(self, expression: str, callback: Callable[[Any], None]) -> None:
        self.subscribers.append((expression, callback))

    def publish(self, key: str, message: Any) -> None:
        """Let the console receive a message."""
        sample = SimpleNamespace(key=key, payload=messages.encode(message))
        for expression, callback in self.subscribers[:]:
            if keys.matches(expression, key):
                callback(sample)

    def put(self, key: str, message: Any) -> None:
        """Ignore a command."""

    def get(self, expression: str, timeout_s: float = 2.0) -> list[Any]:
        if expression != keys.CLOCK or self.clock is None:
            return []
        return [SimpleNamespace(key=keys.CLOCK, payload=messages.encode(self.clock))]

    def request(self, key: str, op: str, source: str, args: dict[str, Any], timeout_s: float) -> ControlAnswer:
        if op == "views":
            count = int((args["to_s"] - args["from_s"]) / args["every_s"]) + 1
            views = [each for k in range(count) for each in self.views_at(args["from_s"] + k * args["every_s"])]
            return ControlAnswer(True, "", result=[(key, messages.encode(view)) for key, view in views])
        self.asked.append((op, args))
        return ControlAnswer(True, "", result=self.timeline if op == "timeline" else None)


class StagedRun:
    """An engaged formation: the three drones of scenarios/step.yaml, unless another scenario is given.

    Args:
        past_s: simulated time that has passed when a page is opened.
        timeline: timeline of a replay; empty for a live run.
        scenario: scenario of the run.
        state: state of each drone.
        drain_percent_s: rate at which each battery discharges.

    Attributes:
        link: the console's session.
        t_s: simulated time of the newest picture.
        clock_state: state reported by the run's clock.
        stands: whether time stands still.
        commander: name of the process that flies the drones.
        changes: fields to replace in single drones' views, by drone.
        phase: phase of the formation.
    """

    def __init__(
        self,
        past_s: float = 156.0,
        timeline: dict[str, Any] | None = None,
        scenario: Path = STEP,
        state: DroneState = "flying",
        drain_percent_s: float = 0.0,
    ) -> None:
        self._scenario = scenario_file.load(scenario)
        self._state: DroneState = state
        self._drain_percent_s = drain_percent_s
        self._cluster = self._scenario.clusters[0]
        self._space = scenario_space(self._scenario, self._cluster)
        self._past_s = past_s
        self.link = StagedLink()
        self.link.timeline, self.link.views_at = timeline or {}, self.views_at
        self.t_s, self.clock_state, self.stands = 0.0, "running", False
        self.changes: dict[str, dict[str, Any]] = {}
        self.phase = "engaged"
        self._performed_s = 0.0  # wall time of the newest picture
        self.commander: str | None = None
        self._present = threading.Event()  # set once the past has been performed
        self.percent = 73.0  # charge of each battery
        self.percent_of: dict[str, float] = {}  # exceptions, by drone
        drones = tuple(DroneInfo(drone.name, "ardrone2") for drone in self._scenario.drones)
        self.info: Any = SimpleNamespace(
            run_id="staged", rate=1.0, gate_ns=GATE_NS, mode="lockstep", drones=drones, scenario=scenario.read_text(),
            replay_of="r0" if timeline else "",
        )  # fmt: skip
        self.observer: Any = SimpleNamespace(
            name="console.1", now_ns=0, end_reason="", health=SimpleNamespace(received=0, refused=0),
            update_clock=lambda payload: messages.decode(keys.CLOCK, payload), tick=self._tick,
        )  # fmt: skip

    def _tick(self) -> None:
        """Perform the next picture."""
        past, wall_s = self.t_s < self._past_s, time.monotonic()
        if past or (not self.stands and wall_s - self._performed_s >= PRESENT_S):
            self.t_s, self._performed_s = self.t_s + (PAST_STEP_S if past else PRESENT_S), wall_s
            self.publish_views()
        if self.t_s >= self._past_s:
            self._present.set()
        t_ns = round(self.t_s * 1e9)
        self.link.clock = Clock(t_ns, 0, "staged", t_ns // GATE_NS, self.clock_state, 1.0)  # type: ignore[arg-type]

    def publish_views(self) -> None:
        """Publish the true, estimated and desired positions of all drones at `t_s`."""
        for key, view in self.views_at(self.t_s):
            self.link.publish(key, view)

    def views_at(self, t_s: float) -> list[tuple[str, Any]]:
        """Return the views of an instant, by key."""
        t_ns, names = round(t_s * 1e9), self._cluster.drones
        desired = self._space.specimen(APART_M)
        for name, value in self._cluster.plan.target.items():
            desired[self._space.index(name)] = float(value)
        p_W, yaw = self._space.inverse(desired)
        phase = math.tau * t_s / SWAY_S
        sway = SWAY_M * np.array([(math.sin(phase + k), math.cos(phase + 2 * k), 0.0) for k in range(len(names))])
        true_W, believed_W = p_W + sway, p_W + 0.8 * sway
        who = self.commander
        views = tuple(
            DroneView(
                name,
                tuple(p),
                LEVEL,
                ROTORS,
                self._state,
                self.percent_of.get(name, self.percent) - self._drain_percent_s * t_s,
                who,
            )
            for name, p in zip(names, true_W.tolist(), strict=True)
        )
        views = tuple(msgspec.structs.replace(each, **self.changes.get(each.name, {})) for each in views)
        found: list[tuple[str, Any]] = [(keys.VIEW_DRONES, ViewDrones(t_ns, 0, views, ((1.0, 0.5, 0.0),)))]
        for name, p, psi in zip(names, believed_W.tolist(), yaw.tolist(), strict=True):
            estimate = EstimateView(name, tuple(p), COVARIANCE_M2, psi, 0.05, GPS)
            found.append((keys.estimates_view(f"estimator.{name}"), ViewEstimates(t_ns, 0, (estimate,))))
        value = self._space.forward(believed_W, yaw)
        shape = self._space.names, tuple(value.tolist()), tuple(desired.tolist())
        cluster = ViewCluster(t_ns, 0, self.phase, *shape, "")  # type: ignore[arg-type]
        return [*found, (keys.cluster_view(self._cluster.name), cluster)]

    def happen(self, kind: str, subject: str, text: str, **data: Any) -> None:
        """Publish an event of the world."""
        self.link.publish(keys.EVENT, Event(round(self.t_s * 1e9), 0, kind, "world", subject, text, data))

    def end(self) -> None:
        """End the run, as the world does."""
        self.happen("end", "world", "the duration is over")
        self.observer.end_reason = "the duration is over"

    def wait_for_past(self, console: threading.Thread) -> None:
        """Wait until the past has been performed for a console."""
        until_s = time.monotonic() + PATIENCE_S
        while not self._present.wait(LOOK_S):
            assert console.is_alive()
            assert time.monotonic() < until_s, f"the past has come to {self.t_s} s only"


@contextmanager
def staged_console(run: StagedRun, folder: Path | None = None, hz: float = PICTURES_HZ) -> Iterator[str]:
    """Serve a run at `hz` pictures per second, with the files of its folder if given; yield the operator's address."""
    port = free_port()
    console = Console(ListenAddress("127.0.0.1", port), "console.1", None, hz, lambda _: None, folder=folder)
    over = threading.Event()
    link: Any = run.link
    args = link, run.info, run.observer, over.is_set, lambda _: None
    thread = threading.Thread(target=console.serve, args=args, name="staged console")
    with console.open():
        thread.start()
        try:
            run.wait_for_past(thread)
            yield f"http://127.0.0.1:{port}/"
        finally:
            over.set()
            thread.join(PATIENCE_S)
