"""A vehicle as its clients see it: arming, modes, setpoints, missions, geofence, parameters and refusals."""

import itertools
import math
import struct
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import pytest
from mavlink_drone import SCENARIO, FlownDrone

from zsim.contract import messages
from zsim.contract.flight_messages import Mode as ModeCommand
from zsim.contract.flight_messages import Velocity
from zsim.contract.run_messages import Event
from zsim.scenario.scenario import Piloted
from zsim_agents.references.path import SHARE
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import FENCE, FORCE, Cmd, MavFrame, MissionResult, Result, TypeMask
from zsim_bridges.mavlink.personality import COPTER_MODES, PX4_MODES, FlightMode

NAN = math.nan
VELOCITY_ONLY = TypeMask.X | TypeMask.Y | TypeMask.Z | TypeMask.AX | TypeMask.AY | TypeMask.AZ | TypeMask.YAW
POSITION_ONLY = 0x1F8 | TypeMask.YAW | TypeMask.YAW_RATE
AUTOPILOTS = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])


def flying(autopilot: str = "px4", altitude_m: float = 3.0) -> FlownDrone:
    """Return a vehicle that hovers at the given altitude."""
    drone = FlownDrone(autopilot)
    if autopilot == "ardupilot":
        set_mode(drone, COPTER_MODES[FlightMode.OFFBOARD])
        height = altitude_m
    else:
        height = 400.0 + altitude_m
    assert drone.command(Cmd.COMPONENT_ARM_DISARM, 1) == Result.ACCEPTED
    assert drone.command(Cmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, height) == Result.ACCEPTED
    drone.until(lambda: drone.position[2] > altitude_m - 0.25)
    drone.step(50)
    return drone


def set_mode(drone: FlownDrone, custom: int) -> int:
    if drone.vehicle._options.personality.is_px4:
        return drone.command(Cmd.DO_SET_MODE, 1, custom >> 16 & 0xFF, custom >> 24)
    return drone.command(Cmd.DO_SET_MODE, 1, custom)


def heartbeat(drone: FlownDrone) -> dialect.Heartbeat:
    drone.vehicle.tick(drone.t_ns + 10**12)
    drone.vehicle._heartbeat_ns = None
    drone.sent += drone.vehicle.take()
    return drone.all(dialect.Heartbeat)[-1]


def velocity_setpoint(
    vx: float, vy: float, vz: float, frame: int = MavFrame.LOCAL_NED
) -> dialect.SetPositionTargetLocalNed:
    mask = VELOCITY_ONLY | TypeMask.YAW_RATE
    return dialect.SetPositionTargetLocalNed(0, 1, 1, frame, mask, vx=vx, vy=vy, vz=vz)


@AUTOPILOTS
def test_a_vehicle_arms_takes_off_holds_lands_and_disarms(autopilot: str) -> None:
    drone = flying(autopilot)
    assert heartbeat(drone).base_mode & 128
    assert abs(drone.position[2] - 3.0) < 0.3
    assert [c.mode for c in drone.commands if isinstance(c, ModeCommand)] == ["takeoff"]
    assert drone.command(Cmd.NAV_LAND) == Result.ACCEPTED
    drone.until(lambda: drone.state == "landed")
    drone.step()
    assert not heartbeat(drone).base_mode & 128
    assert drone.texts() == ["Armed", "Landed; disarmed"]


def test_only_an_armed_vehicle_takes_off_and_it_disarms_if_it_does_not() -> None:
    drone = FlownDrone()
    assert drone.command(Cmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, 403.0) == Result.DENIED
    assert drone.texts() == ["Denied: not armed"]
    assert drone.commands == []
    drone.command(Cmd.COMPONENT_ARM_DISARM, 1)
    drone.step(510)
    assert drone.texts()[-1] == "Disarmed: no take-off"


def test_a_flying_vehicle_disarms_only_by_force_which_is_an_emergency() -> None:
    drone = flying()
    assert drone.command(Cmd.COMPONENT_ARM_DISARM, 0) == Result.DENIED
    assert "Denied" in drone.texts()[-1]
    assert drone.command(Cmd.COMPONENT_ARM_DISARM, 0, FORCE) == Result.ACCEPTED
    assert drone.commands[-1].mode == "emergency"
    drone.step(2)
    assert drone.command(Cmd.COMPONENT_ARM_DISARM, 1) == Result.DENIED
    assert drone.command(Cmd.PREFLIGHT_REBOOT_SHUTDOWN, 1) == Result.ACCEPTED
    drone.step(2)
    assert drone.state == "landed"
    assert drone.command(Cmd.COMPONENT_ARM_DISARM, 1) == Result.ACCEPTED


