"""The emulated AR.Drone: effects of REF and PCMD, navdata, acknowledgements, configuration and refusals."""

import math
from collections.abc import Callable

import pytest
from ardrone_aircraft import HOVER, PILOT, PlayedAircraft, tilt_share
from ardrone_readers import configuration_entries

from zsim.contract import flight_messages, messages
from zsim.contract.flight_messages import DroneState
from zsim.math.frames import quaternion_from_rpy
from zsim.math.rotation import LEVEL
from zsim_bridges.ardrone import at_commands, navdata
from zsim_bridges.ardrone.navdata import FULL_TAGS, GPS_TAG, LOST_COM, MAGNETO_CALIBRATION, StateBit

BOOTSTRAP = bytes.fromhex("88776655100c804f0100000000000000ffff0800a6020000")  # captured from a real aircraft

ZEROS = (0.0, 0.0, 0.0)


@pytest.fixture
def played() -> PlayedAircraft:
    return PlayedAircraft()


class TestNavdata:
    def test_the_first_packet_equals_that_of_a_real_aircraft(self, played: PlayedAircraft):
        played.listen()
        assert played.datagrams == [BOOTSTRAP]

    def test_navdata_is_sent_only_on_a_valid_request(self, played: PlayedAircraft):
        played.gates(50)
        played.aircraft.on_navdata_request(b"\x00", PILOT)
        played.gates(50)
        assert played.datagrams == []
        assert "navdata" in played.refusals[0]

    def test_the_single_byte_of_npm_ar_drone_requests_navdata(self, played: PlayedAircraft):
        played.aircraft.on_navdata_request(b"\x01", PILOT)
        assert len(played.datagrams) == 1

    def test_demo_navdata_is_sent_15_times_per_second(self, played: PlayedAircraft):
        played.listen()
        played.config("general:navdata_demo", "TRUE")
        played.flown_gates(1)
        played.datagrams.clear()
        played.flown_gates(500)
        assert len(played.datagrams) == 150
        assert {len(datagram) for datagram in played.datagrams} == {500}

    def test_full_navdata_is_sent_200_times_per_second(self, played: PlayedAircraft):
        played.listen()
        played.config("general:navdata_demo", "FALSE")
        played.flown_gates(1)
        first = played.packet().sequence + 1
        played.datagrams.clear()
        played.flown_gates(50)
        assert len(played.datagrams) == 200
        sequences = [navdata.unpack(datagram).sequence for datagram in played.datagrams]
        assert sequences == list(range(first, first + 200))
        assert tuple(navdata.unpack(played.datagrams[-1]).options) == FULL_TAGS

    def test_gps_is_included_only_if_its_option_is_requested(self, played: PlayedAircraft):
        played.listen()
        fix = (-34.603, -58.368, 25.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)
        played.aircraft.update(messages.Gps(0, 0, 0, *fix[0], fix[1], fix[2], 2.0, 3, 9))
        played.config("general:navdata_demo", "FALSE")
        played.flown_gates(2)
        assert GPS_TAG not in played.packet().options
        played.config("general:navdata_options", str(1 << GPS_TAG))
        played.flown_gates(2)
        gps = played.packet().options[GPS_TAG]
        assert (gps.latitude_deg, gps.satellites, gps.degree) == (-34.603, 9, 90.0)

    def test_at_most_eight_receivers_are_sent_navdata(self, played: PlayedAircraft):
        played.flown_gates(1)
        for port in range(9):
            played.aircraft.on_navdata_request(b"\x01", ("127.0.0.1", port))
        played.flown_gates(1)
        played.datagrams.clear()
        played.flown_gates(10)  # three demo packets in 0.2 s
        assert len(played.datagrams) == 3 * 8

    def test_signs_and_units_are_those_of_the_sdk(self, played: PlayedAircraft):
        played.listen()
        played.config("general:navdata_demo", "FALSE")
        played.aircraft.update(messages.Sonar(0, 0, 0, 1.5, True))
        played.aircraft.update(messages.Flow(0, 0, 0, (1.0, 0.5, 0.25), 1.0))
        played.aircraft.update(flight_messages.Truth(0, 0, ZEROS, ZEROS, LEVEL, ZEROS, ZEROS, (503.0,) * 4))
        w, x, y, z = quaternion_from_rpy((-0.1, 0.2, 0.3)).tolist()  # left side down, nose down, turned left
        estimate = flight_messages.Estimate(0, 0, ZEROS, ZEROS, (w, x, y, z), 0.3, (0.0,) * 36, 0.0, ZEROS, {})
        played.flown_gates(1)
        played.aircraft.update(estimate)
        played.flown_gates(1)
        packet = played.packet()
        demo, physical = packet.options[0], packet.options[3]
        angles = [math.degrees(1e3 * angle) for angle in (-0.2, -0.1, -0.3)]
        assert (demo.theta_mdeg, demo.phi_mdeg, demo.psi_mdeg) == pytest.approx(angles, rel=1e-4)
        assert (demo.vx_mm_s, demo.vy_mm_s, demo.vz_mm_s) == (1000.0, -500.0, -250.0)
        assert demo.altitude_mm == 1500
        assert demo.battery_percent == 90
        assert physical.phys_accs_mg == pytest.approx((0.0, 0.0, -1000.0), abs=1e-3)
        assert packet.options[9].motor == (255,) * 4
        assert packet.options[2].raw_accs == (2048, 2048, 2560)

    @pytest.mark.parametrize(
        ("state", "major"),
        [("landed", 2), ("taking_off", 6), ("hovering", 4), ("flying", 3), ("landing", 8), ("emergency", 0)],
    )
    def test_the_state_of_the_drone_is_reported(self, played: PlayedAircraft, state, major: int):
        played.listen()
        played.config("general:navdata_demo", "TRUE")
        played.flown_gates(4, state)
        assert played.packet().options[0].ctrl_state >> 16 == major
        assert (StateBit.FLYING in played.packet().state) == (state not in ("landed", "emergency"))

    def test_a_low_battery_sets_its_state_bit(self, played: PlayedAircraft):
        played.listen()
        played.battery_percent = 9.0
        played.flown_gates(4)
        assert StateBit.BATTERY_LOW in played.packet().state

    def test_a_sonar_without_echo_sets_its_state_bit(self, played: PlayedAircraft):
        played.listen()
        played.aircraft.update(messages.Sonar(0, 0, 0, 6.0, False))
        played.flown_gates(4)
        assert StateBit.ULTRASOUND_DEAF in played.packet().state

    def test_a_value_that_overflows_its_field_is_reported(self, played: PlayedAircraft):
        played.listen()
        played.config("general:navdata_demo", "TRUE")
        played.aircraft.update(messages.Flow(0, 0, 0, (1e300, 0.0, 0.0), 1.0))
        played.flown_gates(4)
        assert "field" in played.refusals[-1]
        assert len(played.datagrams) > 1


