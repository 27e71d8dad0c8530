"""The console: shows one run after another on a viser server that only its own HTTP server can reach.

A `RunPage` shows the views of one run as pictures, tables and plots, and sends the operators' requests.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import viser
from msgspec import UNSET

from zsim.contract.flight_messages import EstimateView, ViewCluster, ViewDrones
from zsim.contract.messages import Info
from zsim.contract.run_messages import Event
from zsim.errors import DocumentError, RunError
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.sensors.camera import Hats
from zsim.sensors.sensor_catalogue import own_rates
from zsim.transport.session import Session
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_bridges.console import console_tables
from zsim_bridges.console.camera_feed import CameraFeed
from zsim_bridges.console.console_page import ConsolePage, PageForms
from zsim_bridges.console.console_tables import TableRows
from zsim_bridges.console.control_desk import OPERATOR, RUN, VIEWER, ControlDesk
from zsim_bridges.console.manual_flight import PageFlying
from zsim_bridges.console.orders import CommandClient, OrderBook, OrderRequest, PastInstant, RequestOutcome
from zsim_bridges.console.page_cameras import PageCameras
from zsim_bridges.console.page_server import (
    HttpProxy,
    ListenAddress,
    PageControls,
    PrivateViser,
    RunFiles,
    ViserBackend,
    is_permitted,
)
from zsim_bridges.console.page_sockets import ActionSockets, CameraSockets
from zsim_bridges.console.picture import DronePoses, FormationShape, drone_poses
from zsim_bridges.console.run_condition import ShownRun, no_run_head
from zsim_bridges.console.run_monitor import KEPT_S, RecordPlayer, RunMonitor, TimeMonitor
from zsim_bridges.console.scene import RunScene
from zsim_bridges.console.view_buffer import ViewBuffer

REASON_S = 0.1  # wall time between two checks for a reason to end
OFFER_S = 20.0  # wall time; how long pages may take to copy the files of a run: 100 MB over 40 Mbit/s Wi-Fi
TABLE_S = 0.5  # wall time; period of tables, plots and trails: people cannot read faster
STAMPS_PER_AGE = 5.0  # a command's maximum age divided by that of a new stamp, since stamps age in transit
REFUSAL_S = 2.0  # wall time; minimum between two refusals shown on a page: a dragged slider is refused many times
NOTICE_S = 8.0  # wall time; how long a notification stays in the corner
EVENTS_MAX = 20  # maximum number of events in `state`
SILENT = "silent"  # replaces the clock's state while the world does not answer
FEW_DRONES = 20  # with this number of drones or more, RATE_LOW_HZ applies
RATE_HZ, RATE_LOW_HZ = 20.0, 10.0
FAST_RATE = 4.0  # × real time; for a run at this rate or more, RATE_LOW_HZ applies too: the run needs the processors


class Console:
    """Serves the console's pages, which show one run after another.

    Args:
        token: the operators' token; None if only this machine can connect.
        rate_hz: pictures per second; None: derived from the number of drones and the rate of the run.
        world: description of where the console looks for a run.
        folder: where the shown run is recorded, if known.

    Raises:
        RunError: other machines could reach the console, and there is no token.
    """

    def __init__(
        self,
        address: ListenAddress,
        name: str,
        token: str | None,
        rate_hz: float | None,
        say: Callable[[str], None],
        world: str = "",
        folder: Path | None = None,
    ) -> None:
        self._files = RunFiles(folder)
        self._name = name
        self._world = world
        self._ended = ""
        self._rate_hz = rate_hz
        self._say = say
        self._run_page: RunPage | None = None
        self._viser = PrivateViser(lambda *use: self._run_page is None or self._run_page.permits(*use))
        server = self._viser.server
        self._cameras = PageCameras(server)
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.set_panel_label("zsim")
        server.gui.add_markdown(f"Waiting for a world: {world}" if world else "Waiting for a world")
        controls = PageControls(server.gui, lambda: [page.gui for page in server.get_clients().values()])
        cameras = CameraSockets(lambda: self._run_page and self._run_page.cameras, self._cameras)
        actions = ActionSockets(
            self._cameras,
            lambda: self._run_page and self._run_page.record,
            lambda: self._run_page and self._run_page.flying,
        )
        backend = ViserBackend(
            port=self._viser.port,
            secret=self._viser.secret,
            state=lambda: self._run_page.state() if self._run_page else {"run_id": None},
            permits=partial(is_permitted, controls=controls),
            serve_cameras=cameras.respond,
            serve_actions=actions.respond,
            head=lambda: self._run_page.head() if self._run_page else no_run_head(self._world, self._ended),
            command=self._command,
            files=self._files,
            on_poll=self._on_poll,
        )
        self._proxy = HttpProxy(address, token, backend)

    @contextmanager
    def open(self) -> Iterator[None]:
        try:
            with self._proxy.open():
                urls = self._proxy.urls()
                self._say(f"{self._name}: steer at {urls[OPERATOR]}")
                self._say(f"{self._name}: watch only at {urls[VIEWER]}")
                yield
        finally:
            self._viser.close()

    def serve(
        self,
        link: Session,
        info: Info,
        observer: Participant,
        stopped: Callable[[], bool],
        say: Callable[[str], None],
    ) -> None:
        """Show a run until it is over or `stopped` returns true."""
        view_args = self._cameras, self._rate_hz, self._world
        self._run_page = page = RunPage(self._viser.server, link, info, observer, *view_args)
        try:
            page.run(stopped)
        finally:
            page.close()

    def remain(self, end_reason: Callable[[], str | None], is_abandoned: Callable[[], bool]) -> None:
        """Serve the pages of a finished run until there is a reason to end and the pages have copies of its files.

        After OFFER_S, the console no longer waits for the copies.

        Args:
            end_reason: returns the reason, or None while there is none.
            is_abandoned: returns whether to stop waiting for the pages' copies.
        """
        while not (reason := end_reason()):
            time.sleep(REASON_S)
        self._ended = reason
        if self._run_page:
            self._run_page.end(reason)
        self._files.offer(OFFER_S, is_abandoned)

    def _on_poll(self, key: str, role: str, address: str) -> None:
        client_id = self._cameras.client_id(key)
        if self._run_page and client_id is not None:
            self._run_page.desk.record_poll(client_id, role, address)

    def _command(self, request: OrderRequest) -> dict[str, Any]:
        if self._run_page:
            return self._run_page.command(request)
        return {"id": request.id, "op": request.op, "state": "refused", "reason": "there is no run yet"}


class RunPage:
    """The page of one run.

    Args:
        server: viser's server; the controls and nodes of another run are removed from it.
        rate_hz: pictures per second; None: derived from the number of drones and the rate of the run.
        world: description of where the run is.

    Raises:
        RunError: a user's cluster space refuses its robots.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        link: Session,
        info: Info,
        observer: Participant,
        page_cameras: PageCameras,
        rate_hz: float | None,
        world: str = "",
    ) -> None:
        scenario = scenario_file.from_text(info.scenario)
        try:
            spaces = {cluster.name: scenario_space(scenario, cluster) for cluster in scenario.clusters}
        except (ValueError, DocumentError) as error:
            raise RunError(f"console: {error}") from error
        self._run = run = ShownRun(info, scenario, spaces)
        self._server = server
        self._observer = observer
        self._page_cameras = page_cameras
        self._rate_hz = rate_hz
        self._names, self._members = run.names, run.members
        self._table_s = self._monitor_s = 0.0
        self._notified_s: dict[int, float] = {}  # when a page was last notified of a refusal [s; wall]

        variables = {name: space.names for name, space in spaces.items()}
        age_s = scenario.time.max_command_age_ms / 1e3 / STAMPS_PER_AGE
        self._time_monitor = TimeMonitor(link, observer, age_s if info.mode == "realtime" else math.inf)
        self.views = ViewBuffer(
            link, info, observer, variables, self._on_refused_command, on_foreign_request=self._on_foreign_request
        )
        self._monitor = RunMonitor(self.views, self._time_monitor, run, world)
        hats = scenario.environment.hats
        self.cameras = CameraFeed(link, observer, self._names, (Hats() if hats is UNSET else hats).diameter_m)
        rates = {drone.name: own_rates(drone) for drone in scenario.drones}
        self._table_rows = TableRows(self.views, rates, self._monitor.board.severity_of)

        self._client = CommandClient(link, observer.name, self.views, self._time_monitor.now_ns, self._on_outcome)
        self.orders = OrderBook(
            self._client, info.run_id, self._members, self._names, self._monitor.flight_refusal,
            lambda: observer.now_ns, lambda: self._time_monitor.silent_s, self.views.external,
        )  # fmt: skip
        self.views.on_own_event = self.orders.on_event
        self.record = RecordPlayer(self._client, self._time_monitor, run.is_replay, len(self._names))

        self._scene = RunScene(server, run, self.views, page_cameras)
        self._scene.nodes.on_click(self._on_click)
        self._page = ConsolePage(
            server.gui, run, self._client, self._on_outcome, self._scene.nodes.show,
            self._scene.trails.choose_length, lambda cluster: self.flying.returns.request_formation(cluster),
            self._scene.preview,
        )  # fmt: skip
        self.desk = ControlDesk(list(spaces), partial(self._notify_page, "Control", "orange"))
        part_of = {drone: name for name, drones in self._members.items() for drone in drones}
        self._page_forms = PageForms(
            server, self._client, self._page, self._names, self._scene.nodes.radii_m, self.desk,
            lambda drone: part_of.get(drone, RUN), lambda drones: self.flying.returns.request_drones(drones),
        )  # fmt: skip
        self.flying = PageFlying(
            self._monitor, self._client, observer.name, self._scene, self._page_forms, self._on_return_over
        )

    def close(self) -> None:
        """Stop sending requests and receiving pictures, and remove callbacks."""
        self._client.close()
        self._page_forms.close()
        self.cameras.close()
        self._page_cameras.clear_frusta()
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
        with self._time_monitor.polling(), self.flying.control.running():
            while not self._observer.end_reason and not stopped():
                self._update(time.monotonic())
                next_s = max(next_s + self._period_s(), time.monotonic())
                pause.wait(next_s - time.monotonic())
        # pages opened between two runs show the end of this run
        self.views.update()
        if self._observer.end_reason or self.views.end:
            self._monitor.end(self._observer.end_reason)
        self._monitor.update(time.monotonic())
        self._update_orders()
        with self._server.atomic():
            if self.views.drones is not None:
                self._draw(self.views.drones)
            self._update_tables(time.monotonic())

    def end(self, reason: str) -> None:
        """Show that the run is over; called after `run`, which may have returned before the end."""
        self._monitor.end(reason)
        self._monitor.update(time.monotonic())
        with self._server.atomic():
            self._update_tables(time.monotonic())

    # For pages, in other threads

    def state(self) -> dict[str, Any]:
        state = console_state(self._run.info.run_id, self.views, self._time_monitor, dict(self._scene.shapes))
        return {**state, "cameras": self.cameras.state(), "timeline": self.record.state(self._monitor.condition)}

    def head(self) -> dict[str, Any]:
        head, stall = self._monitor.head(time.monotonic()), self._time_monitor.stall
        stalled = stall and {"lasted_s": stall.lasted_s, "ago_s": time.monotonic() - stall.ended_s}
        ages = {"heard_s": self._time_monitor.answer_age_s, "stall": stalled}
        return {**head, **ages, "run_id": self._run.info.run_id, "orders": self.orders.rows()}

    def command(self, request: OrderRequest) -> dict[str, Any]:
        """Carry out an order from a page; return its progress as plain data with its `state`."""
        if request.op == "acknowledge":
            self._monitor.board.acknowledge()
            return {"id": request.id, "op": request.op, "state": "confirmed", "reason": ""}
        return self.orders.place(request)

    def permits(self, client_id: int, control: str) -> bool:
        """Return whether a page may use a shared control, and claim its part if it is free; if not, show the reason."""
        part = self._page.parts.get(control)
        refusal = "" if part is None else self.desk.use(client_id, part)
        if refusal and time.monotonic() - self._notified_s.get(client_id, -math.inf) > REFUSAL_S:
            self._notified_s[client_id] = time.monotonic()
            self._notify_page("Control", "orange", client_id, f"Refused: {refusal}")
        return not refusal

    # Pictures

    def _period_s(self) -> float:
        """Return the wall time from one picture to the next [s]."""
        rate = self._time_monitor.clock.rate if self._time_monitor.clock is not None else 0.0
        return 1.0 / (self._rate_hz or picture_rate_hz(len(self._names), rate))

    def _update(self, wall_s: float) -> None:
        self._observer.tick()
        view = self.views.drones if self.views.update() else None  # None: nothing new
        if view is not None:
            self._monitor.flight.update(view)
        if wall_s - self._monitor_s >= TABLE_S:
            self._monitor_s = wall_s
            if self._run.is_replay and self._scene.drones is not None:
                self._keep_past(self._scene.drones.t_ns / 1e9)
            for completed in self._monitor.update(wall_s):
                self._note("done", completed.subject, f"{completed.text}: done")
            self._update_orders()
        self._fill_past(self.record.pop_instants())
        self.cameras.update()
        self.flying.returns.tick()
        for form in self._page.forms.values():
            form.send(wall_s)
        if not self._server.get_clients():
            if view is not None:  # for pages that are opened later
                self._add_newest_points(self._scene.store(view))
            return
        with self._server.atomic():
            if view is not None:
                self._draw(view)
            self._page_cameras.draw_frusta(self._scene.drones, self.cameras.info_and_picture)
            if wall_s - self._table_s >= TABLE_S:
                self._table_s = wall_s
                self._update_tables(wall_s)

    def _update_orders(self) -> None:
        run, drones = self._monitor.condition, self.views.drones
        states = {**run.drones, **{name: phase for name, (phase, _) in run.phases.items()}}
        self.orders.update(states, drones.t_ns if drones else -1, paused=run.clock != "running")

    def _draw(self, view: ViewDrones) -> None:
        drones = self._scene.draw(view, self._period_s(), self._page.chosen)
        self._page_forms.move_rings(drones)
        self._add_newest_points(drones)

    def _on_click(self, event: viser.SceneClickEvent) -> None:
        drone = self._scene.clicked(event)
        if drone is not None:
            self._page_forms.choose(event.client_id, drone)
            self._page_cameras.click(event.client_id, drone)

    # Trails and plots

    def _fill_past(self, instants: list[PastInstant]) -> None:
        """Add a piece of the record to trails and plots."""
        spaces = self._run.spaces
        for past in instants:
            drones = drone_poses(past.drones, self._names)
            self._scene.trails.add(drones.t_ns / 1e9, drones.p_W)
            known_clusters = {
                n: view for n, view in past.clusters.items() if n in spaces and view.names == spaces[n].names
            }
            self._add_points(drones, self._scene.shapes_of(drones), known_clusters, past.estimates)
        self._scene.trails.number += bool(instants)

    def _keep_past(self, t_s: float) -> None:
        """Read the record around the time that a replay shows, and drop points far from that time."""
        self.record.fill(t_s)
        kept_span_s = t_s - KEPT_S, t_s + KEPT_S
        self._scene.trails.keep(*kept_span_s)
        for history in (self._page.flights.history, *(plots.history for plots in self._page.plots.values())):
            history.keep(*kept_span_s)

    def _add_newest_points(self, drones: DronePoses) -> None:
        estimates = {name: each.estimate for name, each in self.views.estimates().items() if each.is_fresh}
        self._add_points(drones, self._scene.shapes, self.views.clusters, estimates)

    def _add_points(
        self,
        drones: DronePoses,
        shapes: Mapping[str, FormationShape | None],
        clusters: Mapping[str, ViewCluster],
        estimates: Mapping[str, EstimateView],
    ) -> None:
        """Add the formations' variables and the drones' flight to the plots."""
        for name, true_shape in shapes.items():
            view = clusters.get(name)
            if view is not None:
                true_c = None if true_shape is None else true_shape.c
                self._page.plots[name].history.add(drones.t_ns / 1e9, view.desired, view.value, true_c)
        self._page.flights.add(drones, estimates)

    # Controls and tables

    def _update_tables(self, wall_s: float) -> None:
        page, run, metrics = self._page, self._monitor.condition, self._monitor.flight.metrics
        page.refresh(run)
        self.desk.release_lost()
        self._page_forms.refresh(run, page.chosen)
        rows, sensors_of = self._table_rows.drone_rows(), self._table_rows.sensor_tables
        self._page_forms.show(rows, metrics, sensors_of, self.views.log.rows())
        page.phases.content = console_tables.formation_lines(run.phases)
        watch = self._monitor.fault_watch
        page.faults.content = console_tables.fault_lines(watch.lines(), watch.lines(is_over=True))
        if page.chosen:
            page.forms[page.chosen].refresh(self.views.clusters.get(page.chosen), wall_s)
            page.plots[page.chosen].draw(self._scene.drones.t_ns / 1e9 if self._scene.drones else 0.0)
        self._scene.draw_trails()

    def _on_outcome(self, outcome: RequestOutcome) -> None:
        """Show a refusal in the corner of every page and among the events.

        Also log the acceptance of a request to a formation, for which the world publishes no event, and of one whose
        completion can be observed.
        """
        if outcome.order and not self.orders.note(outcome):
            return
        if outcome.refusal:
            self.flying.returns.refused(outcome.subject)
            self._note("refused", outcome.subject, f"{outcome.request}: {outcome.refusal}")
            self._notify(outcome.request, outcome.refusal)
            return
        is_observable = self._monitor.pending.accept(outcome.subject, outcome.op, outcome.request, outcome.args)
        if is_observable or outcome.subject in self._run.spaces:
            self._note("accepted", outcome.subject, f"{outcome.request}: accepted")

    def _on_return_over(self, subject: str, text: str) -> None:
        self._note("refused", subject, text)
        self._notify(f"return of {subject}", text)

    def _on_refused_command(self, event: Event) -> None:
        self._notify(event.subject, str(event.data.get("reason", event.text)))

    def _on_foreign_request(self, cluster: str, text: str) -> None:
        """Notify pages, except in a replay, of another client's request to a formation, which replaces earlier ones."""
        for client_id in () if self._run.is_replay else self._server.get_clients():
            self._notify_page("Control", "orange", client_id, text)

    def _note(self, kind: str, subject: str, text: str) -> None:
        """Log an event of the console itself."""
        self.views.log.add(Event(self._observer.now_ns, 0, kind, self._observer.name, subject, text))

    def _notify(self, request: str, refusal: str) -> None:
        for client_id in self._server.get_clients():
            self._notify_page(f"Refused: {request}", "red", client_id, refusal)

    def _notify_page(self, title: str, colour: Any, client_id: int, line: str) -> None:
        """Show a notification in the corner of one page."""
        client = self._server.get_clients().get(client_id)
        if client is not None:
            client.add_notification(title, line, color=colour, auto_close_seconds=NOTICE_S)