def test_px4_needs_a_setpoint_stream_for_offboard_and_holds_without_it() -> None:
    drone = flying()
    assert set_mode(drone, PX4_MODES[FlightMode.OFFBOARD]) == Result.DENIED
    drone.receive(velocity_setpoint(1.0, 0.0, 0.0))
    assert set_mode(drone, PX4_MODES[FlightMode.OFFBOARD]) == Result.ACCEPTED
    for _ in range(50):
        drone.receive(velocity_setpoint(1.0, 0.0, 0.0))
        drone.step()
    assert drone.position[1] > 0.8  # north is the y axis of W
    assert heartbeat(drone).custom_mode == PX4_MODES[FlightMode.OFFBOARD]
    drone.step(52)
    assert heartbeat(drone).custom_mode == PX4_MODES[FlightMode.HOLD]
    assert "Offboard lost" in drone.texts()[-1]
    drone.step(200)
    assert drone._velocity == pytest.approx((0.0, 0.0, 0.0), abs=0.05)


def test_a_guided_velocity_of_ardupilot_expires_after_three_seconds() -> None:
    drone = flying("ardupilot")
    drone.receive(velocity_setpoint(1.0, 0.0, 0.0))
    drone.step(140)
    assert drone._velocity[1] == 1.0
    drone.step(60)
    assert abs(drone._velocity[1]) < 0.7
    assert heartbeat(drone).custom_mode == COPTER_MODES[FlightMode.OFFBOARD]


def test_a_new_setpoint_is_sent_at_once_and_the_current_one_repeated() -> None:
    drone = flying("ardupilot")
    before = len(drone.commands)
    drone.receive(velocity_setpoint(0.5, 0.0, 0.0))
    drone.receive(velocity_setpoint(0.0, 0.5, 0.0))
    assert [c.velocity_m_s for c in drone.commands[before:]] == [(0.0, 0.5, 0.0), (0.5, 0.0, 0.0)]
    drone.step(50)
    assert len(drone.commands) - before == 2 + 10


def test_a_flood_of_setpoints_stays_within_the_rate_limit_of_the_world() -> None:
    drone = flying("ardupilot")
    before = len(drone.commands)
    for i in range(2000):
        drone.receive(velocity_setpoint(0.5, 0.0, 1e-4 * (i % 2)))
    assert len(drone.commands) - before < 500
    drone.receive(velocity_setpoint(0.25, 0.0, 0.0))
    drone.step()
    assert drone.commands[-1].velocity_m_s == (0.0, 0.25, 0.0)


def test_a_velocity_in_the_body_frame_is_sent_in_the_heading_frame() -> None:
    drone = flying("ardupilot")
    drone.receive(velocity_setpoint(0.5, 0.25, -0.1, MavFrame.BODY_NED))
    last = drone.commands[-1]
    assert isinstance(last, Velocity)
    assert (last.frame, last.velocity_m_s) == ("heading", (0.5, -0.25, 0.1))


def test_a_position_setpoint_is_reached_and_held() -> None:
    drone = flying("ardupilot")
    drone.receive(dialect.SetPositionTargetLocalNed(0, 1, 1, MavFrame.LOCAL_NED, POSITION_ONLY, x=4.0, y=-2.0, z=-5.0))
    drone.step(600)
    assert drone.position == pytest.approx([-2.0, 4.0, 5.0], abs=0.1)


def test_an_upward_setpoint_makes_an_armed_vehicle_take_off() -> None:
    drone = FlownDrone()
    drone.command(Cmd.COMPONENT_ARM_DISARM, 1)
    up = dialect.SetPositionTargetLocalNed(0, 1, 1, MavFrame.LOCAL_NED, POSITION_ONLY, z=-2.0)
    drone.receive(up)
    set_mode(drone, PX4_MODES[FlightMode.OFFBOARD])
    for _ in range(300):
        drone.receive(up)
        drone.step()
    assert abs(drone.position[2] - 2.0) < 0.2


