"""Faults of a document against its types: each with its path, and the sound part of the rest."""

import math
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import Meta, Struct
from refused import has_terms

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
    ("changes", "terms"),
    [
        ({"count": "3"}, ("count", "'3'", "whole", ">=", "0", "<=", "4611686018427387904")),
        ({"count": 3.0}, ("count", "3.0", "whole", ">=", "0", "<=", "4611686018427387904")),
        ({"count": True}, ("count", "true", "whole", ">=", "0", "<=", "4611686018427387904")),
        ({"count": None}, ("count", "null", "whole", ">=", "0", "<=", "4611686018427387904")),
        ({"count": -1}, ("count", "-1", ">=", "0", "<=", "4611686018427387904")),
        ({"parts": []}, ("parts", "0", "1", "3")),
        ({"parts": [{"name": "a"}] * 4}, ("parts", "4", "1", "3")),
        ({"parts": "a"}, ("parts", "'a'", "list")),
        ({"parts": [7]}, ("parts[0]", "7", "map")),
        ({"parts": [{}]}, ("parts[0].name", "missing", "text")),
        ({"parts": [{"name": "A"}]}, ("parts[0].name", "'A'", "[a-z]{1,3}")),
        ({"parts": [{"name": "a\n"}]}, ("parts[0].name", "'a\\n'", "[a-z]{1,3}")),
        ({"parts": [{"name": "a", "mass_kg": 0}]}, ("parts[0].mass_kg", "0", ">", "0", "<=", "100")),
        ({"parts": [{"name": "a", "mass_kg": math.nan}]}, ("parts[0].mass_kg", "nan", "finite", ">", "0", "<=", "100")),
        ({"parts": [{"name": "a", "mass_kg": 10**400}]}, ("parts[0].mass_kg", "1" + "0" * 56)),
        ({"parts": [{"name": "a", "place": [1]}]}, ("parts[0].place", "[1]", "list", "2")),
        ({"parts": [{"name": "a", "place": [1, "x"]}]}, ("parts[0].place[1]", "'x'", "finite")),
        ({"parts": [{"name": "a", "place": [1, -math.inf]}]}, ("parts[0].place[1]", "-inf", "finite")),
        ({"parts": [{"name": "a", "kind": "huge"}]}, ("parts[0].kind", "'huge'", "big", "small")),
        ({"parts": [{"name": "a", "kind": []}]}, ("parts[0].kind", "[]", "big", "small")),
        ({"parts": [{"name": "a", "colour": 1}]}, ("parts[0].colour", "known", "kind", "mass_kg", "name", "place")),
        ({"on": 1}, ("on", "1", "true", "false")),
        ({"speed": -1}, ("speed", "-1", ">=", "0")),
        ({"speed": "x"}, ("speed", "'x'", "finite", ">=", "0")),
        ({"table": {"a": "x"}}, ("table.a", "'x'", "finite")),
        ({"table": {1: 1.0}}, ("table.1", "key", "1", "text")),
        ({"table": [1]}, ("table", "[1]", "map")),
        ({"series": [1]}, ("series", "1", "2")),
        ({"series": [1, 2.5]}, ("series[1]", "2.5", "whole")),
        ({7: 1}, ("7", "known", "count", "free")),
    ],
)  # fmt: skip
def test_a_fault_gives_the_path_the_value_and_what_is_allowed(changes: dict[str, Any], terms: tuple[str, ...]):
    (only,) = [f"{path} {text}" for path, text in faults({**GOOD, **changes}, Whole)]
    assert has_terms(only, *terms)
    assert first_fault({**GOOD, **changes}, Whole) is not None


def test_every_fault_is_found():
    parts = [{"name": "A", "mass_kg": -1}, {"kind": 3, "colour": 1}, 5]
    paths = [path for path, _ in faults({"parts": parts, "on": "x", "what": 1}, Whole)]
    wanted = """what count on parts[0].name parts[0].mass_kg parts[1].colour parts[1].name parts[1].kind parts[2]"""
    assert sorted(paths) == sorted(wanted.split())