class TestSequence:
    def test_old_commands_are_refused_until_the_sequence_restarts(self, played: PlayedAircraft):
        played.gates()
        played.aircraft.on_at(b"AT*COMWDG=100\r")
        played.aircraft.on_at(b"AT*REF=99,512\r")
        assert played.sent == []
        assert "last" in played.refusals[0]
        played.aircraft.on_at(b"AT*REF=1,512\r")
        assert played.modes() == ["takeoff"]

    def test_a_sequence_of_npm_ar_drone_restarts_at_0(self, played: PlayedAircraft):
        played.gates()
        played.aircraft.on_at(b"AT*COMWDG=100\r")
        played.aircraft.on_at(b"AT*REF=0,512\r")
        assert played.modes() == ["takeoff"]


class TestConfiguration:
    def test_every_config_is_acknowledged_and_the_acknowledgement_cleared(self, played: PlayedAircraft):
        played.listen()
        for key, value in (("general:navdata_demo", "TRUE"), ("general:navdata_demo", "TRUE"), ("none:such", "1")):
            played.config(key, value)
            played.flown_gates(4)
            assert StateBit.COMMAND_ACK in played.packet().state
            played.at(at_commands.Control(0, at_commands.ACKNOWLEDGE))
            played.flown_gates(4)
            assert StateBit.COMMAND_ACK not in played.packet().state

    def test_the_configuration_is_sent_to_the_control_port(self, played: PlayedAircraft):
        played.config("video:video_channel", "1")
        played.at(at_commands.Control(0, at_commands.SEND_CONFIGURATION))
        entries = configuration_entries(played.control[0])
        assert entries["video:video_channel"] == "1"
        assert entries["control:altitude_max"] == "3000"
        assert entries["custom:session_id"] == "00000000"

    def test_identifiers_must_be_those_in_force(self, played: PlayedAircraft):
        ids = at_commands.ConfigIds(0, "aaaaaaaa", "bbbbbbbb", "cccccccc")
        played.at(ids, at_commands.Config(0, "video:codec_fps", "20"))
        assert "identifiers" in played.refusals[-1]
        for level, identifier in (("session", "aaaaaaaa"), ("profile", "bbbbbbbb"), ("application", "cccccccc")):
            played.at(ids, at_commands.Config(0, f"custom:{level}_id", identifier))
        played.at(ids, at_commands.Config(0, "video:codec_fps", "20"))
        assert played.aircraft.configuration.text("video:codec_fps") == "20"
        assert len(played.refusals) == 1

    def test_the_camera_follows_the_video_channel(self, played: PlayedAircraft):
        assert played.aircraft.camera == "front"
        for channel, camera in (("1", "bottom"), ("2", "front"), ("3", "bottom"), ("4", "front"), ("4", "bottom")):
            played.config("video:video_channel", channel)
            assert played.aircraft.camera == camera