@pytest.mark.parametrize("frames", [[MavFrame.MISSION], [MavFrame.LOCAL_ENU], range(100, 140)])
def test_an_unsupported_frame_is_refused_once(frames: Sequence[int]) -> None:
    drone = flying("ardupilot")
    before = len(drone.commands)
    for frame in (*frames, *frames):
        drone.receive(velocity_setpoint(1.0, 0.0, 0.0, frame))
    assert len(drone.commands) == before
    assert [
        text for text in drone.texts() if "Denied" in text and f" frame {int(frames[0])} " in text
    ] == drone.texts()[-1:]


@AUTOPILOTS
def test_a_return_flies_home_and_lands(autopilot: str) -> None:
    drone = flying(autopilot)
    drone.position[0] = 20.0
    assert drone.command(Cmd.NAV_RETURN_TO_LAUNCH) == Result.ACCEPTED
    drone.until(lambda: drone.position[2] > 9.0)
    drone.until(lambda: drone.state == "landed", gates=3000)
    assert abs(drone.position[0]) < 1.0


def upload(drone: FlownDrone, items: Sequence[dialect.MissionItemInt | dialect.MissionItem], type_: int = 0) -> int:
    drone.receive(dialect.MissionCount(1, 1, len(items), mission_type=type_))
    for item in items:
        drone.receive(item)
    return drone.all(dialect.MissionAck)[-1].type


def item(seq: int, command: int, north_m: float = 0.0, up_m: float = 0.0, *params: float, type_: int = 0):
    fields: dict[str, Any] = {f"param{i + 1}": value for i, value in enumerate(params)}
    lat = round(1e7 * (47.4 + north_m / 111_170.0))
    frame = MavFrame.GLOBAL_RELATIVE_ALT_INT
    return dialect.MissionItemInt(
        1, 1, seq, frame, command, autocontinue=1, x=lat, y=round(8.5e7), z=up_m, mission_type=type_, **fields
    )


def test_a_mission_takes_off_visits_its_waypoints_and_lands() -> None:
    drone = FlownDrone()
    items = [
        item(0, Cmd.NAV_TAKEOFF, 0, 3),
        item(1, Cmd.NAV_WAYPOINT, 5, 4, 0, 0, 0, NAN),
        item(2, Cmd.DO_CHANGE_SPEED, 0, 0, 1, 1.0),
        item(3, Cmd.NAV_WAYPOINT, 8, 4, 1.0, 0, 0, NAN),
        dialect.MissionItemInt(1, 1, 4, MavFrame.GLOBAL_RELATIVE_ALT_INT, Cmd.NAV_LAND),
    ]
    assert upload(drone, items) == 0
    assert [request.seq for request in drone.all(dialect.MissionRequestInt)] == [0, 1, 2, 3, 4]
    drone.command(Cmd.COMPONENT_ARM_DISARM, 1)
    assert drone.command(Cmd.MISSION_START, 0, 0) == Result.ACCEPTED
    drone.until(lambda: drone.state == "landed" and drone.position[1] > 5.0)
    assert [reached.seq for reached in drone.all(dialect.MissionItemReached)] == [1, 3]
    assert abs(drone.position[1] - 8.0) < 1.2
    drone.step()
    progress = [(each.state, each.done) for each in drone.vehicle.flight.mission.reports]
    assert (progress[0], progress[-1]) == (("active", 0), ("finished", 5))
    assert {each.items for each in drone.vehicle.flight.mission.reports} == {5}