@pytest.mark.parametrize("document", [None, [], "x", 3, [{}]])
def test_a_document_that_is_not_a_map_is_one_fault(document: Any):
    ((path, text),) = faults(document, Whole)
    assert path == ""
    assert has_terms(text, "map")


def test_unknown_fields_are_faults_only_if_the_type_forbids_them():
    assert list(faults({"x": 1, "y": 2}, Loose)) == []


def test_a_path_begins_with_the_given_prefix():
    assert [path for path, _ in faults({"name": 1}, Part, "drones[3]")] == ["drones[3].name"]


def test_limits_of_the_representation_are_not_shown():
    number = Annotated[float, Meta(ge=-1.7976931348623157e308, le=1.7976931348623157e308)]
    whole = Annotated[int, Meta(ge=0, le=2**63 - 1)]
    texts = [
        text for value, kind in (("x", number), (-1, whole), (2**64 - 1, whole)) for _, text in faults(value, kind)
    ]
    assert has_terms(texts[0], "'x'", "finite")
    assert has_terms(texts[1], "-1", ">=", "0")
    assert has_terms(texts[2], "18446744073709551615", "whole")
    assert not any(limit in text for text in texts for limit in ("e+308", "<="))


# Agreement with msgspec, which has the final say

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


# The sound part


def test_sound_values_keep_their_place_and_faulty_ones_become_none():
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
def test_a_document_that_is_not_a_map_has_no_sound_part(document: Any):
    assert sound(document, Whole) is None


def test_a_list_beyond_its_limit_is_not_examined():
    assert sound({**GOOD, "parts": [{"name": "a"}] * 4}, Whole).parts is None


@settings(max_examples=300, deadline=None)
@given(changes=st.dictionaries(fields, plain, max_size=4))
def test_any_map_has_a_sound_part(changes: dict[str, Any]):
    document = {**GOOD, **changes}
    whole = sound(document, Whole)
    assert whole.on in (True, False, None)
    if not found(**changes):
        assert msgspec.to_builtins(msgspec.convert(document, Whole))["count"] == whole.count


# Values shown in one line


@settings(max_examples=300, deadline=None)
@given(value=st.recursive(st.none() | st.integers() | st.floats() | st.text() | st.binary(), st.lists, max_leaves=9))
def test_a_value_is_shown_in_one_short_line(value: Any):
    said = show(value)
    assert 0 < len(said) <= 60
    assert said.isprintable()


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "null"),
        (True, "true"),
        ([1, [math.inf]], "[1, [inf]]"),
        ({"a": [None, "x"]}, "{'a': [null, 'x']}"),
        ("a\nb", "'a\\nb'"),
        ("é", "'é'"),
        (range(3), "range(0, 3)"),
        ({1: b"x"}, "{1: b'x'}"),
    ],
)
def test_a_value_is_shown_as_it_would_be_written_in_a_file(value: Any, shown: str):
    assert show(value) == shown


def test_a_long_value_is_shown_by_its_type_and_length():
    assert has_terms(show(list(range(100))), "list", "100")
    assert has_terms(show(dict.fromkeys(range(100))), "map", "100")


def test_a_number_of_any_size_is_shown_in_one_line():
    assert has_terms(show(10**5000), "4300")
    ((_, text),) = faults({**GOOD, "count": 10**5000}, Whole)
    assert has_terms(text, "4300")


def test_deep_nesting_is_shown_in_one_line():
    nested: list[Any] = []
    for _ in range(5000):
        nested = [nested]
    assert len(show(nested)) <= 60


def test_a_long_or_multi_line_key_is_shown_in_one_line():
    ((path, _),) = faults({**GOOD, "k\n" * 500: 1}, Whole)
    assert len(path) <= 60
    assert path.isprintable()
