"""What REF and PCMD make a drone do."""

import math
from collections.abc import Callable

import pytest
from ardrone_aircraft import HOVER, PlayedAircraft, tilt_share

from zsim.contract import messages
from zsim.contract.flight_messages import DroneState
from zsim_bridges.ardrone import at_commands
from zsim_bridges.ardrone.navdata import LOST_COM, MAGNETO_CALIBRATION, StateBit

INDOOR_DEG = math.degrees(0.20944)
Step = Callable[[PlayedAircraft], None]


@pytest.fixture
def played() -> PlayedAircraft:
    return PlayedAircraft()


@pytest.fixture
def airborne(played: PlayedAircraft) -> PlayedAircraft:
    return played.airborne()


def ref(takes_off: bool, emergency: bool = False) -> Step:
    return lambda played: played.ref(takes_off, emergency)


def gates(count: int, state: DroneState | None = None) -> Step:
    return lambda played: played.gates(count, state)


def flown(count: int, state: DroneState | None = None) -> Step:
    """Let gates pass while the pilot's program shows that it is there."""
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
def test_modes_that_are_asked_of_the_drone(name: str):
    played = PlayedAircraft()
    if name in MODES:
        played.gates()
    else:
        played.airborne()
    steps, modes = MODES.get(name) or MODES_IN_THE_AIR[name]
    for step in steps:
        step(played)
    assert played.modes() == modes


def test_nothing_is_done_before_the_drone_is_there(played: PlayedAircraft):
    played.ref(takes_off=True)
    assert played.sent == []
    assert "no status yet" in played.refusals[0]