def test_a_mission_flies_straight_legs_at_its_speed_and_turns_smoothly() -> None:
    """The drone follows at once, so its velocity is the commanded one."""
    drone = FlownDrone()
    items = [
        item(0, Cmd.NAV_TAKEOFF, 0, 3),
        item(1, Cmd.DO_CHANGE_SPEED, 0, 0, 1, 2.0),
        item(2, Cmd.NAV_WAYPOINT, 40, 8, 0, 0, 0, NAN),
    ]
    assert upload(drone, items) == 0
    drone.command(Cmd.COMPONENT_ARM_DISARM, 1)
    assert drone.command(Cmd.MISSION_START, 0, 0) == Result.ACCEPTED
    drone.until(lambda: drone.vehicle.flight.mission.current == 2)
    flown = [drone._velocity]
    for _ in range(600):
        drone.step()
        flown.append(drone._velocity)
        low_m = 0.35 if drone.position[1] < 4.0 else 0.1  # the climb may end 0.3 m off its altitude
        assert drone.position[2] == pytest.approx(3.0 + drone.position[1] / 40.0 * (8.0 - 3.0), abs=low_m)
        assert abs(drone.position[0]) < 0.1
    assert flown[300][1] == pytest.approx(2.0, abs=0.03)
    assert drone.command(Cmd.DO_REPOSITION, -1, 0, 0, NAN, 47.4, 8.5, 405.0) == Result.ACCEPTED
    for _ in range(1000):
        drone.step()
        flown.append(drone._velocity)
    steps = [math.dist(one[:2], other[:2]) for one, other in itertools.pairwise(flown)]
    accel_m_s2 = SHARE * 9.80665 * math.tan(math.radians(20.0))
    lead_s, period_s = Piloted().lead_s, 0.04  # of the control law, which anticipates by its lead
    assert max(steps[25:]) < accel_m_s2 * (lead_s + period_s)
    assert drone.position[:2] == pytest.approx([0.0, 0.0], abs=0.6)
    assert drone.position[2] == pytest.approx(5.0, abs=0.1)


def on_mission(*last: dialect.MissionItemInt) -> FlownDrone:
    """Return a vehicle on its way to the second waypoint, 30 m away, which the given items follow."""
    drone = FlownDrone()
    way = [item(0, Cmd.NAV_TAKEOFF, 0, 3), item(1, Cmd.NAV_WAYPOINT, 2, 4), item(2, Cmd.NAV_WAYPOINT, 30, 4)]
    assert upload(drone, [*way, *last]) == 0
    drone.command(Cmd.COMPONENT_ARM_DISARM, 1)
    assert drone.command(Cmd.MISSION_START, 0, 0) == Result.ACCEPTED
    drone.until(lambda: bool(drone.all(dialect.MissionItemReached)))
    drone.step(50)
    return drone


def leave_fence(drone: FlownDrone) -> None:
    drone.receive(dialect.ParamSet(1, 1, "GF_MAX_HOR_DIST", 5.0, 9))
    drone.step(500)


def land_by_itself(drone: FlownDrone) -> None:
    drone.state = "landing"
    drone.until(lambda: drone.state == "landed")
    drone.step()


def stop_rotors(drone: FlownDrone) -> None:
    drone.state = "emergency"
    drone.step()


def choose_hold(drone: FlownDrone) -> None:
    set_mode(drone, PX4_MODES[FlightMode.HOLD])
    drone.step()


@pytest.mark.parametrize(
    ("abort", "reason", "failsafe"),
    [
        (leave_fence, "geofence", True),
        (land_by_itself, "landed by itself", True),
        (stop_rotors, "rotors", True),
        (choose_hold, "HOLD", False),
    ],
)
def test_an_aborted_mission_is_reported_with_its_progress_and_the_reason(
    abort: Callable[[FlownDrone], None], reason: str, failsafe: bool
) -> None:
    drone = on_mission()
    abort(drone)
    last = drone.vehicle.flight.mission.reports[-1]
    assert (last.state, last.items, last.done, last.failsafe) == ("aborted", 3, 2, failsafe)
    assert reason in last.reason


def test_a_resumed_mission_is_finished_once_its_return_has_landed() -> None:
    drone = on_mission(item(3, Cmd.NAV_RETURN_TO_LAUNCH))
    choose_hold(drone)
    assert set_mode(drone, PX4_MODES[FlightMode.MISSION]) == Result.ACCEPTED
    drone.until(lambda: drone.state == "landed", 20_000)
    drone.step()
    reports = drone.vehicle.flight.mission.reports
    assert [each.state for each in reports if each.state != "active"] == ["aborted", "finished"]
    assert (reports[-1].state, reports[-1].done) == ("finished", 4)