def picture_rate_hz(drones: int, rate: float) -> float:
    """Return the picture rate [Hz] for a number of drones and a rate of the run [× real time]."""
    return RATE_LOW_HZ if drones >= FEW_DRONES or rate >= FAST_RATE else RATE_HZ


def console_state(
    run_id: str, views: ViewBuffer, time_monitor: TimeMonitor, shapes: Mapping[str, FormationShape | None]
) -> dict[str, Any]:
    """Return the shown state of a run as plain data; called from a thread other than the one that draws.

    `shapes` are the formations' true shapes.
    """
    view, clock, silent_s = views.drones, time_monitor.clock, time_monitor.silent_s
    sigmas = {name: received.sigma_m for name, received in views.estimates().items() if received.is_fresh}
    clusters = []
    for name, cluster in dict(views.clusters).items():
        shape = shapes.get(name)
        values = {"desired": cluster.desired, "value": cluster.value, "true": () if shape is None else shape.c.tolist()}
        named = {series: dict(zip(cluster.names, each, strict=False)) for series, each in values.items()}
        clusters.append({"name": name, "phase": cluster.phase, "reason": cluster.reason, **named})
    return {
        "run_id": run_id,
        "t_s": view.t_ns / 1e9 if view else 0.0,
        "clock": SILENT if silent_s else clock.state if clock else None,
        "silent_s": silent_s,
        "drones": [
            {"name": d.name, "position_m": list(d.position_m), "state": d.state, "sigma_m": sigmas.get(d.name)}
            for d in (view.drones if view else ())
        ],
        "clusters": clusters,
        "faults": [
            {
                "id": fault.id,
                "kind": fault.kind,
                "target": fault.target,
                "from_s": fault.from_ns / 1e9,
                "until_s": None if fault.until_ns is None else fault.until_ns / 1e9,
            }
            for fault in views.faults
        ],
        "events": [
            {"t_s": event.t_ns / 1e9, "kind": event.kind, "text": event.text}
            for event in list(views.log.newest)[:EVENTS_MAX]
        ],
    }
