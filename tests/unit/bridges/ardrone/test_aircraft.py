"""Navdata, acknowledgement, configuration and refusals of an aircraft."""

import math

import pytest
from ardrone_aircraft import PILOT, PlayedAircraft
from ardrone_readers import configuration_entries

from zsim.contract import flight_messages, messages
from zsim.math.frames import quaternion_from_rpy
from zsim.math.rotation import LEVEL
from zsim_bridges.ardrone import at_commands, navdata
from zsim_bridges.ardrone.navdata import FULL_TAGS, GPS_TAG, StateBit

BOOTSTRAP = bytes.fromhex("88776655100c804f0100000000000000ffff0800a6020000")  # captured from an aircraft

ZEROS = (0.0, 0.0, 0.0)


@pytest.fixture
def played() -> PlayedAircraft:
    return PlayedAircraft()


class TestNavdata:
    def test_the_first_packet_is_a_real_aircraft_s(self, played: PlayedAircraft):
        played.listen()
        assert played.datagrams == [BOOTSTRAP]

    def test_nobody_is_sent_what_nobody_asked_for(self, played: PlayedAircraft):
        played.gates(50)
        played.aircraft.on_navdata_request(b"\x00", PILOT)
        played.gates(50)
        assert played.datagrams == []
        assert "navdata" in played.refusals[0]

    def test_the_single_byte_of_npm_ar_drone_asks_too(self, played: PlayedAircraft):
        played.aircraft.on_navdata_request(b"\x01", PILOT)
        assert len(played.datagrams) == 1

    def test_demo_fifteen_times_a_second(self, played: PlayedAircraft):
        played.listen()
        played.config("general:navdata_demo", "TRUE")
        played.flown_gates(1)
        played.datagrams.clear()
        played.flown_gates(500)
        assert len(played.datagrams) == 150
        assert {len(datagram) for datagram in played.datagrams} == {500}

    def test_full_two_hundred_times_a_second(self, played: PlayedAircraft):
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

    def test_the_gps_stands_in_what_asked_for_it_alone(self, played: PlayedAircraft):
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

    def test_many_programs_are_sent_navdata_and_the_first_goes_when_there_are_too_many(self, played: PlayedAircraft):
        played.flown_gates(1)
        for port in range(9):
            played.aircraft.on_navdata_request(b"\x01", ("127.0.0.1", port))
        played.flown_gates(1)
        played.datagrams.clear()
        played.flown_gates(10)  # three demos in 0.2 s
        assert len(played.datagrams) == 3 * 8

    def test_signs_and_units_are_the_sdk_s(self, played: PlayedAircraft):
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
    def test_states(self, played: PlayedAircraft, state, major: int):
        played.listen()
        played.config("general:navdata_demo", "TRUE")
        played.flown_gates(4, state)
        assert played.packet().options[0].ctrl_state >> 16 == major
        assert (StateBit.FLYING in played.packet().state) == (state not in ("landed", "emergency"))

    def test_a_low_battery_is_shown(self, played: PlayedAircraft):
        played.listen()
        played.battery_percent = 9.0
        played.flown_gates(4)
        assert StateBit.BATTERY_LOW in played.packet().state

    def test_a_sonar_without_echo_is_shown(self, played: PlayedAircraft):
        played.listen()
        played.aircraft.update(messages.Sonar(0, 0, 0, 6.0, False))
        played.flown_gates(4)
        assert StateBit.ULTRASOUND_DEAF in played.packet().state

    def test_values_beyond_their_fields_are_counted(self, played: PlayedAircraft):
        played.listen()
        played.config("general:navdata_demo", "TRUE")
        played.aircraft.update(messages.Flow(0, 0, 0, (1e300, 0.0, 0.0), 1.0))
        played.flown_gates(4)
        assert "field" in played.refusals[-1]
        assert len(played.datagrams) > 1