class TestRefusals:
    @pytest.mark.parametrize(
        ("command", "reason"),
        [
            (at_commands.Animation(0, 16, 15), "ANIM is not obeyed: "),
            (at_commands.Config(0, "control:flight_anim", "16,15"), "flight_anim is not obeyed: "),
            (at_commands.Config(0, "general:flying_time", "1"), "general:flying_time"),
            (at_commands.Config(0, "general:navdata_demo", "maybe"), "must be TRUE or FALSE"),
            (at_commands.Config(0, "control:altitude_max", "high"), "must be a number"),
        ],
    )
    def test_commands_that_are_not_obeyed_are_refused_with_a_reason(self, played: PlayedAircraft, command, reason: str):
        played.gates()
        played.at(command)
        assert reason in played.refusals[0]
        assert played.refusals[0].startswith("drone1: ")

    def test_flat_trim_is_refused_in_flight(self, played: PlayedAircraft):
        played.gates()
        played.at(at_commands.FlatTrim(0))
        assert played.refusals == []
        played.airborne().at(at_commands.FlatTrim(0))
        assert "must be landed" in played.refusals[-1]

    def test_commands_without_effect_are_silently_accepted(self, played: PlayedAircraft):
        played.gates()
        played.at(at_commands.Led(0, 3, 2.0, 5), at_commands.Config(0, "leds:leds_anim", "3,1073741824,2"))
        played.aircraft.on_at(b"AT*PMODE=50,2\rAT*MISC=51,2,20,2000,3000\r")
        assert played.refusals == []
        assert played.sent == []

    def test_malformed_commands_are_counted(self, played: PlayedAircraft):
        played.aircraft.on_at(b"hello\rworld")
        assert len(played.refusals) == 2


def test_the_number_of_distinct_refusal_texts_is_limited(played: PlayedAircraft):
    for k in range(1000):
        played.aircraft.on_at(b"AT*NAME%d=1\r" % k)
    assert len(played.refusals) == 1000
    assert len(set(played.refusals)) == 21


INDOOR_DEG = math.degrees(0.20944)
Step = Callable[[PlayedAircraft], None]


@pytest.fixture
def airborne(played: PlayedAircraft) -> PlayedAircraft:
    return played.airborne()


def ref(takes_off: bool, emergency: bool = False) -> Step:
    return lambda played: played.ref(takes_off, emergency)


def gates(count: int, state: DroneState | None = None) -> Step:
    return lambda played: played.gates(count, state)


def flown(count: int, state: DroneState | None = None) -> Step:
    """Let gates pass while the pilot's program stays in contact."""
    return lambda played: played.flown_gates(count, state)