def test_a_mission_is_downloaded_as_it_was_uploaded() -> None:
    drone = FlownDrone()
    items = [item(0, Cmd.NAV_WAYPOINT, 5, 4), item(1, Cmd.NAV_RETURN_TO_LAUNCH)]
    upload(drone, items)
    drone.receive(dialect.MissionRequestList(1, 1))
    assert drone.all(dialect.MissionCount)[-1].count == 2
    drone.receive(dialect.MissionRequestInt(1, 1, 0))
    got = drone.all(dialect.MissionItemInt)[-1]
    assert (got.seq, got.command, got.x, got.y, got.z) == (0, Cmd.NAV_WAYPOINT, items[0].x, items[0].y, 4.0)
    drone.receive(dialect.MissionRequestInt(1, 1, 7))
    assert drone.all(dialect.MissionAck)[-1].type == 13
    drone.receive(dialect.MissionClearAll(1, 1))
    drone.receive(dialect.MissionRequestList(1, 1))
    assert drone.all(dialect.MissionCount)[-1].count == 0


NO_INT = 2**31 - 1  # INT32_MAX


@AUTOPILOTS
def test_int32_max_in_an_integer_item_is_nan_in_a_float_item(autopilot: str) -> None:
    """A waypoint without a position is above the vehicle (https://mavlink.io/en/services/mission.html)."""
    drone = flying(autopilot)
    drone.position[:2] = [7.0, -4.0]
    frame = MavFrame.GLOBAL_RELATIVE_ALT_INT
    climb = dialect.MissionItemInt(1, 1, 1, frame, Cmd.NAV_WAYPOINT, 0, 1, 0, 0, 0, NAN, NO_INT, NO_INT, 6.0)
    first = [item(0, Cmd.NAV_TAKEOFF, 0, 3)]
    assert upload(drone, [*first, climb]) == 0
    drone.receive(dialect.MissionRequestInt(1, 1, 1))
    drone.receive(dialect.MissionRequest(1, 1, 1))
    as_int, as_float = drone.all(dialect.MissionItemInt)[-1], drone.all(dialect.MissionItem)[-1]
    assert (as_int.x, as_int.y) == (NO_INT, NO_INT)
    assert math.isnan(as_float.x)
    assert math.isnan(as_float.y)
    assert upload(drone, [*first, as_float]) == 0
    drone.receive(dialect.MissionRequestInt(1, 1, 1))
    assert (drone.all(dialect.MissionItemInt)[-1].x, drone.all(dialect.MissionItemInt)[-1].y) == (NO_INT, NO_INT)
    assert drone.command(Cmd.MISSION_START, 1) == Result.ACCEPTED
    drone.until(lambda: drone.position[2] > 4.8)  # within the acceptance radius
    assert drone.position[:2] == pytest.approx([7.0, -4.0], abs=0.5)


@AUTOPILOTS
@pytest.mark.parametrize(
    ("frame", "place"), [(MavFrame.LOCAL_NED, (0.0, 0.0)), (MavFrame.GLOBAL_RELATIVE_ALT_INT, (7.0, -4.0))]
)
def test_a_landing_at_zero_is_at_a_local_frame_s_origin_but_nowhere_on_earth(
    autopilot: str, frame: int, place: tuple[float, float]
) -> None:
    drone = flying(autopilot)
    drone.position[:2] = [7.0, -4.0]
    land = dialect.MissionItemInt(1, 1, 1, frame, Cmd.NAV_LAND)
    assert upload(drone, [item(0, Cmd.NAV_TAKEOFF, 0, 3), land]) == 0
    assert drone.command(Cmd.MISSION_START, 1) == Result.ACCEPTED
    drone.until(lambda: drone.state == "landed", 20_000)
    assert drone.position[:2] == pytest.approx(place, abs=1.2)


@AUTOPILOTS
@pytest.mark.parametrize(
    ("frame", "x", "y", "place"),
    [
        (MavFrame.GLOBAL_RELATIVE_ALT_INT, NO_INT, NO_INT, (7.0, -4.0)),
        (MavFrame.GLOBAL_RELATIVE_ALT_INT, round(47.4e7), NO_INT, (7.0, 0.0)),
        (MavFrame.GLOBAL_RELATIVE_ALT_INT, NO_INT, round(8.5e7), (0.0, -4.0)),
        (MavFrame.LOCAL_NED, NO_INT, NO_INT, (7.0, -4.0)),
        (MavFrame.LOCAL_NED, NO_INT, 20_000, (2.0, -4.0)),
    ],
)
def test_int32_max_in_a_command_keeps_that_coordinate(
    autopilot: str, frame: int, x: int, y: int, place: tuple[float, float]
) -> None:
    drone = flying(autopilot)
    drone.position[:2] = [7.0, -4.0]
    drone.step()
    up = -5.0 if frame == MavFrame.LOCAL_NED else 5.0
    drone.receive(dialect.CommandInt(1, 1, frame, Cmd.DO_REPOSITION, param1=-1.0, param4=NAN, x=x, y=y, z=up))
    assert drone.all(dialect.CommandAck)[-1].result == Result.ACCEPTED
    drone.step(700)
    assert drone.position == pytest.approx([*place, 5.0], abs=0.6)


