"""Faults of a document against its types: every one, with its path, and what is sound of the rest."""

import math
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import Meta, Struct

from zsim.schema.checker import faults, first_fault, show, sound


class Part(Struct, forbid_unknown_fields=True):
    name: Annotated[str, Meta(pattern=r"^[a-z]{1,3}\Z")]
    mass_kg: Annotated[float, Meta(gt=0, le=100)] = 1.0
    place: tuple[float, float] = (0.0, 0.0)
    kind: Literal["big", "small"] = "big"


class Whole(Struct, forbid_unknown_fields=True):
    count: Annotated[int, Meta(ge=0, le=2**62)]
    parts: Annotated[list[Part], Meta(min_length=1, max_length=3)]
    on: bool = True
    speed: Annotated[float, Meta(ge=0)] | None = None
    table: dict[str, float] = {}
    series: Annotated[tuple[int, ...], Meta(min_length=2, max_length=2)] = (1, 2)
    free: Any = None


class Loose(Struct):
    x: float


GOOD = {"count": 3, "parts": [{"name": "a"}]}


def found(**changes: Any) -> list[str]:
    return [f"{path} {text}" for path, text in faults({**GOOD, **changes}, Whole)]


def test_a_sound_document_has_no_faults():
    assert found() == []
    part = {"name": "abc", "mass_kg": 2, "place": [1, 2.5], "kind": "small"}
    assert found(parts=[part] * 3, on=False, speed=0, table={"a": 1}, series=[3, 4], free={"x": [None]}) == []
    assert first_fault(GOOD, Whole) is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"count": "3"}, "count is '3'; must be a whole number >= 0 and <= 4611686018427387904"),
        ({"count": 3.0}, "count is 3.0; must be a whole number >= 0 and <= 4611686018427387904"),
        ({"count": True}, "count is true; must be a whole number >= 0 and <= 4611686018427387904"),
        ({"count": None}, "count is null; must be a whole number >= 0 and <= 4611686018427387904"),
        ({"count": -1}, "count is -1; must be >= 0 and <= 4611686018427387904"),
        ({"parts": []}, "parts has 0 entries; must have 1 to 3"),
        ({"parts": [{"name": "a"}] * 4}, "parts has 4 entries; must have 1 to 3"),
        ({"parts": "a"}, "parts is 'a'; must be a list"),
        ({"parts": [7]}, "parts[0] is 7; must be a map"),
        ({"parts": [{}]}, "parts[0].name is missing; must be text"),
        ({"parts": [{"name": "A"}]}, "parts[0].name is 'A'; must match [a-z]{1,3}"),
        ({"parts": [{"name": "a\n"}]}, "parts[0].name is 'a\\n'; must match [a-z]{1,3}"),
        ({"parts": [{"name": "a", "mass_kg": 0}]}, "parts[0].mass_kg is 0; must be > 0 and <= 100"),
        (
            {"parts": [{"name": "a", "mass_kg": math.nan}]},
            "parts[0].mass_kg is nan; must be a finite number > 0 and <= 100",
        ),
        ({"parts": [{"name": "a", "mass_kg": 10**400}]}, "parts[0].mass_kg is 1000…"),
        ({"parts": [{"name": "a", "place": [1]}]}, "parts[0].place is [1]; must be a list of 2 entries"),
        ({"parts": [{"name": "a", "place": [1, "x"]}]}, "parts[0].place[1] is 'x'; must be a finite number"),
        ({"parts": [{"name": "a", "place": [1, -math.inf]}]}, "parts[0].place[1] is -inf; must be a finite number"),
        ({"parts": [{"name": "a", "kind": "huge"}]}, "parts[0].kind is 'huge'; must be one of big, small"),
        ({"parts": [{"name": "a", "kind": []}]}, "parts[0].kind is []; must be one of big, small"),
        ({"parts": [{"name": "a", "colour": 1}]}, "parts[0].colour is not known; allowed: kind, mass_kg, name, place"),
        ({"on": 1}, "on is 1; must be true or false"),
        ({"speed": -1}, "speed is -1; must be >= 0"),
        ({"speed": "x"}, "speed is 'x'; must be a finite number >= 0"),
        ({"table": {"a": "x"}}, "table.a is 'x'; must be a finite number"),
        ({"table": {1: 1.0}}, "table.1 as a key is 1; must be text"),
        ({"table": [1]}, "table is [1]; must be a map"),
        ({"series": [1]}, "series has 1 entries; must have 2"),
        ({"series": [1, 2.5]}, "series[1] is 2.5; must be a whole number"),
        ({7: 1}, "7 is not known; allowed: count, free…"),
    ],
)
def test_a_fault_says_where_what_and_what_is_allowed(changes: dict[str, Any], said: str):
    (only,) = [f"{path} {text}" for path, text in faults({**GOOD, **changes}, Whole)]
    assert only.startswith(said[:-1]) if said.endswith("…") else only == said
    assert first_fault({**GOOD, **changes}, Whole) is not None


def test_every_fault_is_found():
    parts = [{"name": "A", "mass_kg": -1}, {"kind": 3, "colour": 1}, 5]
    paths = [path for path, _ in faults({"parts": parts, "on": "x", "what": 1}, Whole)]
    wanted = """what count on parts[0].name parts[0].mass_kg parts[1].colour parts[1].name parts[1].kind parts[2]"""
    assert sorted(paths) == sorted(wanted.split())