TAKE_OFF, LAND, STOP = ref(takes_off=True), ref(takes_off=False), ref(takes_off=False, emergency=True)
TAKE_OFF_AND_STOP = ref(takes_off=True, emergency=True)
HELD = [
    step
    for state in ("landed", "taking_off", "hovering", "landing", "landed", "landed")
    for step in (TAKE_OFF, gates(1, state))
]
MODES: dict[str, tuple[list[Step], list[str]]] = {
    "a single REF takes off once": ([TAKE_OFF, flown(40, "taking_off")], ["takeoff"]),
    "one that is held does not take off again after a landing": (HELD, ["takeoff"]),
    "a take-off that is lost is asked for again, then given up": ([TAKE_OFF, flown(200, "landed")], ["takeoff"] * 3),
    "a take-off is withdrawn; the first is on its way": ([TAKE_OFF, LAND, flown(100, "landed")], ["takeoff", "land"]),
    "bits alone count": ([lambda played: played.at(at_commands.Ref(0, 512))], ["takeoff"]),
    "a reset is asked for again while it is not done": ([gates(1, "emergency"), STOP, flown(30)], ["reset", "reset"]),
    "and no more once it is": ([gates(1, "emergency"), STOP, flown(30, "landed")], ["reset"]),
}
MODES_IN_THE_AIR: dict[str, tuple[list[Step], list[str]]] = {
    "a single REF lands": ([LAND, LAND, flown(30, "landing")], ["land"]),
    "a take-off while it lands waits for the ground": (
        [LAND, flown(2, "landing"), TAKE_OFF, flown(2, "landing")],
        ["land"],
    ),
    "and comes there": ([LAND, flown(2, "landing"), TAKE_OFF, flown(2), gates(1, "landed")], ["land", "takeoff"]),
    "the emergency is toggled by the rise of its bit": ([TAKE_OFF_AND_STOP] * 5, ["emergency"]),
    "and the reset": (
        [TAKE_OFF_AND_STOP, gates(1, "emergency"), TAKE_OFF_AND_STOP, LAND, STOP],
        ["emergency", "reset"],
    ),
    "a landing does not come before the emergency": ([STOP, LAND], ["emergency"]),
    "the take-off bit that was held does not take off after a reset": (
        [gates(1, "emergency"), TAKE_OFF_AND_STOP, gates(1, "landed"), TAKE_OFF, flown(5, "landed")],
        ["reset"],
    ),
}


@pytest.mark.parametrize("name", [*MODES, *MODES_IN_THE_AIR])
def test_ref_commands_the_expected_modes(name: str):
    played = PlayedAircraft()
    if name in MODES:
        played.gates()
    else:
        played.airborne()
    steps, modes = MODES.get(name) or MODES_IN_THE_AIR[name]
    for step in steps:
        step(played)
    assert played.modes() == modes


def test_commands_before_the_first_status_are_refused(played: PlayedAircraft):
    played.ref(takes_off=True)
    assert played.sent == []
    assert "no status yet" in played.refusals[0]