@AUTOPILOTS
def test_a_command_without_an_altitude_in_a_local_frame_keeps_the_altitude(autopilot: str) -> None:
    drone = flying(autopilot)
    drone.receive(
        dialect.CommandInt(1, 1, MavFrame.LOCAL_NED, Cmd.DO_REPOSITION, param1=-1.0, param4=NAN, x=0, y=30_000, z=NAN)
    )
    drone.step(500)
    assert drone.position == pytest.approx([3.0, 0.0, 3.0], abs=0.6)


@AUTOPILOTS
@pytest.mark.parametrize("whole", [{"x": NO_INT}, {"y": NO_INT}, {"x": NO_INT, "y": NO_INT}])
def test_a_fence_needs_both_coordinates(autopilot: str, whole: dict[str, int]) -> None:
    circle = item(0, Cmd.FENCE_CIRCLE_INCLUSION, 0, 0, 2.0, type_=FENCE)
    assert upload(FlownDrone(autopilot), [msgspec.structs.replace(circle, **whole)], FENCE) == MissionResult.INVALID


@AUTOPILOTS
@pytest.mark.parametrize(
    ("lat", "lon", "alt", "place"),
    [
        (NO_INT, NO_INT, 5.0, (7.0, -4.0, 5.0)),
        (round(47.4e7), NO_INT, 5.0, (7.0, 0.0, 5.0)),
        (NO_INT, round(8.5e7), NAN, (0.0, -4.0, 3.0)),
    ],
)
def test_int32_max_in_a_setpoint_leaves_that_axis_unset(
    autopilot: str, lat: int, lon: int, alt: float, place: tuple[float, float, float]
) -> None:
    drone = flying(autopilot)
    drone.position[:2] = [7.0, -4.0]
    drone.step()
    frame = MavFrame.GLOBAL_RELATIVE_ALT_INT
    to = dialect.SetPositionTargetGlobalInt(0, 1, 1, frame, POSITION_ONLY, lat, lon, alt)
    drone.receive(to)
    set_mode(drone, (PX4_MODES if autopilot == "px4" else COPTER_MODES)[FlightMode.OFFBOARD])
    for _ in range(700):
        drone.receive(to)
        drone.step()
    assert drone.position == pytest.approx(place, abs=0.6)
    assert not any(text.startswith("Denied") for text in drone.texts())


def test_an_unsupported_item_ends_the_upload() -> None:
    drone = FlownDrone()
    assert upload(drone, [item(0, 206)]) == 3  # DO_SET_CAM_TRIGG_DIST: unsupported
    assert set_mode(drone, PX4_MODES[FlightMode.MISSION]) == Result.DENIED


def test_a_missing_item_is_requested_again_until_the_upload_is_given_up() -> None:
    drone = FlownDrone()
    drone.receive(dialect.MissionCount(1, 1, 2))
    for i in range(1, 13):
        drone.vehicle.tick(drone.t_ns + i * 600_000_000)
    drone.sent += drone.vehicle.take()
    asked = len(drone.all(dialect.MissionRequestInt)) + len(drone.all(dialect.MissionRequest))
    assert asked == 11
    assert drone.all(dialect.MissionAck)[-1].type == 15


def test_a_guided_waypoint_of_older_clients_is_flown() -> None:
    drone = flying("ardupilot")
    place = {"x": 47.4 + 5 / 111_170.0, "y": 8.5, "z": 3.0}
    drone.receive(dialect.MissionItem(1, 1, 0, MavFrame.GLOBAL_RELATIVE_ALT, Cmd.NAV_WAYPOINT, current=2, **place))
    assert drone.all(dialect.MissionAck)[-1].type == 0
    drone.step(500)
    assert abs(drone.position[1] - 5.0) < 0.6  # 32-bit floats resolve this longitude to 0.4 m