@pytest.mark.parametrize("document", [None, [], "x", 3, [{}]])
def test_a_document_that_is_no_map_is_one_fault(document: Any):
    ((path, text),) = faults(document, Whole)
    assert path == ""
    assert text.endswith("must be a map")


def test_unknown_fields_are_faults_only_where_the_type_says_so():
    assert list(faults({"x": 1, "y": 2}, Loose)) == []


def test_a_path_begins_where_it_is_told():
    assert [path for path, _ in faults({"name": 1}, Part, "drones[3]")] == ["drones[3].name"]


def test_limits_of_the_representation_are_not_shown():
    number = Annotated[float, Meta(ge=-1.7976931348623157e308, le=1.7976931348623157e308)]
    whole = Annotated[int, Meta(ge=0, le=2**63 - 1)]
    assert list(faults("x", number)) == [("", "is 'x'; must be a finite number")]
    assert list(faults(-1, whole)) == [("", "is -1; must be >= 0")]
    assert list(faults(2**64 - 1, whole)) == [
        ("", "is 18446744073709551615; must be a whole number of 63 bits and sign")
    ]


# Agreement with msgspec, which decides in the end

plain = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 5) | st.floats(-3, 3) | st.sampled_from(["a", "big", "x" * 9]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["name", "mass_kg", "place", "kind", "a"]), inner, max_size=4)
    ),
    max_leaves=6,
)
fields = st.sampled_from([*Whole.__struct_fields__, "other"])


@settings(max_examples=500, deadline=None)
@given(changes=st.dictionaries(fields, plain, max_size=3))
def test_faults_are_found_exactly_where_msgspec_refuses(changes: dict[str, Any]):
    document = {**GOOD, **changes}
    try:
        msgspec.convert(document, Whole)
        accepted = True
    except msgspec.ValidationError:
        accepted = False
    assert accepted == (found(**changes) == [])


# What is sound


def test_what_is_sound_keeps_its_place_and_the_rest_is_none():
    document = {
        "count": "x",
        "parts": [{"name": "a", "mass_kg": -1, "place": [1, 2]}, 5, {"name": "B", "kind": "small"}],
        "speed": 3,
        "series": [1],
        "unknown": 1,
    }
    whole = sound(document, Whole)
    first, second, third = whole.parts
    assert (whole.count, whole.on, whole.speed, whole.table, whole.series) == (None, True, 3, {}, None)
    assert (first.name, first.mass_kg, first.place, first.kind) == ("a", None, [1, 2], "big")
    assert second is None
    assert (third.name, third.mass_kg, third.kind) == (None, 1.0, "small")


@pytest.mark.parametrize("document", [None, 5, [], "x"])
def test_nothing_is_sound_of_what_is_no_map(document: Any):
    assert sound(document, Whole) is None


def test_a_list_beyond_its_limit_is_not_gone_through():
    assert sound({**GOOD, "parts": [{"name": "a"}] * 4}, Whole).parts is None


@settings(max_examples=300, deadline=None)
@given(changes=st.dictionaries(fields, plain, max_size=4))
def test_any_document_has_a_sound_part(changes: dict[str, Any]):
    document = {**GOOD, **changes}
    whole = sound(document, Whole)
    assert whole.on in (True, False, None)
    if not found(**changes):
        assert msgspec.to_builtins(msgspec.convert(document, Whole))["count"] == whole.count


# One line


@settings(max_examples=300, deadline=None)
@given(value=st.recursive(st.none() | st.integers() | st.floats() | st.text() | st.binary(), st.lists, max_leaves=9))
def test_what_was_found_fits_into_a_line(value: Any):
    said = show(value)
    assert 0 < len(said) <= 60
    assert said.isprintable()


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (None, "null"),
        (True, "true"),
        ([1, [math.inf]], "[1, [inf]]"),
        ({"a": [None, "x"]}, "{'a': [null, 'x']}"),
        ("a\nb", "'a\\nb'"),
        ("é", "'é'"),
        (range(3), "range(0, 3)"),
        ({1: b"x"}, "{1: b'x'}"),
        (list(range(100)), "a list of 100 entries"),
        (dict.fromkeys(range(100)), "a map of 100 entries"),
    ],
)
def test_what_was_found_is_shown_as_it_would_stand_in_a_file(value: Any, said: str):
    assert show(value) == said


def test_a_number_of_any_size_is_shown_in_a_line():
    assert show(10**5000) == "a number of more than 4300 digits"
    ((_, text),) = faults({**GOOD, "count": 10**5000}, Whole)
    assert text.startswith("is a number of more than 4300 digits; must be")


def test_nesting_without_end_is_shown_in_a_line():
    nested: list[Any] = []
    for _ in range(5000):
        nested = [nested]
    assert len(show(nested)) <= 60


def test_a_long_or_broken_key_fits_into_a_line():
    ((path, _),) = faults({**GOOD, "k\n" * 500: 1}, Whole)
    assert len(path) <= 60
    assert path.isprintable()
