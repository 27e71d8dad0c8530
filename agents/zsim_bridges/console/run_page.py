"""One run on the page: draws its views as pictures, tables and plots, and sends the operator's requests."""

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import viser
from msgspec import UNSET

from zsim.contract.messages import Info
from zsim.contract.run_messages import Event
from zsim.contract.views import EstimateView, ViewCluster
from zsim.errors import DocumentError, RunError
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import Hats
from zsim.sensors.sensor_catalogue import own_rates
from zsim.transport.session import Session
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_bridges.console import console_tables
from zsim_bridges.console.cameras.camera_feed import CameraFeed
from zsim_bridges.console.command_client import CommandClient, PastInstant, RequestOutcome
from zsim_bridges.console.console_tables import TableRows
from zsim_bridges.console.flying.page_flying import PageFlying
from zsim_bridges.console.monitoring.flight_figures import FlightFigures
from zsim_bridges.console.monitoring.run_monitor import RunMonitor
from zsim_bridges.console.monitoring.time_monitor import TimeMonitor
from zsim_bridges.console.monitoring.view_buffer import ViewBuffer
from zsim_bridges.console.orders import OrderBook, OrderRequest
from zsim_bridges.console.page.console_page import ConsolePage
from zsim_bridges.console.page.control_desk import RUN, ControlDesk
from zsim_bridges.console.page.page_forms import PageForms
from zsim_bridges.console.record_player import KEPT_S, RecordPlayer
from zsim_bridges.console.run_state import console_state
from zsim_bridges.console.scene.camera_follow import CameraFollow
from zsim_bridges.console.scene.camera_frustums import CameraFrustums
from zsim_bridges.console.scene.picture import DronePoses, FormationShape, drone_poses
from zsim_bridges.console.scene.picture_rate import picture_rate_hz
from zsim_bridges.console.scene.run_scene import RunScene

TABLE_S = 0.5  # wall; of tables, plots and trails: people read no faster
STAMPS_PER_AGE = 5.0  # a stamp is at most this fraction of a command's largest age old; it ages on its way
TOLD_S = 2.0  # wall; a slider that is dragged is refused many times
NOTICE_S = 8.0  # wall; how long a refusal stays in the corner


def _spaces(scenario: Scenario) -> dict[str, ClusterSpace]:
    """Return the cluster spaces of a scenario by cluster.

    Raises:
        RunError: a space of the user's refuses its robots.
    """
    try:
        return {cluster.name: scenario_space(scenario, cluster) for cluster in scenario.clusters}
    except (ValueError, DocumentError) as error:
        raise RunError(f"console: {error}") from error


