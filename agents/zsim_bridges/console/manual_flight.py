"""Single drones on the pages of one run: flown by stick or to waypoints, returned to their starts, shown in plan view.

A page acquires a drone, commands it at a steady rate, and releases it. The drone hovers as soon as motion is no longer
requested: when the stick is released, or the page is silent, hidden or gone. A return flies a drone to a point above
its start, or a formation, through its controller, to above the middle of its drones' starts, and lands it. A later
request ends a return. Positions and velocities are in W, unless the suffix of a name says otherwise.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from zsim.contract.flight_messages import ViewCluster, state_refusal
from zsim.math import elementary as el
from zsim.math.frames import turned_about_up
from zsim.math.rotation import Vector
from zsim.scenario.scenario import Piloted, Scenario
from zsim.vehicles.vehicle import Limits
from zsim_agents.references.cruise import Course, Cruise
from zsim_agents.references.flight import limits_of
from zsim_bridges.console.console_page import PageForms
from zsim_bridges.console.formation_form import HORIZONTAL_RANGE_M, height_range_m
from zsim_bridges.console.orders import CommandClient, NoAnswer
from zsim_bridges.console.picture import PLAN_DIGITS, plan_formations, plan_positions, surroundings
from zsim_bridges.console.run_monitor import RunMonitor
from zsim_bridges.console.scene import RunScene

PERIOD_S = 0.05  # wall; period of commands: at 5 × real time, two within the firmware's limit of silence (0.5 s)
STALE_S = 0.5  # wall; the drone of a page that is silent for longer hovers; equal to the firmware's limit of silence
PAGE_TIMEOUT_S = 5.0  # wall; time after which the drone of a lost page is released, unless the page has been reloaded
REPEAT_S = 1.0  # wall; time after which an unanswered request for a drone is repeated
SETTLED_S = 1.5  # wall; time after which a view must show who has acquired a drone; views arrive 20 times a second
RATE_MAX = 5.0  # × real time; at a higher rate nobody can fly manually, and the firmware mistakes pauses for silence
CLIMB_SHARE = 0.5  # ratio of climb to horizontal speed; design choice: height is harder to judge on a page
YAW_RATE_RAD_S = math.radians(45.0)  # design choice: a full turn in 8 s
SPEED_M_S = 1.5  # speed towards a waypoint; design choice: the default speed limit of formations
WAYPOINT_REACHED_M = 0.5  # distance from a waypoint at which a drone proceeds to the next one
WAYPOINTS_MAX = 50  # maximum number of waypoints per drone; design choice: more would no longer be manual flight
BRAKE_S = 1.0  # time constant of braking before the fence; design choice: three times the lag of the velocity loop
ABOVE_START_M = 0.5  # horizontal distance from its start at which a drone lands; design choice: the size of a hull
OVER_STARTS_M = 0.5  # distance from the middle of its drones' starts at which a formation lands
OVERRULED_M = 1.0  # a returning formation is considered sent elsewhere when its goal recedes by more than this
CENTRE_VARIABLES = ("x_c", "y_c")  # the variables of a formation that a return sets
Point = tuple[float, float]  # x, y [m; W]


class Stick(NamedTuple):
    """Deflections of a stick or of held keys, -1 to 1, in the drone's heading frame; a turn is positive to the left."""

    forward: float
    left: float
    up: float
    turn: float
    speed_m_s: float  # horizontal speed at full deflection


class DronePose(NamedTuple):
    """A drone's estimated position, heading and velocity, and their simulated time."""

    p_W: Vector  # m
    yaw_rad: float
    v_W: Vector = (0.0, 0.0, 0.0)  # m/s
    t_s: float = 0.0


class VelocityCommand(NamedTuple):
    """A velocity command in the heading frame."""

    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    yaw_rate_rad_s: float = 0.0


HOVER = VelocityCommand()


class DroneStatus(NamedTuple):
    """What the console knows of a drone: its firmware's state (empty before the first view), commander and estimate."""

    state: str = ""
    commander: str | None = None
    pose: DronePose | None = None