class TestEmergency:
    def test_the_state_word_has_who_caused_it(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.ref(takes_off=False, emergency=True)
        airborne.gates(1, "hovering")  # it is on its way
        airborne.gates(5, "emergency")
        assert StateBit.EMERGENCY | StateBit.USER_EMERGENCY in airborne.packet().state
        assert StateBit.CUTOUT not in airborne.packet().state

    def test_and_not_the_pilot_where_it_was_not_the_pilot(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.gates(5, "emergency")
        assert StateBit.EMERGENCY | StateBit.CUTOUT in airborne.packet().state
        assert StateBit.USER_EMERGENCY not in airborne.packet().state


class TestPcmd:
    def test_shares_are_of_the_configuration_s_limits(self, airborne: PlayedAircraft):
        airborne.pcmd(roll=0.5, pitch=-1.0, gaz=0.5, yaw=-1.0)
        forward, left, up, yaw_left, hover = airborne.tilts()[0]
        assert (forward, left) == pytest.approx((tilt_share(INDOOR_DEG), -tilt_share(INDOOR_DEG / 2)))
        assert (up, yaw_left) == pytest.approx((0.35, 1.7453 / math.radians(200)))  # 0.5 of 0.7 of 1 m/s
        assert not hover

    def test_outdoor_limits(self, airborne: PlayedAircraft):
        airborne.config("control:outdoor", "TRUE")
        airborne.pcmd(pitch=-1.0, gaz=1.0, yaw=1.0)
        forward, _, up, yaw_left, _ = airborne.tilts()[0]
        assert (forward, up, yaw_left) == pytest.approx((1.0, 1.0, -1.0), abs=1e-4)

    def test_limits_beyond_the_drone_s_own_are_cut(self):
        airborne = PlayedAircraft(", limits: {tilt_deg: 5}").airborne()
        airborne.config("control:euler_angle_max", "0.5")
        airborne.pcmd(pitch=-0.5)
        assert airborne.tilts()[0][0] == pytest.approx(tilt_share(2.5, 5.0), abs=1e-4)

    def test_arguments_beyond_one_are_cut(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-70.0)
        assert airborne.tilts()[0][0] == pytest.approx(tilt_share(INDOOR_DEG))

    def test_flag_0_hovers_and_zeros_do_not(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-1.0, flag=0)
        airborne.gates()
        airborne.pcmd()
        assert airborne.tilts() == [HOVER, (0.0, 0.0, 0.0, 0.0, False)]

    def test_another_command_goes_out_at_once_and_is_repeated(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-1.0)
        assert len(airborne.tilts()) == 1
        airborne.pcmd(pitch=-1.0)
        assert airborne.tilts() == []
        airborne.flown_gates(50, "flying")
        assert len(airborne.tilts()) == 10  # each 0.1 s

    def test_it_holds_while_the_pilot_s_program_is_there(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-1.0)
        airborne.flown_gates(500, "flying")
        assert len(airborne.tilts()) == 101

    def test_more_than_a_gate_can_use_waits_for_the_next_and_the_last_wins(self, airborne: PlayedAircraft):
        for k in range(10):
            airborne.pcmd(pitch=-0.1 * k)
        assert len(airborne.tilts()) == 3
        airborne.gates()
        assert airborne.tilts()[0][0] == pytest.approx(tilt_share(0.9 * INDOOR_DEG))

    def test_what_comes_during_the_take_off_is_flown_after_it(self, played: PlayedAircraft):
        played.gates()
        played.ref(takes_off=True)
        played.gates(1, "taking_off")
        played.pcmd(gaz=0.5)
        assert played.tilts() == []
        played.gates(1, "hovering")
        assert len(played.tilts()) == 1

    def test_on_the_ground_it_is_nothing(self, played: PlayedAircraft):
        played.gates()
        played.pcmd(pitch=-1.0)
        played.flown_gates(20, "landed")
        assert played.sent == []

    def test_it_ends_with_the_landing(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-1.0)
        airborne.ref(takes_off=False)
        airborne.pcmd(pitch=-1.0)
        airborne.flown_gates(30, "landing")
        assert len(airborne.tilts()) == 1

    def test_it_does_not_climb_beyond_altitude_max(self, airborne: PlayedAircraft):
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
    def test_the_watchdog_s_bit(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.at(at_commands.ResetWatchdog(0))
        airborne.gates(3)
        assert StateBit.COM_WATCHDOG not in airborne.packet().state
        airborne.gates(4)
        assert StateBit.COM_WATCHDOG in airborne.packet().state
        assert StateBit.COM_LOST not in airborne.packet().state

    def test_it_hovers_after_two_seconds(self, airborne: PlayedAircraft):
        airborne.pcmd(pitch=-1.0)
        airborne.gates(101, "flying")
        assert HOVER not in airborne.tilts()
        airborne.gates(1, "flying")
        assert airborne.tilts()[-1] == HOVER

    def test_it_lands_after_four(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.config("general:navdata_demo", "TRUE")
        airborne.gates(103)
        airborne.listen()  # it is sent no more
        airborne.gates(5)
        assert StateBit.COM_LOST in airborne.packet().state
        assert airborne.packet().options[0].ctrl_state == 4 << 16 | LOST_COM
        airborne.gates(92)
        assert airborne.modes() == []
        airborne.gates(3)
        assert airborne.modes() == ["land"]

    def test_navdata_ends_with_it(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.at(at_commands.ResetWatchdog(0))
        airborne.gates(103)
        count = len(airborne.datagrams)
        airborne.gates(50)
        assert len(airborne.datagrams) == count

    def test_a_program_that_comes_back_is_obeyed(self, airborne: PlayedAircraft):
        airborne.at(at_commands.ResetWatchdog(0))
        airborne.gates(120)
        airborne.sent.clear()
        airborne._sequence = 1  # it has begun again
        airborne.pcmd(pitch=-1.0)
        assert len(airborne.tilts()) == 1

    def test_a_drone_that_only_took_off_lands_too(self, played: PlayedAircraft):
        played.gates()
        played.ref(takes_off=True)
        played.gates(1, "landed")  # it is on its way
        played.gates(60, "taking_off")
        played.gates(145, "hovering")
        assert played.modes() == ["takeoff", "land"]

    def test_a_drone_that_nobody_on_this_wire_flew_is_let_be(self, played: PlayedAircraft):
        played.at(at_commands.ResetWatchdog(0))
        played.gates(300, "hovering")
        assert played.sent == []

    def test_com_watchdog_is_configured(self, airborne: PlayedAircraft):
        airborne.config("general:com_watchdog", "1")
        airborne.pcmd(pitch=-1.0)
        airborne.gates(53, "flying")
        assert airborne.tilts()[-1] == HOVER


class TestAnotherCommander:
    def test_nothing_is_sent(self, airborne: PlayedAircraft):
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
    def test_it_turns_once_in_place(self, airborne: PlayedAircraft):
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
        assert lasted_s == pytest.approx(2 * math.pi, abs=0.2)  # it is repeated each 0.1 s
        assert airborne.tilts()[-1] == HOVER

    def test_it_is_shown(self, airborne: PlayedAircraft):
        airborne.listen()
        airborne.config("general:navdata_demo", "TRUE")
        airborne.at(at_commands.Calibrate(0, 0))
        airborne.flown_gates(10, "flying")
        assert airborne.packet().options[0].ctrl_state == 4 << 16 | MAGNETO_CALIBRATION

    def test_a_pilot_who_steers_ends_it(self, airborne: PlayedAircraft):
        airborne.at(at_commands.Calibrate(0, 0))
        airborne.pcmd(pitch=-1.0)
        airborne.flown_gates(10, "flying")
        assert [kind for kind, _ in airborne.sent][1:] == ["ardrone"] * 3

    def test_on_the_ground_it_is_refused(self, played: PlayedAircraft):
        played.gates()
        played.at(at_commands.Calibrate(0, 0))
        assert "air" in played.refusals[0]
