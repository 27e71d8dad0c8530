"""The texts of the control port."""

from zsim_bridges.ardrone.wire import configuration_text
from zsim_bridges.ardrone.wire.configuration_text import CustomList

ENTRIES = {"general:navdata_demo": "TRUE", "leds:leds_anim": "0,0,0", "network:owner_mac": ""}
KEPT = CustomList({"01234567": "a program"}, {"11223344": "somebody, else"}, {})


def test_the_configuration_is_lines_and_a_zero():
    text = configuration_text.format_configuration(ENTRIES)
    assert text == b"general:navdata_demo = TRUE\nleds:leds_anim = 0,0,0\nnetwork:owner_mac = \n\0"
    assert configuration_text.parse_configuration(text) == ENTRIES


def test_what_is_no_entry_is_left_out():
    assert configuration_text.parse_configuration(b"\xff\xff\na:b = 1\nnothing\n= 2\n\0c:d = 3\n") == {"a:b": "1"}


def test_the_list_is_blocks_and_a_zero():
    text = configuration_text.format_custom_list(KEPT)
    assert text == b"[applis]\r01234567,a program\r[profiles]\r11223344,somebody, else\r[sessions]\r\0"
    assert configuration_text.parse_custom_list(text) == KEPT


def test_lines_outside_of_a_block_are_left_out():
    kept = configuration_text.parse_custom_list(b"1,x\r[else]\r2,y\r[sessions]\r3,z\r4\r\0")
    assert kept == CustomList({}, {}, {"3": "z"})