def test_a_vehicle_beyond_a_geofence_holds_and_reports_it() -> None:
    drone = flying()
    drone.receive(dialect.ParamSet(1, 1, "GF_MAX_HOR_DIST", 5.0, 9))
    drone.receive(velocity_setpoint(1.0, 0.0, 0.0))
    set_mode(drone, PX4_MODES[FlightMode.OFFBOARD])
    for _ in range(400):
        drone.receive(velocity_setpoint(1.0, 0.0, 0.0))
        drone.step()
    assert drone.texts().count("Geofence breached: hold") == 1
    assert abs(drone.position[1] - 5.0) < 0.5
    drone.receive(dialect.ParamSet(1, 1, "GF_MAX_HOR_DIST", 0.0, 9))
    drone.step(2)
    assert upload(drone, [item(0, Cmd.FENCE_CIRCLE_INCLUSION, 0, 0, 2.0, type_=FENCE)], FENCE) == 0
    drone.step(2)
    assert drone.texts().count("Geofence breached: hold") == 2


def test_parameters_are_listed_read_and_set_within_their_ranges() -> None:
    drone = FlownDrone("ardupilot")
    drone.receive(dialect.ParamRequestList(1, 1))
    listed = drone.all(dialect.ParamValue)
    assert [value.param_index for value in listed] == list(range(listed[0].param_count))
    assert {"SYSID_THISMAV", "WPNAV_SPEED", "FENCE_ENABLE"} <= {value.param_id for value in listed}
    for asked, kept in ((300.0, 300.0), (1e9, 500.0), (-1.0, 10.0), (NAN, 10.0)):
        drone.receive(dialect.ParamSet(1, 1, "WPNAV_SPEED", asked, 9))
        assert drone.all(dialect.ParamValue)[-1].param_value == kept
    drone.receive(dialect.ParamSet(1, 1, "SYSID_THISMAV", 9.0, 4))
    assert drone.all(dialect.ParamValue)[-1].param_value == 1.0
    drone.receive(dialect.ParamRequestRead(1, 1, "NO_SUCH", -1))
    assert drone.all(dialect.ParamError)[-1].param_id == "NO_SUCH"


def test_integer_parameters_of_px4_are_sent_bytewise() -> None:
    drone = FlownDrone()
    drone.receive(dialect.ParamRequestRead(1, 1, "SYS_AUTOSTART", -1))
    value = drone.all(dialect.ParamValue)[-1]
    assert struct.unpack("<i", struct.pack("<f", value.param_value)) == (4001,)


def test_every_command_is_acknowledged_unknown_ones_as_unsupported() -> None:
    drone = FlownDrone()
    for command in range(0, 3000, 7):
        drone.command(command, 0.0)
    acks = drone.all(dialect.CommandAck)
    assert [ack.command for ack in acks] == list(range(0, 3000, 7))
    assert drone.command(2000) == Result.UNSUPPORTED


def test_a_vehicle_flown_by_another_process_denies_commands() -> None:
    drone = flying()
    drone.commander = "controller.main"
    drone.step(2)
    before = len(drone.commands)
    assert drone.command(Cmd.NAV_LAND) == Result.DENIED
    assert drone.texts()[-1] == "Denied: flown by controller.main"
    assert heartbeat(drone).custom_mode == PX4_MODES[FlightMode.MISSION]
    drone.step(100)
    assert len(drone.commands) == before


def test_a_failed_sensor_is_reported_and_prevents_arming() -> None:
    drone = FlownDrone()
    drone.step(100)
    drone.silent = {"gps"}
    drone.step(100)
    assert "GPS lost" in drone.texts()
    assert drone.all(dialect.GpsRawInt)[-1].fix_type == 1
    assert not drone.all(dialect.SysStatus)[-1].onboard_control_sensors_health & 0x20
    assert drone.command(Cmd.COMPONENT_ARM_DISARM, 1) == Result.DENIED
    assert drone.command(Cmd.COMPONENT_ARM_DISARM, 1, FORCE) == Result.ACCEPTED
    drone.silent = set()
    drone.step(2)
    assert drone.texts()[-1] == "GPS back"


