"""The configuration: three levels, ranges, sets of limits."""

import pytest

from zsim_bridges.ardrone.configuration import (
    KEPT_MAX,
    Configuration,
    ConfigurationError,
    format_configuration,
    format_custom_list,
)

TILT = "control:euler_angle_max"


@pytest.fixture
def configuration() -> Configuration:
    return Configuration({TILT: 0.4}, {"general:ardrone_name": "drone1"})


def test_defaults_are_the_sdk_s(configuration: Configuration):
    assert configuration.text("general:navdata_options") == "65537"
    assert configuration.number(TILT) == pytest.approx(0.20944)
    assert configuration.flag("general:navdata_demo") is False
    assert configuration.text("general:ardrone_name") == "drone1"


def test_keys_may_be_in_capitals(configuration: Configuration):
    configuration.set("CONTROL:altitude_max", "1500")
    assert configuration.number("control:altitude_max") == 1500


def test_values_are_cut_to_their_ranges(configuration: Configuration):
    configuration.set(TILT, "5")
    assert configuration.number(TILT) == 0.4  # of the aircraft
    configuration.set("control:control_vz_max", "5")
    assert configuration.number("control:control_vz_max") == 200.0


def test_outdoor_changes_the_set_of_limits(configuration: Configuration):
    configuration.set(TILT, "0.1")
    configuration.set("control:outdoor", "TRUE")
    assert configuration.number(TILT) == pytest.approx(0.34907)
    configuration.set("control:outdoor_euler_angle_max", "0.3")
    assert configuration.number(TILT) == pytest.approx(0.3)
    configuration.set("control:outdoor", "FALSE")
    assert configuration.number(TILT) == pytest.approx(0.1)


def test_levels_have_values_of_their_own(configuration: Configuration):
    configuration.set("custom:profile_id", "11111111")
    configuration.set("custom:profile_desc", "a pilot")
    configuration.set(TILT, "0.1")
    configuration.set("custom:application_id", "22222222")
    configuration.set("general:navdata_options", "1")
    configuration.set("control:altitude_max", "900")
    configuration.set("custom:profile_id", "33333333")
    assert configuration.number(TILT) == pytest.approx(0.20944)
    assert configuration.text("general:navdata_options") == "1"
    assert configuration.number("control:altitude_max") == 900.0  # common
    configuration.set("custom:profile_id", "11111111")
    assert configuration.number(TILT) == pytest.approx(0.1)
    assert configuration.custom_list()["profiles"] == {"00000000": "default", "11111111": "a pilot", "33333333": ""}
    assert configuration.is_current("00000000", "11111111", "22222222")


def test_levels_are_deleted(configuration: Configuration):
    for identifier in ("aa", "bb", "cc"):
        configuration.set("custom:session_id", identifier)
    configuration.set("custom:session_id", "-aa")
    assert list(configuration.custom_list()["sessions"]) == ["00000000", "bb", "cc"]
    configuration.set("custom:session_id", "-all")
    assert list(configuration.custom_list()["sessions"]) == ["00000000"]
    assert configuration.is_current("00000000", "00000000", "00000000")


def test_there_is_an_end_to_identifiers(configuration: Configuration):
    for k in range(1, KEPT_MAX):
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
        ("general:flying_time", "1", "read only"),
        ("general:ardrone_name", "x" * 129, "at most 128"),
        ("general:ardrone_name", "a\nb", "printable"),
        (TILT, "nan", "must be a number"),
        (TILT, "", "must be a number"),
        ("control:outdoor", "2", "TRUE or FALSE"),
    ],
)
def test_what_is_no_value_is_refused_with_a_reason(configuration: Configuration, key: str, value: str, reason: str):
    before = configuration.all()
    with pytest.raises(ConfigurationError, match=reason):
        configuration.set(key, value)
    assert configuration.all() == before


def test_the_texts_of_the_control_port():
    entries = {"general:navdata_demo": "TRUE", "leds:leds_anim": "0,0,0", "network:owner_mac": ""}
    text = format_configuration(entries)
    assert text == b"general:navdata_demo = TRUE\nleds:leds_anim = 0,0,0\nnetwork:owner_mac = \n\0"
    kept = {"applis": {"01234567": "a program"}, "profiles": {"11223344": "somebody, else"}, "sessions": {}}
    text = format_custom_list(kept)
    assert text == b"[applis]\r01234567,a program\r[profiles]\r11223344,somebody, else\r[sessions]\r\0"