class TestEmergency:
    def test_an_emergency_by_the_pilot_sets_the_user_bit(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.ref(takes_off=False, emergency=True)
        airborne.gates(1, "hovering")  # the command has not arrived yet
        airborne.gates(5, "emergency")
        assert StateBit.EMERGENCY | StateBit.USER_EMERGENCY in airborne.packet().state
        assert StateBit.CUTOUT not in airborne.packet().state

    def test_an_emergency_by_another_cause_sets_the_cutout_bit(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.gates(5, "emergency")
        assert StateBit.EMERGENCY | StateBit.CUTOUT in airborne.packet().state
        assert StateBit.USER_EMERGENCY not in airborne.packet().state


class TestPcmd:
    def test_shares_scale_the_configured_limits(self, airborne: PlayedAircraft):
        airborne.pcmd(roll=0.5, pitch=-1.0, gaz=0.5, yaw=-1.0)
        forward, left, up, yaw_left, hover = airborne.tilts()[0]
        assert (forward, left) == pytest.approx((tilt_share(INDOOR_DEG), -tilt_share(INDOOR_DEG / 2)))
        assert (up, yaw_left) == pytest.approx((0.35, 1.7453 / math.radians(200)))  # 0.35 = 0.5 · 0.7 m/s / 1 m/s
        assert not hover

    def test_outdoor_limits_apply_when_configured(self, airborne: PlayedAircraft):
        airborne.config("control:outdoor", "TRUE")
        airborne.pcmd(pitch=-1.0, gaz=1.0, yaw=1.0)
        forward, _, up, yaw_left, _ = airborne.tilts()[0]
        assert (forward, up, yaw_left) == pytest.approx((1.0, 1.0, -1.0), abs=1e-4)

    def test_configured_limits_are_clamped_to_those_of_the_drone(self):
        airborne = PlayedAircraft(", limits: {tilt_deg: 5}").airborne()
        airborne.config("control:euler_angle_max", "0.5")
        airborne.pcmd(pitch=-0.5)
        assert airborne.tilts()[0][0] == pytest.approx(tilt_share(2.5, 5.0), abs=1e-4)

    def test_arguments_are_clamped_to_one(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-70.0)
        assert airborne.tilts()[0][0] == pytest.approx(tilt_share(INDOOR_DEG))

    def test_flag_0_hovers_but_zero_arguments_do_not(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-1.0, flag=0)
        airborne.gates()
        airborne.pcmd()
        assert airborne.tilts() == [HOVER, (0.0, 0.0, 0.0, 0.0, False)]

    def test_a_changed_command_is_sent_at_once_and_then_repeated(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-1.0)
        assert len(airborne.tilts()) == 1
        airborne.pcmd(pitch=-1.0)
        assert airborne.tilts() == []
        airborne.flown_gates(50, "flying")
        assert len(airborne.tilts()) == 10  # every 0.1 s

    def test_a_command_holds_while_the_pilot_stays_in_contact(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-1.0)
        airborne.flown_gates(500, "flying")
        assert len(airborne.tilts()) == 101

    def test_only_the_last_excess_command_is_sent_at_the_next_gate(self, airborne: PlayedAircraft):
        for k in range(10):
            airborne.pcmd(pitch=-0.1 * k)
        assert len(airborne.tilts()) == 3
        airborne.gates()
        assert airborne.tilts()[0][0] == pytest.approx(tilt_share(0.9 * INDOOR_DEG))

    def test_a_command_during_take_off_is_flown_afterwards(self, played: PlayedAircraft):
        played.gates()
        played.ref(takes_off=True)
        played.gates(1, "taking_off")
        played.pcmd(gaz=0.5)
        assert played.tilts() == []
        played.gates(1, "hovering")
        assert len(played.tilts()) == 1

    def test_commands_on_the_ground_are_ignored(self, played: PlayedAircraft):
        played.gates()
        played.pcmd(pitch=-1.0)
        played.flown_gates(20, "landed")
        assert played.sent == []

    def test_commands_end_with_the_landing(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-1.0)
        airborne.ref(takes_off=False)
        airborne.pcmd(pitch=-1.0)
        airborne.flown_gates(30, "landing")
        assert len(airborne.tilts()) == 1

    def test_the_drone_does_not_climb_beyond_altitude_max(self, airborne: PlayedAircraft):
        airborne.config("control:altitude_max", "2000")
        for altitude_m, up in ((1.0, 0.7), (1.8, 0.3), (2.0, 0.0), (2.4, -0.6)):
            airborne.aircraft.update(messages.Sonar(airborne.now_ns, 0, airborne.now_ns, altitude_m, True))
            airborne.pcmd(gaz=0.0)
            airborne.gates(1, "flying")
            airborne.sent.clear()
            airborne.pcmd(gaz=1.0)
            assert airborne.tilts()[-1][2] == pytest.approx(up, abs=1e-6)

    def test_absolute_control_is_in_the_pilot_s_frame(self, airborne: PlayedAircraft):
        # the magnetometer shows magnetic north to the left: the nose points east
        airborne.aircraft.update(messages.Mag(airborne.now_ns, 0, airborne.now_ns, (0.0, 20.0, -10.0)))
        airborne.gates(1, "flying")
        ahead_of_a_pilot_who_looks_north = at_commands.PcmdMag(0, 1 | 4, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0)
        airborne.at(ahead_of_a_pilot_who_looks_north)
        forward, left, *_ = airborne.tilts()[0]
        assert (forward, left) == pytest.approx((0.0, tilt_share(INDOOR_DEG)), abs=1e-6)  # north is to its left
        east = at_commands.PcmdMag(0, 1 | 4, 0.0, -1.0, 0.0, 0.0, 0.5, 0.0)
        airborne.at(east)
        forward, left, *_ = airborne.tilts()[0]
        assert (forward, left) == pytest.approx((tilt_share(INDOOR_DEG), 0.0), abs=1e-6)


class TestSilence:
    def test_brief_silence_sets_the_watchdog_bit(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.at(at_commands.ResetWatchdog(0))
        airborne.gates(3)
        assert StateBit.COM_WATCHDOG not in airborne.packet().state
        airborne.gates(4)
        assert StateBit.COM_WATCHDOG in airborne.packet().state
        assert StateBit.COM_LOST not in airborne.packet().state

    def test_the_drone_hovers_after_two_seconds(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-1.0)
        airborne.gates(101, "flying")
        assert HOVER not in airborne.tilts()
        airborne.gates(1, "flying")
        assert airborne.tilts()[-1] == HOVER

    def test_the_drone_lands_after_four_seconds(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.config("general:navdata_demo", "TRUE")
        airborne.gates(103)
        airborne.listen()  # navdata has stopped: request it again
        airborne.gates(5)
        assert StateBit.COM_LOST in airborne.packet().state
        assert airborne.packet().options[0].ctrl_state == 4 << 16 | LOST_COM
        airborne.gates(92)
        assert airborne.modes() == []
        airborne.gates(3)
        assert airborne.modes() == ["land"]

    def test_silence_ends_navdata(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.at(at_commands.ResetWatchdog(0))
        airborne.gates(103)
        count = len(airborne.datagrams)
        airborne.gates(50)
        assert len(airborne.datagrams) == count

    def test_a_restarted_program_is_obeyed(self, airborne: PlayedAircraft):
        airborne.at(at_commands.ResetWatchdog(0))
        airborne.gates(120)
        airborne.sent.clear()
        airborne._sequence = 1  # the program has restarted
        airborne.pcmd(pitch=-1.0)
        assert len(airborne.tilts()) == 1

    def test_a_drone_that_only_took_off_lands_too(self, played: PlayedAircraft):
        played.gates()
        played.ref(takes_off=True)
        played.gates(1, "landed")  # the command has not arrived yet
        played.gates(60, "taking_off")
        played.gates(145, "hovering")
        assert played.modes() == ["takeoff", "land"]

    def test_a_drone_that_was_never_flown_by_this_pilot_is_left_alone(self, played: PlayedAircraft):
        played.at(at_commands.ResetWatchdog(0))
        played.gates(300, "hovering")
        assert played.sent == []

    def test_com_watchdog_sets_the_timeout(self, airborne: PlayedAircraft):
        airborne.config("general:com_watchdog", "1")
        airborne.pcmd(pitch=-1.0)
        airborne.gates(53, "flying")
        assert airborne.tilts()[-1] == HOVER


class TestAnotherCommander:
    def test_commands_are_refused_while_another_process_flies(self, airborne: PlayedAircraft):
        airborne.commander = "controller.main"
        airborne.gates(1, "flying")
        airborne.ref(takes_off=False, emergency=True)
        airborne.pcmd(pitch=-1.0)
        airborne.at(at_commands.Calibrate(0, 0))
        airborne.gates(300, "flying")
        assert airborne.sent == []
        assert [reason.partition(": ")[2].partition(" is ")[0] for reason in airborne.refusals] == [
            "REF",
            "PCMD",
            "CALIB",
        ]
        assert all("controller.main flies the drone" in reason for reason in airborne.refusals)

    def test_the_state_word_shows_the_flight_and_no_emergency(self, airborne: PlayedAircraft):
        airborne.commander = "controller.main"
        airborne.listen()
        airborne.gates(1, "flying")
        airborne.ref(takes_off=False, emergency=True)
        airborne.gates(3, "flying")
        state = airborne.packet().state
        assert StateBit.FLYING in state
        assert not state & (StateBit.EMERGENCY | StateBit.USER_EMERGENCY)


class TestCalibration:
    def test_the_drone_turns_once_in_place(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.config("general:navdata_demo", "TRUE")
        airborne.at(at_commands.Calibrate(0, 0))
        for _ in range(400):
            airborne.pcmd(flag=0)
            airborne.gates(1, "flying")
        turns = [message for kind, message in airborne.sent if kind == "velocity"]
        assert turns[0].velocity_m_s == (0.0, 0.0, 0.0)
        assert turns[0].yaw_rate_rad_s == -1.0
        lasted_s = (turns[-1].t_ns - turns[0].t_ns) / 1e9
        assert lasted_s == pytest.approx(2 * math.pi, abs=0.2)  # the command is repeated every 0.1 s
        assert airborne.tilts()[-1] == HOVER

    def test_calibration_is_reported_in_navdata(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.config("general:navdata_demo", "TRUE")
        airborne.at(at_commands.Calibrate(0, 0))
        airborne.flown_gates(10, "flying")
        assert airborne.packet().options[0].ctrl_state == 4 << 16 | MAGNETO_CALIBRATION

    def test_steering_ends_the_calibration(self, airborne: PlayedAircraft):
        airborne.at(at_commands.Calibrate(0, 0))
        airborne.pcmd(pitch=-1.0)
        airborne.flown_gates(10, "flying")
        assert [kind for kind, _ in airborne.sent][1:] == ["ardrone"] * 3

    def test_calibration_on_the_ground_is_refused(self, played: PlayedAircraft):
        played.gates()
        played.at(at_commands.Calibrate(0, 0))
        assert "air" in played.refusals[0]