class RunStatus(NamedTuple):
    """The part of a run's state that matters to manual flight."""

    refusal: str = ""  # why nothing can be flown; otherwise empty
    rate: float = 1.0  # simulated seconds per wall second, as measured
    is_paused: bool = False
    silence: str = ""  # description of a silent world, which does not prevent a request for a drone


class FlightAnswer(NamedTuple):
    """What a page shows about the drone that it flies."""

    drone: str = ""
    state: str = "none"  # none, taking or flying
    text: str = ""  # why the page does not fly the drone, or what the drone is doing
    over: bool = False  # whether the page may take the drone over from its commander
    commander: str = ""
    id: str = ""  # id of the page's request to take the drone
    goal: Vector | None = None  # the drone's present destination [m; W]
    then: tuple[Vector, ...] = ()  # its later destinations [m; W]


class Geofence(NamedTuple):
    """A box around the drones' starts, given by two corners [m; W]."""

    low_m: Vector
    high_m: Vector

    def refusal(self, x_m: float, y_m: float) -> str:
        """Return why no drone may be sent to a point; empty if one may."""
        for axis, value, low, high in zip("xy", (x_m, y_m), self.low_m, self.high_m, strict=False):
            if not low <= value <= high:
                return f"{axis} is {value:.1f} m, outside the geofence: {low:g} to {high:g} m"
        return ""

    def limit_velocity(self, velocity_W: Vector, p_W: Vector) -> Vector:
        """Return a demanded velocity [m/s], reduced so that a drone at `p_W` [m] comes to rest at the fence.

        Braking begins BRAKE_S before the fence would be reached; a drone outside the fence may return.
        """
        x, y, z = (
            min(max(v, min(0.0, (low - p) / BRAKE_S)), max(0.0, (high - p) / BRAKE_S))
            for v, p, low, high in zip(velocity_W, p_W, self.low_m, self.high_m, strict=True)
        )
        return x, y, z


def geofence_of(scenario: Scenario) -> Geofence:
    xs, ys, _ = zip(*(drone.position_m for drone in scenario.drones), strict=True)
    low_m, top_m = height_range_m(scenario.drones)
    corner_m = (round(min(xs)) - HORIZONTAL_RANGE_M, round(min(ys)) - HORIZONTAL_RANGE_M, low_m)
    return Geofence(corner_m, (round(max(xs)) + HORIZONTAL_RANGE_M, round(max(ys)) + HORIZONTAL_RANGE_M, top_m))


def stick_velocity(stick: Stick, pose: DronePose, limits: Limits, fence: Geofence) -> VelocityCommand:
    """Return the velocity that a stick demands, within the drone's limits and the fence."""
    speed = min(max(stick.speed_m_s, 0.0), limits.horizontal_speed_m_s)
    deflection = max(1.0, el.hypot(stick.forward, stick.left))
    climb = stick.up * min(CLIMB_SHARE * speed, limits.vertical_speed_m_s)
    demanded = (stick.forward / deflection * speed, stick.left / deflection * speed, climb)
    yaw_rate = stick.turn * min(YAW_RATE_RAD_S, math.radians(limits.yaw_rate_deg_s))
    return VelocityCommand(_fenced(turned_about_up(demanded, pose.yaw_rad), pose, fence), yaw_rate)


def _fenced(velocity_W: Vector, pose: DronePose, fence: Geofence) -> Vector:
    """Convert a velocity from W to the heading frame, reduced so that the drone stays within the fence."""
    return turned_about_up(fence.limit_velocity(velocity_W, pose.p_W), -pose.yaw_rad)


def _too_fast(rate: float, above: float = RATE_MAX) -> str:
    """Return why nobody can fly manually at a rate; empty if it is not above the limit `above`."""
    slower = f"to fly by hand, set the rate to {RATE_MAX:g} or less"
    return f"simulated time passes {rate:.1f} × as fast as wall time; {slower}" if rate > above else ""