class RunPage:
    """The page of one run.

    Args:
        server: viser's; what another run has left on it is removed.
        link: an open session.
        info: of the run.
        observer: of the console in it.
        camera_follow: moves the page's cameras that follow the formation.
        frustums: of the drones' cameras, on the pages where they are chosen.
        rate_hz: pictures a second; None: fewer where there are many drones, or time flies.
        world: where the run is, in words.

    Attributes:
        views: the newest of everything.
        cameras: of the drones.
        record: what is played, of a replay.
        flying: what pages may do with single drones.
        orders: of the operators, until they are confirmed.
        desk: which page is in control.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        link: Session,
        info: Info,
        observer: Participant,
        camera_follow: CameraFollow,
        frustums: CameraFrustums,
        rate_hz: float | None,
        world: str = "",
    ) -> None:
        self._server = server
        self._info = info
        self._observer = observer
        self._scenario = scenario_file.from_text(info.scenario)
        names = tuple(drone.name for drone in info.drones)
        self._rate_hz = rate_hz
        self._spaces = _spaces(self._scenario)
        variables = {name: space.names for name, space in self._spaces.items()}
        age_s = self._scenario.time.max_command_age_ms / 1e3 / STAMPS_PER_AGE
        self._time_monitor = TimeMonitor(link, observer, age_s if info.mode == "realtime" else math.inf)
        told = partial(self._on_foreign_request, bool(info.replay_of))
        self.views = ViewBuffer(link, info, observer, variables, self._on_refused_command, asked=told)
        self._monitor = RunMonitor(self.views, self._time_monitor, self._scenario, bool(info.replay_of), world)
        self._client = CommandClient(link, observer.name, self.views, self._time_monitor.now_ns, self._on_outcome)
        members = {cluster.name: tuple(cluster.drones) for cluster in self._scenario.clusters}
        unflyable, silent_s = self._monitor.unflyable, lambda: self._time_monitor.silent_s
        whose = self._client, info.run_id, members, names
        self.orders = OrderBook(*whose, unflyable, lambda: observer.now_ns, silent_s, self.views.external)
        self.views.on_own_event = self.orders.on_event
        self.record = RecordPlayer(self._client, self._time_monitor, bool(info.replay_of), len(names))
        hats = self._scenario.environment.hats
        self.cameras = CameraFeed(link, observer, names, (Hats() if hats is UNSET else hats).diameter_m)
        self._frustums = frustums
        self._names = names
        rates = {drone.name: own_rates(drone) for drone in self._scenario.drones}
        self._table_rows = TableRows(self.views, rates, self._monitor.board.severity_of)
        self._table_s = self._monitor_s = 0.0
        self._scene = RunScene(server, info, self._scenario, self._spaces, self.views, camera_follow)
        self._scene.nodes.on_click(self._on_click)
        show = self._scene.nodes.show
        self._page = ConsolePage(
            server.gui, self._scenario, self._spaces, self._client, self._on_outcome, show, info.rate, info.drones,
            self._scene.trails.choose_length, replayed=bool(info.replay_of),
            request_return=lambda cluster: self.flying.returns.request_formation(cluster),
            show_preview=self._scene.preview,
        )  # fmt: skip
        page = self._page
        self.desk = ControlDesk(list(self._spaces), self._tell)
        self._told_s: dict[int, float] = {}  # wall; when a page was last told that it is not in control
        self._members = {cluster.name: cluster.drones for cluster in self._scenario.clusters}
        folders = page.control_folder, page.drone_folder, page.figure_folder, page.event_folder, page.theme_folder
        control = self.desk, self.part_of, page.parts
        self._page_forms = PageForms(
            server, self._client, list(names), self._scene.nodes.radii_m, *control, *folders, self._return_drones
        )
        seen = self.views, self._time_monitor, self._monitor, self._scene, self._page_forms
        self.flying = PageFlying(
            info, self._scenario, self._spaces, self._client, observer.name, *seen, self._note_return
        )

    def close(self) -> None:
        """Send nothing any more."""
        self._client.close()
        self._page_forms.close()
        self.cameras.close()
        self._frustums.clear()
        self._scene.nodes.close()

    def run(self, stopped: Callable[[], bool]) -> None:
        """Draw pictures until the run is over or `stopped` returns true."""
        self.views.open()
        self.cameras.open()
        self.record.load()
        timeline = self.record.timeline
        if timeline:
            self._monitor.record_s = timeline["from_s"], timeline["to_s"]
        pause = threading.Event()
        next_s = time.monotonic()
        with self._time_monitor.polling(), self.flying.running():
            while not self._observer.end_reason and not stopped():
                self._update(time.monotonic())
                next_s = max(next_s + self._period_s(), time.monotonic())
                pause.wait(next_s - time.monotonic())
        self._draw_end()

    def end(self, reason: str) -> None:
        """Show that the run is over; to be called after `run`, which shows that by itself where it learns of it."""
        self._monitor.end(reason)
        self._monitor.update(time.monotonic())
        with self._server.atomic():
            self._update_tables(time.monotonic())

    def state(self) -> dict[str, Any]:
        """Return what is shown, as plain data: for programs, and for tests."""
        state = console_state(self._info.run_id, self.views, self._time_monitor, dict(self._scene.shapes))
        return {**state, "cameras": self.cameras.state(), "timeline": self.record.state(self._monitor.condition)}

    def part_of(self, drone: str) -> str:
        """Return what a page must be in control of to let a drone take off, or to fly it."""
        return next((name for name, drones in self._members.items() if drone in drones), RUN)

    def permits(self, client_id: int, control: str) -> bool:
        """Return whether a page may use a control of all pages; tell it why where it may not."""
        part = self._page.parts.get(control)
        refusal = "" if part is None else self.desk.use(client_id, part)
        if refusal and time.monotonic() - self._told_s.get(client_id, -math.inf) > TOLD_S:
            self._told_s[client_id] = time.monotonic()
            self._tell(client_id, f"Refused: {refusal}")
        return not refusal

    def head(self) -> dict[str, Any]:
        """Return the head of the page, as plain data."""
        head, stall = self._monitor.head(time.monotonic()), self._time_monitor.stall
        stood = stall and {"lasted_s": stall.lasted_s, "ago_s": time.monotonic() - stall.ended_s}
        ages = {"heard_s": self._time_monitor.heard_s, "stall": stood}
        return {**head, **ages, "run_id": self._info.run_id, "orders": self.orders.rows()}

    def command(self, request: OrderRequest) -> dict[str, Any]:
        """Do what a button of the page asks for; return what becomes of it, as plain data with its `state`."""
        if request.op == "acknowledge":
            self._monitor.board.acknowledge()
            return {"id": request.id, "op": request.op, "state": "confirmed", "reason": ""}
        return self.orders.place(request)

    # A picture

    def _period_s(self) -> float:
        """Return the time from one to the next [wall]."""
        rate = self._time_monitor.clock.rate if self._time_monitor.clock is not None else 0.0
        return 1.0 / (self._rate_hz or picture_rate_hz(len(self._names), rate))

    def _update(self, wall_s: float) -> None:
        self._observer.tick()
        new = self.views.update()
        if new and self.views.drones is not None:
            self._monitor.flight.update(self.views.drones)
        if wall_s - self._monitor_s >= TABLE_S:
            self._monitor_s = wall_s
            if self._info.replay_of and self._scene.drones is not None:
                self._keep_past(self._scene.drones.t_ns / 1e9)
            self._update_monitor(wall_s)
        self._fill_past(self.record.take())
        self.cameras.update()
        self.flying.returns.tick()
        for form in self._page.forms.values():
            form.send(wall_s)
        if not self._server.get_clients():
            self._store_unseen(new)
            return
        with self._server.atomic():
            if new:
                self._draw()
            self._frustums.draw(self._scene.drones, self.cameras.shown)
            if wall_s - self._table_s >= TABLE_S:
                self._table_s = wall_s
                self._update_tables(wall_s)

    def _return_drones(self, drones: Sequence[str]) -> None:
        self.flying.returns.request_drones(drones)

    def _update_monitor(self, wall_s: float) -> None:
        """Keep up with the run's condition and with orders, and note what is done that was accepted before."""
        for done in self._monitor.update(wall_s):
            self._note("done", done.subject, f"{done.text}: done")
        self._update_orders()

    def _update_orders(self) -> None:
        run, drones = self._monitor.condition, self.views.drones
        states = {**run.drones, **{name: phase for name, (phase, _) in run.phases.items()}}
        self.orders.update(states, drones.t_ns if drones else -1, paused=run.clock != "running")

    def _on_click(self, event: viser.SceneClickEvent) -> None:
        drone = self._scene.clicked(event)
        if drone is not None:
            self._page_forms.choose(event.client_id, drone)
            self._frustums.click(event.client_id, drone)

    def _draw_end(self) -> None:
        """Draw the end of the run, for pages that are opened between two runs."""
        self.views.update()
        if self._observer.end_reason or self.views.end:
            self._monitor.end(self._observer.end_reason)
        self._monitor.update(time.monotonic())
        self._update_orders()
        with self._server.atomic():
            if self.views.drones is not None:
                self._draw()
            self._update_tables(time.monotonic())

    def _store_unseen(self, new: bool) -> None:
        """Store what pages show of the time before they were opened."""
        if new and self.views.drones is not None:
            self._add_newest_points(self._scene.store(self.views.drones))

    def _fill_past(self, instants: list[PastInstant]) -> None:
        """Add what was read of a record to trails and plots."""
        for past in instants:
            drones = drone_poses(past.drones, self._names)
            self._scene.trails.add(drones.t_ns / 1e9, drones.p_W)
            known = {n: v for n, v in past.clusters.items() if n in self._spaces and v.names == self._spaces[n].names}
            self._add_points(drones, self._scene.shapes_of(drones), known, past.estimates)
        self._scene.trails.number += bool(instants)

    def _keep_past(self, t_s: float) -> None:
        """Let the record be read around the instant that a replay shows, and forget what is far from it."""
        self.record.fill(t_s)
        kept = t_s - KEPT_S, t_s + KEPT_S
        self._scene.trails.keep(*kept)
        for history in (self._page.flights.history, *(plots.history for plots in self._page.plots.values())):
            history.keep(*kept)

    def _draw(self) -> None:
        assert self.views.drones is not None
        drones = self._scene.draw(self.views.drones, self._period_s(), self._page.chosen)
        self._page_forms.move_rings(drones)
        self._add_newest_points(drones)

    def _add_newest_points(self, drones: DronePoses) -> None:
        estimates = {name: each.estimate for name, each in self.views.estimates().items() if each.fresh}
        self._add_points(drones, self._scene.shapes, self.views.clusters, estimates)

    def _add_points(
        self,
        drones: DronePoses,
        shapes: Mapping[str, FormationShape | None],
        clusters: Mapping[str, ViewCluster],
        estimates: Mapping[str, EstimateView],
    ) -> None:
        """Add the formations' variables and the drones' flight to the plots."""
        t_s = drones.t_ns / 1e9
        for name, true_shape in shapes.items():
            view = clusters.get(name)
            if view is not None:
                true_c = None if true_shape is None else true_shape.c
                self._page.plots[name].history.add(t_s, view.desired, view.value, true_c)
        self._page.flights.add(drones, estimates)

    # Tables

    def _update_tables(self, wall_s: float) -> None:
        page = self._page
        flown = self._monitor.flight.figures
        self._update_controls(flown)
        page.phases.content = console_tables.formation_lines(self._monitor.condition.phases)
        self._page_forms.show_drones(self._table_rows.drone_rows(), flown)
        watch = self._monitor.fault_watch
        page.faults.content = console_tables.fault_lines(watch.lines(), watch.lines(is_over=True))
        if page.chosen:
            page.forms[page.chosen].refresh(self.views.clusters.get(page.chosen), wall_s)
            page.plots[page.chosen].draw(self._scene.drones.t_ns / 1e9 if self._scene.drones else 0.0)
        self._scene.draw_trails()

    def _update_controls(self, flown: Mapping[str, FlightFigures]) -> None:
        """Grey out what would be refused, and show on each page the drone that it has chosen."""
        self._page.refresh(self._monitor.condition)
        self.desk.release_lost()
        self._page_forms.refresh(self._monitor.condition, self._page.chosen)
        self._page_forms.show_figures(
            lambda drone: console_tables.figure_lines(flown.get(drone)), self._table_rows.sensor_table
        )
        self._page_forms.show_events(self.views.log.rows())

    def _on_outcome(self, outcome: RequestOutcome) -> None:
        """Show the outcome of a request: a refusal in the corner of every page, and among the events.

        The world publishes an event of what it has done, but not of requests to formations, which are only accepted.
        """
        if outcome.order and not self.orders.note(outcome):
            return
        if outcome.refusal:
            self.flying.returns.refused(outcome.subject)
            self._note("refused", outcome.subject, f"{outcome.request}: {outcome.refusal}")
            self._notify(outcome.request, outcome.refusal)
            return
        known = self._monitor.pending.accept(outcome.subject, outcome.op, outcome.request, outcome.args)
        if known or outcome.subject in self._spaces:
            self._note("accepted", outcome.subject, f"{outcome.request}: accepted")

    def _note_return(self, subject: str, text: str) -> None:
        self._note("refused", subject, text)
        self._notify(f"return of {subject}", text)

    def _note(self, kind: str, subject: str, text: str) -> None:
        """Add an event of the console's own to those that are shown."""
        self.views.log.add(Event(self._observer.now_ns, 0, kind, self._observer.name, subject, text))

    def _on_refused_command(self, event: Event) -> None:
        """Show that the world has refused a command of the console's."""
        self._notify(event.subject, str(event.data.get("reason", event.text)))

    def _on_foreign_request(self, replayed: bool, cluster: str, text: str) -> None:
        """Tell every page that somebody else has asked a formation for something: the last word must be seen."""
        for client_id in () if replayed else self._server.get_clients():
            self._tell(client_id, text)

    def _tell(self, client_id: int, line: str) -> None:
        """Tell one page about who is in control."""
        client = self._server.get_clients().get(client_id)
        if client is not None:
            client.add_notification("Control", line, color="orange", auto_close_seconds=NOTICE_S)

    def _notify(self, what: str, refusal: str) -> None:
        for client in self._server.get_clients().values():
            client.add_notification(f"Refused: {what}", refusal, color="red", auto_close_seconds=NOTICE_S)