def test_events_of_the_drone_and_a_low_battery_are_sent_as_status_texts() -> None:
    drone = FlownDrone()
    for kind, source, subject, data in (
        ("fault", "tester", "drone1", {"kind": "rotor_efficiency", "target": "drone1"}),
        ("fault", "tester", "drone2", {"kind": "x", "target": "drone2"}),
        ("collision", "world", "drone2", {"other": "drone1"}),
        ("refused", "mavlink.main", "drone/drone1/cmd/mode", {"reason": "it is cold"}),
    ):
        drone.vehicle.monitor.on_event(Event(0, 0, kind, source, subject, "", data))
    drone.battery_percent = 15.0
    drone.step(100)
    texts = ["Fault rotor_efficiency", "Collision with drone2", "Refused: it is cold", "Low battery: 15 %"]
    assert drone.texts() == texts
    assert drone.all(dialect.SysStatus)[-1].battery_remaining == 15


def test_messages_are_sent_at_the_requested_rates() -> None:
    drone = FlownDrone()
    assert drone.command(Cmd.SET_MESSAGE_INTERVAL, 30, 20_000) == Result.ACCEPTED
    assert drone.command(Cmd.SET_MESSAGE_INTERVAL, 32, -1) == Result.ACCEPTED
    assert drone.command(Cmd.SET_MESSAGE_INTERVAL, 9999, 0) == Result.UNSUPPORTED
    drone.step()
    drone.sent.clear()
    drone.step(50)
    assert len(drone.all(dialect.Attitude)) == 50
    assert drone.all(dialect.LocalPositionNed) == []
    assert drone.command(Cmd.GET_MESSAGE_INTERVAL, 30) == Result.ACCEPTED
    assert drone.all(dialect.MessageInterval)[-1].interval_us == 20_000


def test_telemetry_of_rotated_sensors_is_in_the_axes_of_the_body() -> None:
    mounts = "imu: {mount: {rpy_deg: [0, 0, 90]}}, mag: {mount: {rpy_deg: [180, 0, 0]}}"
    drone = FlownDrone(scenario=SCENARIO.replace("preset: paper", f"preset: paper, {mounts}"))
    t = (drone.t_ns, 0, drone.t_ns)
    drone.vehicle.state.update("imu", messages.Imu(*t, (1.0, 2.0, 9.0), (0.1, 0.2, 0.3)))
    drone.vehicle.state.update("mag", messages.Mag(*t, (10.0, 20.0, -40.0)))

    def built(kind: Any) -> Any:
        return drone.vehicle._telemetry.build(dialect.LAYOUTS[kind].id)

    imu, raw, attitude = map(built, (dialect.HighresImu, dialect.RawImu, dialect.Attitude))
    assert (imu.xacc, imu.yacc, imu.zacc) == pytest.approx((-2.0, -1.0, -9.0))  # forward, right, down
    assert (imu.xgyro, imu.ygyro, imu.zgyro) == pytest.approx((-0.2, -0.1, -0.3))
    assert (imu.xmag, imu.ymag, imu.zmag) == pytest.approx((0.1, 0.2, -0.4))
    assert (raw.xgyro, raw.ygyro, raw.zgyro) == (-200, -100, -300)
    assert (raw.xmag, raw.ymag, raw.zmag) == (100, 200, -400)
    assert (attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed) == pytest.approx((-0.2, -0.1, -0.3))


def test_messages_for_other_systems_are_ignored_timesync_and_ping_answered() -> None:
    drone = FlownDrone()
    drone.receive(dialect.CommandLong(command=400, param1=1.0, target_system=2, target_component=1))
    drone.receive(dialect.CommandLong(command=400, param1=1.0, target_system=1, target_component=154))
    assert drone.all(dialect.CommandAck) == []
    assert not drone.vehicle.flight.is_armed
    drone.receive(dialect.Timesync(tc1=0, ts1=77))
    assert drone.all(dialect.Timesync) == [dialect.Timesync(drone.t_ns, 77)]
    drone.receive(dialect.Ping(5, 6, 0, 0))
    assert drone.all(dialect.Ping) == [dialect.Ping(5, 6, 255, 190)]
