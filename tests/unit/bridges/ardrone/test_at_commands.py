"""AT commands: encoding, refusals and dialects of other programs; the configuration: levels and ranges."""

import math
import random
import struct

import pytest

from zsim_bridges.ardrone import at_commands as at
from zsim_bridges.ardrone.at_commands import (
    CONFIGURATIONS_MAX,
    Configuration,
    ConfigurationError,
    format_configuration,
    format_custom_list,
)

TILT = "control:euler_angle_max"


@pytest.fixture
def configuration() -> Configuration:
    return Configuration({TILT: 0.4}, {"general:ardrone_name": "drone1"})


def test_defaults_are_those_of_the_sdk(configuration: Configuration):
    assert configuration.text("general:navdata_options") == "65537"
    assert configuration.number(TILT) == pytest.approx(0.20944)
    assert configuration.flag("general:navdata_demo") is False
    assert configuration.text("general:ardrone_name") == "drone1"


def test_keys_are_case_insensitive(configuration: Configuration):
    configuration.set("CONTROL:altitude_max", "1500")
    assert configuration.number("control:altitude_max") == 1500


def test_values_are_clamped_to_their_ranges(configuration: Configuration):
    configuration.set(TILT, "5")
    assert configuration.number(TILT) == 0.4  # the limit of the aircraft
    configuration.set("control:control_vz_max", "5")
    assert configuration.number("control:control_vz_max") == 200.0


def test_outdoor_selects_another_set_of_limits(configuration: Configuration):
    configuration.set(TILT, "0.1")
    configuration.set("control:outdoor", "TRUE")
    assert configuration.number(TILT) == pytest.approx(0.34907)
    configuration.set("control:outdoor_euler_angle_max", "0.3")
    assert configuration.number(TILT) == pytest.approx(0.3)
    configuration.set("control:outdoor", "FALSE")
    assert configuration.number(TILT) == pytest.approx(0.1)


def test_levels_have_separate_values(configuration: Configuration):
    configuration.set("custom:profile_id", "11111111")
    configuration.set("custom:profile_desc", "a pilot")
    configuration.set(TILT, "0.1")
    configuration.set("custom:application_id", "22222222")
    configuration.set("general:navdata_options", "1")
    configuration.set("control:altitude_max", "900")
    configuration.set("custom:profile_id", "33333333")
    assert configuration.number(TILT) == pytest.approx(0.20944)
    assert configuration.text("general:navdata_options") == "1"
    assert configuration.number("control:altitude_max") == 900.0  # common to all levels
    configuration.set("custom:profile_id", "11111111")
    assert configuration.number(TILT) == pytest.approx(0.1)
    assert configuration.custom_list()["profiles"] == {"00000000": "default", "11111111": "a pilot", "33333333": ""}
    assert configuration.is_current("00000000", "11111111", "22222222")


def test_levels_can_be_deleted(configuration: Configuration):
    for identifier in ("aa", "bb", "cc"):
        configuration.set("custom:session_id", identifier)
    configuration.set("custom:session_id", "-aa")
    assert list(configuration.custom_list()["sessions"]) == ["00000000", "bb", "cc"]
    configuration.set("custom:session_id", "-all")
    assert list(configuration.custom_list()["sessions"]) == ["00000000"]
    assert configuration.is_current("00000000", "00000000", "00000000")


def test_the_number_of_identifiers_is_limited(configuration: Configuration):
    for k in range(1, CONFIGURATIONS_MAX):
        configuration.set("custom:session_id", f"{k:08x}")
    with pytest.raises(ConfigurationError, match="delete some"):
        configuration.set("custom:session_id", "ffffffff")


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("general:no_such", "1", "not an entry"),
        ("custom:no_such", "1", "not an entry"),
        ("custom:session_id", "not an id!", "letters and digits"),
        ("custom:session_id", "-dd", "there is no configuration"),
        ("general:flying_time", "1", "general:flying_time is read-only"),
        ("general:ardrone_name", "x" * 129, "at most 128"),
        ("general:ardrone_name", "a\nb", "printable"),
        (TILT, "nan", "must be a number"),
        (TILT, "", "must be a number"),
        ("control:outdoor", "2", "TRUE or FALSE"),
    ],
)
def test_an_invalid_value_is_refused_with_a_reason(configuration: Configuration, key: str, value: str, reason: str):
    before = configuration.all()
    with pytest.raises(ConfigurationError, match=reason):
        configuration.set(key, value)
    assert configuration.all() == before


def test_texts_of_the_control_port_have_the_sdk_s_format():
    entries = {"general:navdata_demo": "TRUE", "leds:leds_anim": "0,0,0", "network:owner_mac": ""}
    text = format_configuration(entries)
    assert text == b"general:navdata_demo = TRUE\nleds:leds_anim = 0,0,0\nnetwork:owner_mac = \n\0"
    kept = {"applis": {"01234567": "a program"}, "profiles": {"11223344": "somebody, else"}, "sessions": {}}
    text = format_custom_list(kept)
    assert text == b"[applis]\r01234567,a program\r[profiles]\r11223344,somebody, else\r[sessions]\r\0"