@dataclass
class _Flight:
    """A drone that a page flies or has requested; times are wall times [s]."""

    drone: str
    modes: int  # number of modes requested of the drone so far; a further one ends the flight
    started_s: float  # when the page requested it
    seen_s: float  # when the page last sent something
    id: str = ""  # id of the page's request
    granted_s: float | None = None  # when the world granted it; None before
    sent_s: float = 0.0  # when the drone was last commanded
    stick: Stick | None = None  # present deflection; None: hover, or fly to `waypoints_W`
    waypoints_W: tuple[Vector, ...] = ()  # the drone's destinations, in order
    sent_W: Vector | None = None  # waypoint to which the drone's course leads, or None
    is_lost: bool = False  # whether the page's connection is gone
    requested_s: float = 0.0  # when the drone was last requested from the world
    is_requested: bool = False  # whether the world's answer is outstanding


class ManualFlight:
    """Flies drones for pages, each identified by any hashable value; thread-safe.

    Args:
        courses: course of each drone, for flights to waypoints.
        gate_s: simulated duration of a gate, in which at most one command is sent.
    """

    def __init__(
        self,
        client: CommandClient,
        name: str,
        limits: Mapping[str, Limits],
        courses: Mapping[str, Course],
        fence: Geofence,
        gate_s: float,
        drone_status: Callable[[str], DroneStatus],
        run_status: Callable[[], RunStatus],
        wall_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client = client
        self._name = name
        self._limits = limits
        self._courses = courses
        self._fence = fence
        self._gate_s = gate_s
        self._drone_status = drone_status
        self._run_status = run_status
        self._wall_s = wall_s
        self._lock = threading.RLock()
        self._flights: dict[Any, _Flight] = {}
        self._last_answers: dict[Any, FlightAnswer] = {}  # by page: why it does not, or no longer, fly a drone
        self._released: dict[str, float] = {}  # by released drone: when to check its release [s; wall]
        self._ticked_s = wall_s()
        self._wake = threading.Event()  # set when something must be sent at once

    @contextmanager
    def running(self) -> Iterator[None]:
        """Send commands in a separate thread while the context is open."""
        stopped = threading.Event()

        def run() -> None:
            while not stopped.is_set():
                self.tick()
                self._wake.wait(PERIOD_S)
                self._wake.clear()

        thread = threading.Thread(target=run, name="manual", daemon=True)
        thread.start()
        try:
            yield
        finally:
            stopped.set()
            self._wake.set()
            thread.join(STALE_S)
            for page in list(self._flights):
                self.leave(page)
            self._release_drones(self._wall_s())

    def take(self, page: Any, drone: str, take_over: bool, request: str = "") -> FlightAnswer:
        """Acquire a drone for a page; with `take_over`, even from its present commander, by operators' priority.

        A request repeated with the same id is carried out once; a page that has reconnected keeps its drone.
        """
        with self._lock:
            if request and self._last_answers.get(page, FlightAnswer()).id == request:
                return self._last_answers[page]
            previous_page = next(
                (key for key, flight in self._flights.items() if request and flight.id == request), None
            )
            if previous_page is not None:
                flight = self._flights[page] = self._flights.pop(previous_page)
                flight.seen_s, flight.is_lost = self._wall_s(), False
                return self.answer(page)
            if page in self._flights:
                self.leave(page)
            self._last_answers.pop(page, None)
            refusal, commander = self._take_refusal(drone), self._drone_status(drone).commander
            can_take_over = not refusal and not take_over and commander not in (None, self._name)
            if refusal or can_take_over:
                text = refusal or f"{drone} is flown by {commander}"
                self._last_answers[page] = FlightAnswer(
                    drone, text=text, over=can_take_over, commander=commander or "", id=request
                )
                return self._last_answers[page]
            now_s = self._wall_s()
            flight = _Flight(drone, self._client.modes_requested(drone), now_s, now_s, request)
            self._flights[page] = flight
        self._request(flight)
        return self.answer(page)

    def _request(self, flight: _Flight) -> None:
        flight.requested_s, flight.is_requested = self._wall_s(), True
        self._client.take(flight.drone, partial(self._on_acquired, flight))

    def steer(self, page: Any, stick: Stick | None) -> FlightAnswer:
        """Fly the page's drone by a stick; None: the dead-man switch is open, so hover, or continue to a waypoint."""
        with self._lock:
            flight = self._flights.get(page)
            if flight is not None:
                if stick is not None:
                    flight.waypoints_W = ()  # the stick overrides the waypoints
                elif flight.stick is not None:
                    self._send_soon(flight)
                flight.stick, flight.seen_s = stick, self._wall_s()
        return self.answer(page)

    def go(self, page: Any, x_m: float, y_m: float, z_m: float | None = None, append: bool = False) -> FlightAnswer:
        """Fly the page's drone to a point [m; W], at the drone's present height unless `z_m` is given.

        Args:
            append: append the point to the present waypoints instead of replacing them; after WAYPOINTS_MAX, replace
                the last one.
        """
        with self._lock:
            flight = self._flights.get(page)
            if flight is None:
                return self.answer(page)._replace(text="no drone is flown from this page; take one first")
            pose, refusal = self._drone_status(flight.drone).pose, self._fence.refusal(x_m, y_m)
            if refusal or pose is None:
                return self.answer(page)._replace(text=refusal or f"no estimate of {flight.drone}")
            waypoint = x_m, y_m, pose.p_W[2] if z_m is None else z_m
            waypoints = flight.waypoints_W if append else ()
            flight.stick, flight.seen_s = None, self._wall_s()
            if waypoints[-1:] != (waypoint,):  # a page repeats an unconfirmed request
                flight.waypoints_W = (*waypoints[: WAYPOINTS_MAX - 1], waypoint)
        return self.answer(page)

    def has_waypoints(self, page: Any) -> bool:
        with self._lock:
            flight = self._flights.get(page)
            return flight is not None and bool(flight.waypoints_W)

    def leave(self, page: Any, text: str = "") -> FlightAnswer:
        """Release the page's drone, which then hovers; `text` is the reason."""
        with self._lock:
            flight = self._flights.pop(page, None)
            if flight is not None:
                self._released[flight.drone] = -math.inf
                self._wake.set()
                if not flight.is_lost:
                    self._last_answers[page] = FlightAnswer(flight.drone, text=text, id=flight.id)
        return self.answer(page)

    def lose(self, page: Any) -> None:
        """Record that a page's connection is lost: its drone hovers at once, and is released after PAGE_TIMEOUT_S."""
        with self._lock:
            flight = self._flights.get(page)
            self._last_answers.pop(page, None)
            if flight is not None:
                flight.stick, flight.waypoints_W, flight.is_lost = None, (), True
                self._send_soon(flight)

    def answer(self, page: Any) -> FlightAnswer:
        with self._lock:
            flight = self._flights.get(page)
            if flight is None:
                return self._last_answers.get(page, FlightAnswer())
            if flight.granted_s is None:
                silence = self._run_status().silence
                text = f"requested {self._wall_s() - flight.started_s:.1f} s ago, not confirmed"
                return FlightAnswer(flight.drone, "taking", f"{text}: {silence}" if silence else text, id=flight.id)
            if self._drone_status(flight.drone).pose is None:
                text = f"hovers: no estimate of {flight.drone}"
            elif flight.waypoints_W:
                text = "goes to {:.1f}, {:.1f} m at z = {:.1f} m".format(*flight.waypoints_W[0])
            else:
                text = "flown by hand" if flight.stick is not None else "hovers"
            goal, then = next(iter(flight.waypoints_W), None), flight.waypoints_W[1:]
            return FlightAnswer(flight.drone, "flying", text, id=flight.id, goal=goal, then=then)

    def tick(self) -> None:
        """Command every drone that is due; release those that may no longer be flown.

        All commands and releases are sent from here, in one thread: no command may follow a newer one or a release.
        """
        wall_s, run = self._wall_s(), self._run_status()
        stalled_s, self._ticked_s = wall_s - self._ticked_s, wall_s
        stall = f"the console stood still for {stalled_s:.0f} s" if stalled_s > PAGE_TIMEOUT_S else ""
        period_s = max(PERIOD_S * 0.9, self._gate_s / max(run.rate, 1e-3))  # a slow run has few gates a second
        for page, flight in list(self._flights.items()):
            reason = stall or self._end_reason(flight, run, wall_s)
            if reason:
                self.leave(page, reason)
            elif flight.granted_s is None:
                if not flight.is_requested and not run.silence and wall_s - flight.requested_s >= REPEAT_S:
                    self._request(flight)
            elif not run.is_paused and wall_s - flight.sent_s >= period_s:
                flight.sent_s = wall_s
                command = self._velocity(flight, wall_s)
                self._client.send_velocity(flight.drone, command.velocity_m_s, command.yaw_rate_rad_s)
        self._release_drones(wall_s)

    def _release_drones(self, wall_s: float) -> None:
        """Release drones, and again if a command accepted after the release made the console their commander."""
        with self._lock:
            due = [drone for drone, at_s in self._released.items() if wall_s >= at_s]
            flown_drones = {flight.drone for flight in self._flights.values()}
            for drone in due:
                first = self._released.pop(drone) == -math.inf
                if drone not in flown_drones and (first or self._drone_status(drone).commander == self._name):
                    self._released[drone] = wall_s + SETTLED_S
                    self._client.release_drone(drone)

    def _take_refusal(self, drone: str) -> str:
        run, status = self._run_status(), self._drone_status(drone)
        if drone not in self._limits:
            return f"drone is {drone!r}; must be one of the run's"
        if any(flight.drone == drone for flight in self._flights.values()):
            return f"{drone} is flown from another page"
        return run.refusal or _too_fast(run.rate) or state_refusal(drone, status.state or "unseen", "velocity") or ""

    def _on_acquired(self, flight: _Flight, refusal: str) -> None:
        with self._lock:
            flight.is_requested = False
            page = next((key for key, each in self._flights.items() if each is flight), None)
            if page is None:
                if not refusal or isinstance(refusal, NoAnswer):  # the page has released it in the meantime
                    self._released[flight.drone] = -math.inf
            elif isinstance(refusal, NoAnswer):
                return  # `tick` requests it again
            elif refusal:
                del self._flights[page]
                if not flight.is_lost:
                    self._last_answers[page] = FlightAnswer(flight.drone, text=refusal, id=flight.id)
            else:
                flight.granted_s = self._wall_s()

    def _end_reason(self, flight: _Flight, run: RunStatus, wall_s: float) -> str:
        drone, status = flight.drone, self._drone_status(flight.drone)
        if wall_s - flight.seen_s > PAGE_TIMEOUT_S:
            return "the page was silent"
        if self._client.modes_requested(drone) != flight.modes:
            return f"another mode of {drone} was requested"
        if flight.granted_s is not None and wall_s - flight.granted_s > SETTLED_S and status.commander != self._name:
            return f"{drone} is flown by {status.commander or 'nobody'} now"
        refusal = run.refusal or (run.silence if flight.granted_s is not None else "")
        return refusal or _too_fast(run.rate, 2.0 * RATE_MAX) or state_refusal(drone, status.state, "velocity") or ""

    def _velocity(self, flight: _Flight, wall_s: float) -> VelocityCommand:
        pose, limits, stick = self._drone_status(flight.drone).pose, self._limits[flight.drone], flight.stick
        waypoint = self._next_waypoint(flight, pose) if stick is None else None
        if wall_s - flight.seen_s > STALE_S or pose is None:
            waypoint = stick = None
        previous, flight.sent_W = flight.sent_W, waypoint
        if pose is None or waypoint is None:
            return HOVER if pose is None or stick is None else stick_velocity(stick, pose, limits, self._fence)
        course, position, velocity = self._courses[flight.drone], (*pose.p_W, pose.yaw_rad), (*pose.v_W, 0.0)
        if previous is None:
            course.leave()  # otherwise it would continue from the end of the previous flight to a waypoint
        if waypoint != previous:
            climb_m_s = CLIMB_SHARE * min(SPEED_M_S, limits.horizontal_speed_m_s)
            course.send((*waypoint, None), pose.t_s, position, velocity, speeds=Cruise(SPEED_M_S, climb_m_s, climb_m_s))
        velocity_W, turn = course.velocity(pose.t_s, position, velocity)
        return VelocityCommand(_fenced(velocity_W, pose, self._fence), turn)

    def _next_waypoint(self, flight: _Flight, pose: DronePose | None) -> Vector | None:
        """Return the drone's next waypoint after dropping the one that it has reached, unless that is the last."""
        with self._lock:
            waypoints = flight.waypoints_W
            if pose is not None and len(waypoints) > 1 and el.distance(pose.p_W, waypoints[0]) <= WAYPOINT_REACHED_M:
                waypoints = flight.waypoints_W = waypoints[1:]
            return next(iter(waypoints), None)

    def _send_soon(self, flight: _Flight) -> None:
        """Make the next command due at once."""
        flight.sent_s = -math.inf
        self._wake.set()


class PageFlying:
    """Flies single drones for the pages of one run; pages are identified by viser's number.

    `on_return_over` is called with each drone or formation whose return ends without a landing, and the reason, unless
    a formation's return was refused or followed by another request from the console, or the formation has no view.
    """

    def __init__(
        self,
        monitor: RunMonitor,
        client: CommandClient,
        name: str,
        scene: RunScene,
        pages: PageForms,
        on_return_over: Callable[[str, str], None] = lambda subject, why: None,
    ) -> None:
        self._run = run = monitor.run
        self._views = views = monitor.views
        self._monitor = monitor
        self._scene = scene
        self.pages = pages
        self._members = {name: [run.names.index(each) for each in drones] for name, drones in run.members.items()}
        fence = geofence_of(run.scenario)
        self._surroundings = {**surroundings(run.scenario), "fence": fence._asdict()}
        limits = {drone.name: drone.limits for drone in run.scenario.drones}
        gravity_m_s2, gate_s = run.scenario.environment.gravity_m_s2, run.info.gate_ns / 1e9
        courses = {
            drone.name: Course(limits_of(drone, gravity_m_s2), drone.reference or Piloted())
            for drone in run.scenario.drones
        }
        self.control = ManualFlight(client, name, limits, courses, fence, gate_s, self._drone_status, self._run_status)
        self.returns = ReturnFlights(
            run.scenario, client, self.control, self._drone_status, lambda: views.clusters, on_return_over
        )

    def plan(self, client_id: int | None, complete: bool) -> dict[str, Any]:
        """Return the plan view as plain data; with `complete`, including the constant part and the past trails."""
        drones, chosen = self._scene.drones, self.pages.chosen(client_id)
        if drones is None:
            return {"t_s": None, "chosen": chosen}
        states = {each.name: each.state for each in self._views.drones.drones} if self._views.drones else {}
        previews = list(self._scene.previews.values())
        shown = {
            "t_s": drones.t_ns / 1e9,
            "chosen": chosen,
            "drones": plan_positions(drones, states),
            "formations": plan_formations(self._run.spaces, self._members, dict(self._views.clusters)),
            "previews": [np.round(paths[:, :, :2], PLAN_DIGITS).tolist() for paths in previews],
            "trail_s": self._scene.trails.length_s,
            "trails_number": self._scene.trails.number,
        }
        if not complete:
            return shown
        return {**shown, **self._surroundings, "trails": self._scene.trails.lines(drones.t_ns / 1e9, drones.p_W)}

    def _drone_status(self, drone: str) -> DroneStatus:
        view = self._views.drones
        drone_view = next((each for each in view.drones if each.name == drone), None) if view else None
        if drone_view is None:
            return DroneStatus()
        received = self._views.estimates().get(drone)
        pose = None
        if received is not None and received.is_fresh:
            estimate = received.estimate
            t_s = received.t_ns * 1e-9
            pose = DronePose(estimate.position_m, estimate.yaw_rad, estimate.velocity_m_s, t_s)
        return DroneStatus(drone_view.state, drone_view.commander, pose)

    def _run_status(self) -> RunStatus:
        clock, run = self._monitor.time_monitor.clock, self._monitor.now()
        silence, refusal = run.outage() if run.silent_s else "", run._replace(silent_s=0.0).flight_refusal()
        is_paused = clock is not None and clock.state != "running"
        return RunStatus(refusal, clock.rate if clock else 1.0, is_paused, "" if refusal else silence)


class ReturningDrone(NamedTuple):
    """Identifies a returning drone to ManualFlight, in place of a page."""

    drone: str


@dataclass
class _ReturningFormation:
    requests: int  # number of requests made to the formation so far, including the return itself
    nearest_m: float = math.inf  # minimum distance so far between its goal and the middle of its drones' starts


class ReturnFlights:
    """The return flights of a run's drones and formations; thread-safe. `control` flies drones to waypoints."""

    def __init__(
        self,
        scenario: Scenario,
        client: CommandClient,
        control: ManualFlight,
        status_of: Callable[[str], DroneStatus],
        clusters: Callable[[], Mapping[str, ViewCluster]],
        on_return_over: Callable[[str, str], None] = lambda subject, why: None,
    ) -> None:
        self._client = client
        self._control = control
        self._status_of = status_of
        self._clusters = clusters
        self._on_return_over = on_return_over
        self._lock = threading.Lock()
        self.starts: dict[str, Point] = {each.name: each.position_m[:2] for each in scenario.drones}
        self.centres: dict[str, Point] = {}
        for cluster in scenario.clusters:
            x_m, y_m = np.mean([self.starts[name] for name in cluster.drones], axis=0).tolist()
            self.centres[cluster.name] = (round(x_m, 2), round(y_m, 2))
        self._drones: set[str] = set()
        self._formations: dict[str, _ReturningFormation] = {}

    def request_drones(self, drones: Sequence[str]) -> None:
        """Take over each drone, fly it to above its start at its present height, and land it there."""
        for drone in drones:
            answer = self._control.take(ReturningDrone(drone), drone, take_over=True)
            if answer.state == "none":
                self._on_return_over(drone, answer.text)
                continue
            with self._lock:
                self._drones.add(drone)

    def request_formation(self, cluster: str) -> None:
        """Move a formation, in its present shape, to above the middle of its drones' starts, and land it there."""
        values = dict(zip(CENTRE_VARIABLES, self.centres[cluster], strict=True))
        self._client.request_cluster(cluster, "target", values=values)
        with self._lock:
            self._formations[cluster] = _ReturningFormation(self._client.cluster_requests[cluster])

    def refused(self, cluster: str) -> None:
        """Record that a request to a formation was refused, which ends its return."""
        with self._lock:
            self._formations.pop(cluster, None)

    def tick(self) -> None:
        """Continue all returns; to be called several times a second."""
        with self._lock:
            drones, formations = list(self._drones), list(self._formations.items())
        for drone in drones:
            if not self._continue_drone(drone):
                with self._lock:
                    self._drones.discard(drone)
        for name, returning in formations:
            if not self._continue_formation(name, returning):
                with self._lock:
                    self._formations.pop(name, None)

    def _continue_drone(self, drone: str) -> bool:
        """Send a drone to its start, or land it if it is above its start; return whether it is still returning."""
        key, pose = ReturningDrone(drone), self._status_of(drone).pose
        answer = self._control.steer(key, None)  # keeps the flight alive, as an open page does
        if answer.state == "none":
            self._on_return_over(drone, f"return of {drone} is over: {answer.text or 'it was released'}")
            return False
        if answer.state == "taking" or pose is None:
            return True
        x_m, y_m = self.starts[drone]
        if math.hypot(pose.p_W[0] - x_m, pose.p_W[1] - y_m) <= ABOVE_START_M:
            self._control.leave(key)
            self._client.send_mode([drone], "land")
            return False
        if not self._control.has_waypoints(key):
            self._control.go(key, x_m, y_m)
        return True

    def _continue_formation(self, name: str, returning: _ReturningFormation) -> bool:
        """Land a formation once it has arrived above its drones' starts; return whether it is still returning."""
        view = self._clusters().get(name)
        if self._client.cluster_requests[name] != returning.requests or view is None:
            return False  # another request was made, or there is no view of the formation
        if view.phase != "engaged":
            self._on_return_over(name, f"return of {name} is over: it is {view.phase}")
            return False
        desired, value = (dict(zip(view.names, c, strict=True)) for c in (view.desired, view.value))
        goal_m, distance_m = (
            math.dist([c[each] for each in CENTRE_VARIABLES], self.centres[name]) for c in (desired, value)
        )
        returning.nearest_m = min(returning.nearest_m, goal_m)
        if goal_m > returning.nearest_m + OVERRULED_M:
            self._on_return_over(name, f"return of {name} is over: it was sent elsewhere")
            return False
        if max(goal_m, distance_m) > OVER_STARTS_M:
            return True
        self._client.request_cluster(name, "land")
        return False