class TestSequence:
    def test_old_commands_are_refused_until_the_numbers_begin_again(self, played: PlayedAircraft):
        played.gates()
        played.aircraft.on_at(b"AT*COMWDG=100\r")
        played.aircraft.on_at(b"AT*REF=99,512\r")
        assert played.sent == []
        assert "last" in played.refusals[0]
        played.aircraft.on_at(b"AT*REF=1,512\r")
        assert played.modes() == ["takeoff"]

    def test_npm_ar_drone_begins_with_0(self, played: PlayedAircraft):
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

    def test_it_is_sent_to_the_control_port(self, played: PlayedAircraft):
        played.config("video:video_channel", "1")
        played.at(at_commands.Control(0, at_commands.SEND_CONFIGURATION))
        entries = configuration_entries(played.control[0])
        assert entries["video:video_channel"] == "1"
        assert entries["control:altitude_max"] == "3000"
        assert entries["custom:session_id"] == "00000000"

    def test_identifiers_must_be_those_in_force(self, played: PlayedAircraft):
        ids = at_commands.ConfigIds(0, "aaaaaaaa", "bbbbbbbb", "cccccccc")
        played.at(ids, at_commands.Config(0, "video:codec_fps", "20"))
        assert "force" in played.refusals[-1]
        for level, identifier in (("session", "aaaaaaaa"), ("profile", "bbbbbbbb"), ("application", "cccccccc")):
            played.at(ids, at_commands.Config(0, f"custom:{level}_id", identifier))
        played.at(ids, at_commands.Config(0, "video:codec_fps", "20"))
        assert played.aircraft.configuration.text("video:codec_fps") == "20"
        assert len(played.refusals) == 1

    def test_the_camera_follows_the_channel(self, played: PlayedAircraft):
        assert played.aircraft.camera == "front"
        for channel, camera in (("1", "bottom"), ("2", "front"), ("3", "bottom"), ("4", "front"), ("4", "bottom")):
            played.config("video:video_channel", channel)
            assert played.aircraft.camera == camera


class TestRefusals:
    @pytest.mark.parametrize(
        ("command", "reason"),
        [
            (at_commands.Animation(0, 16, 15), "ANIM is not obeyed: figures are not flown here"),
            (at_commands.Config(0, "control:flight_anim", "16,15"), "flight_anim is not obeyed: figures"),
            (at_commands.Config(0, "general:flying_time", "1"), "read only"),
            (at_commands.Config(0, "general:navdata_demo", "maybe"), "must be TRUE or FALSE"),
            (at_commands.Config(0, "control:altitude_max", "high"), "must be a number"),
        ],
    )
    def test_what_is_not_done_says_why(self, played: PlayedAircraft, command, reason: str):
        played.gates()
        played.at(command)
        assert reason in played.refusals[0]
        assert played.refusals[0].startswith("drone1: ")

    def test_flat_trim_needs_the_ground(self, played: PlayedAircraft):
        played.gates()
        played.at(at_commands.FlatTrim(0))
        assert played.refusals == []
        played.airborne().at(at_commands.FlatTrim(0))
        assert "must be landed" in played.refusals[-1]

    def test_what_changes_nothing_is_let_pass(self, played: PlayedAircraft):
        played.gates()
        played.at(at_commands.Led(0, 3, 2.0, 5), at_commands.Config(0, "leds:leds_anim", "3,1073741824,2"))
        played.aircraft.on_at(b"AT*PMODE=50,2\rAT*MISC=51,2,20,2000,3000\r")
        assert played.refusals == []
        assert played.sent == []

    def test_what_is_no_command_is_counted(self, played: PlayedAircraft):
        played.aircraft.on_at(b"hello\rworld")
        assert len(played.refusals) == 2


def test_there_is_an_end_to_texts_about_what_is_no_command(played: PlayedAircraft):
    for k in range(1000):
        played.aircraft.on_at(b"AT*NAME%d=1\r" % k)
    assert len(played.refusals) == 1000
    assert len(set(played.refusals)) == 21