FLOATS = {
    -1.0: -1082130432,
    -0.8: -1085485875,
    -0.5: -1090519040,
    -0.3: -1097229926,
    0.05: 1028443341,
    0.3: 1050253722,
    0.5: 1056964608,
    0.75: 1061158912,
    0.8: 1061997773,
    1.0: 1065353216,
}  # from the AR.Drone Developer Guide and tables of other programs
COMMANDS = [
    at.ref(1, takes_off=True),
    at.Pcmd(2, 1, 0.5, -0.5, 1.0, -1.0),
    at.PcmdMag(3, 5, 0.5, -0.5, 1.0, -1.0, 0.25, 0.125),
    at.FlatTrim(4),
    at.Calibrate(5, 0),
    at.ConfigIds(6, "aabbccdd", "11223344", "01234567"),
    at.Config(7, "control:flight_anim", "3,1000"),
    at.Control(8, at.ACKNOWLEDGE),
    at.ResetWatchdog(9),
    at.Led(10, 3, 2.0, 5),
    at.Animation(11, 18, 15),
]


@pytest.mark.parametrize(("value", "bits"), FLOATS.items())
def test_a_float_is_encoded_as_the_integer_of_the_same_bits(value: float, bits: int):
    assert at.float_to_bits(value) == bits
    assert at.bits_to_float(bits) == struct.unpack("<f", struct.pack("<f", value))[0]


def test_commands_are_encoded_as_in_the_developer_guide():
    assert at.ref(1, takes_off=True).bits == 290718208
    assert at.ref(1, takes_off=False).bits == 290717696
    assert at.ref(1, takes_off=False, emergency=True).bits == 290717952
    assert at.format_command(at.Pcmd(21625, 1, 0.0, 0.0, 0.0, -0.8)) == b"AT*PCMD=21625,1,0,0,0,-1085485875\r"


def test_formatted_commands_are_parsed_back():
    datagram = b"".join(map(at.format_command, COMMANDS))
    assert at.parse(datagram) == at.Parsed(COMMANDS, [])


def test_a_trailing_comma_is_accepted():
    assert at.parse(b"AT*COMWDG=4,\r").commands == [at.ResetWatchdog(4)]
    assert at.parse(b"AT*REF=5,512,\r").commands == [at.Ref(5, 512)]


def test_a_string_may_contain_commas_or_be_empty():
    parsed = at.parse(b'AT*CONFIG=1,"leds:leds_anim","3,1073741824,2"\rAT*CONFIG=2,"network:owner_mac",""\r')
    assert parsed.commands == [
        at.Config(1, "leds:leds_anim", "3,1073741824,2"),
        at.Config(2, "network:owner_mac", ""),
    ]


def test_sdk_commands_without_an_effect_here_are_accepted():
    assert at.parse(b"AT*PMODE=1,2\rAT*MISC=2,2,20,2000,3000\r") == at.Parsed(
        [at.Ignored(1, "PMODE"), at.Ignored(2, "MISC")], []
    )


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (b"AT*REF=1,29071820", "does not end in a carriage return"),
        (b"AT*REF=1,\r", "REF has 0 arguments; must have 1"),
        (b"AT*REF=1,512,7\r", "REF has 2 arguments"),
        (b'AT*REF=1,"512"\r', "must be an integer"),
        (b"AT*REF=1,99999999999\r", "must be an integer"),
        (b"AT*REF=1,9999999999\r", "of 32 bits"),
        (b"AT*REF=9999999999,512\r", "sequence number"),
        (b"AT*REF=-1,512\r", "AT command; must be"),
        (b"AT*FLIP=1,1\r", "FLIP is not known"),
        (b"at*ref=1,512\r", "AT command; must be"),
        (b"AT*PCMD=1,1,2143289344,0,0,0\r", "finite"),  # a NaN
        (b"AT*PCMD=1,1,2139095040,0,0,0\r", "finite"),  # infinity
        (b"AT*PCMD=1,1,4000000000,0,0,0\r", "finite"),
        (b'AT*CONFIG=1,"a:b,"c"\r', "CONFIG has the argument"),
        (b"AT*CONFIG=1,1,2\r", "argument '1'"),
        (b"AT*REF=1,\xb2\r", "AT command; must be"),
        (b"AT*REF=1," + b"1" * 1100 + b"\r", "must have at most 1024"),
        (b"\r", "AT command; must be"),
        (b"A" * 9000, "must have at most 8192"),
    ],
)
def test_a_malformed_command_is_refused_with_a_reason(datagram: bytes, reason: str):
    commands, refusals = at.parse(datagram)
    assert commands == []
    assert len(refusals) == 1
    assert reason in refusals[0]


def test_a_refused_command_does_not_affect_others_in_its_datagram():
    parsed = at.parse(b"AT*REF=1,512\rgarbage\rAT*COMWDG=2\r")
    assert parsed.commands == [at.Ref(1, 512), at.ResetWatchdog(2)]
    assert len(parsed.refusals) == 1


def test_no_datagram_raises_an_error():
    chance = random.Random(1)
    good = b"".join(map(at.format_command, COMMANDS))
    for _ in range(2000):
        datagram = bytearray(good)
        for _ in range(chance.randrange(1, 30)):
            datagram[chance.randrange(len(datagram))] = chance.randrange(256)
        for command in at.parse(bytes(datagram[: chance.randrange(len(datagram) + 1)])).commands:
            assert all(math.isfinite(value) for value in command if isinstance(value, float))
