"""Rules that every message must satisfy: its field names, an exact round trip, and the refusal of any other payload.

CONTRACT repeats the table of the contract, so that renaming or dropping a field in the code fails a test here.
"""

import copy
import math
from collections.abc import Iterator
from itertools import product
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import inspect as types
from refused import has_terms, refused

from zsim.contract import messages, run_messages
from zsim.contract.flight_messages import JPEG_BEGINS
from zsim.errors import DecodeError

# Fields other than t_ns and seq, in the order of the contract
SENSOR = "t_sample_ns "
CONTRACT = {
    "world/info": "contract run_id federation mode rate gate_ns physics_dt_ns command_delay_ns seed origin drones "
    "clusters scenario scenario_sha256 version fingerprint",
    "clock": "run_id step state rate waiting_for",
    "world/event": "kind source subject text data",
    "world/faults": "faults",
    "world/radio": "hears reception",
    "drone/*/sensor/imu": SENSOR + "accel_m_s2 gyro_rad_s",
    "drone/*/sensor/gps": SENSOR
    + "latitude_deg longitude_deg altitude_m position_m velocity_m_s sigma_m fix satellites",
    "drone/*/sensor/mag": SENSOR + "field_ut",
    "drone/*/sensor/baro": SENSOR + "pressure_pa altitude_m",
    "drone/*/sensor/sonar": SENSOR + "range_m valid",
    "drone/*/sensor/flow": SENSOR + "velocity_m_s quality",
    "drone/*/sensor/range": SENSOR + "beams ranges_m max_m",
    "drone/*/sensor/lidar": SENSOR + "channels columns elevation_rad azimuth_rad max_m ranges_m",
    "drone/*/sensor/depth": SENSOR + "camera columns rows focal_px centre_px max_m depth_m",
    "drone/*/sensor/status": "state battery_percent collision commander count",
    "drone/*/truth": "position_m velocity_m_s orientation_wxyz angular_velocity_rad_s accel_m_s2 rotor_rad_s",
    **{f"drone/*/camera/{name}": "t_sample_ns source width height format data" for name in ("front", "bottom")},
    **{
        f"drone/*/camera/{name}/info": "source width height K D position_m orientation_wxyz rate_hz exposure_s gate_ns"
        for name in ("front", "bottom")
    },
    "drone/*/sensor/sightings": "t_sample_ns source camera seen",
    "drone/*/sightings": "t_sample_ns source camera seen",
    "drone/*/cmd/velocity": "source velocity_m_s yaw_rate_rad_s frame",
    "drone/*/cmd/ardrone": "source forward left up yaw_left hover",
    "drone/*/cmd/attitude": "source orientation_wxyz thrust_n yaw_rate_rad_s",
    "drone/*/cmd/rotors": "source speed_rad_s",
    "drone/*/cmd/mode": "source mode",
    "drone/*/accepted/velocity": "source velocity_m_s yaw_rate_rad_s frame",
    "drone/*/accepted/ardrone": "source forward left up yaw_left hover",
    "drone/*/accepted/attitude": "source orientation_wxyz thrust_n yaw_rate_rad_s",
    "drone/*/accepted/rotors": "source speed_rad_s",
    "drone/*/accepted/mode": "source mode",
    "drone/*/link": "source peer state age_ms loss_percent round_trip_ms clock_offset_ms refused",
    "drone/*/estimate": "position_m velocity_m_s orientation_wxyz yaw_rad covariance yaw_sigma_rad gyro_bias_rad_s "
    "sensors",
    "cluster/*/state": "phase drones names value desired desired_rate trajectory_t_s margin reason",
    "cluster/*/request": "op args source ok",
    "drone/*/request": "op args source ok",
    "drone/*/reference": "phase position_m velocity_m_s yaw_rad yaw_rate_rad_s path_t_s source",
    "process/*/join": "run_id incarnation role host pid period_ns version fingerprint",
    "process/*/done": "run_id incarnation done_ns sent",
    "process/*/snapshot": "source version state",
    "process/*/bye": "reason failed run_id incarnation",
    "process/*/health": "role host pid step_us lag_ns dropped refused rss_bytes",
    "view/drones": "",
    "view/cluster/*": "",
    "view/estimates/*": "",
}
NAMES = {
    "world/info": "Info",
    "clock": "Clock",
    "drone/*/sensor/imu": "Imu",
    "drone/*/cmd/velocity": "Velocity",
    "drone/*/cmd/mode": "Mode",
    "process/*/done": "Done",
}
LENGTHS = {"covariance": 36, "accel_m_s2": 3, "gyro_rad_s": 3, "orientation_wxyz": 4, "rotor_rad_s": 4}
SHAPES = sorted(CONTRACT)
INT64 = -(2**63), 2**63 - 1
NULLABLE = {
    *("commander", "trajectory_t_s", "path_t_s", "until_ns"),
    *("age_ms", "loss_percent", "round_trip_ms", "clock_offset_ms"),
}
FREE = {"data", "args", "parameters"}  # fields with free-form content

every_message = pytest.mark.parametrize("shape", SHAPES)
every_type = pytest.mark.parametrize(
    "shape", {messages.type_of(each.replace("*", "drone1")): each for each in SHAPES}.values()
)


def pack(plain: Any, **options: bool) -> bytes:
    """Pack with the plain `msgpack` package, which knows nothing of the contract."""
    packed = msgpack.packb(plain, **options)
    assert packed is not None
    return packed


def key_of(shape: str) -> str:
    return shape.replace("*", "drone1")


def kind_of(shape: str) -> type[msgspec.Struct]:
    kind = messages.type_of(key_of(shape))
    assert kind is not None
    return kind


# Valid messages of every type, generated from the types themselves

finite = st.floats(allow_nan=False, allow_infinity=False)
text = st.text(max_size=12)
free = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | finite | text | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(text, inner, max_size=3),
    max_leaves=8,
)


def values(info: Any) -> st.SearchStrategy[Any]:
    """Return a strategy for plain values, as msgpack unpacks them, that fit a type."""
    if isinstance(info, types.Metadata):
        return values(info.type)
    if isinstance(info, types.StructType):
        return maps(info)
    if isinstance(info, types.UnionType):
        return st.one_of([values(option) for option in info.types])
    if isinstance(info, types.VarTupleType):
        return st.lists(values(info.item_type), min_size=info.min_length or 0, max_size=info.max_length or 4)
    if isinstance(info, types.TupleType):
        return st.tuples(*[values(item) for item in info.item_types]).map(list)
    if isinstance(info, types.DictType):
        return st.dictionaries(values(info.key_type), values(info.value_type), max_size=3)
    if isinstance(info, types.LiteralType):
        return st.sampled_from(info.values)
    if isinstance(info, types.IntType):
        low, high = INT64
        return st.integers(low if info.ge is None else info.ge, high if info.le is None else info.le)
    return {
        types.FloatType: finite,
        types.StrType: text,
        types.BoolType: st.booleans(),
        types.BytesType: st.binary(max_size=12).map(lambda some: JPEG_BEGINS + some),
        types.NoneType: st.none(),
        types.AnyType: free,
    }[type(info)]


def maps(info: types.StructType) -> st.SearchStrategy[dict[str, Any]]:
    plain = st.fixed_dictionaries({field.encode_name: values(field.type) for field in info.fields})
    return plain.map(_matched)


def _matched(plain: dict[str, Any]) -> dict[str, Any]:
    """Make lists that belong together equally long."""
    if "desired_rate" in plain:
        plain["drones"] = plain["drones"][:2]
        for name in ("names", "value", "desired", "desired_rate"):
            filler = ["x"] if name == "names" else [2.0]
            plain[name] = (plain[name] + filler * 8)[: 4 * len(plain["drones"])]
    elif "beams" in plain:
        count = min(len(plain["beams"]), len(plain["ranges_m"]))
        plain["beams"], plain["ranges_m"] = plain["beams"][:count], plain["ranges_m"][:count]
    elif rays := {"ranges_m", "depth_m"} & plain.keys():
        plain |= {"columns": 3, "channels" if "channels" in plain else "rows": 1, rays.pop(): bytes(12)}
    elif "names" in plain:
        count = min(len(plain[name]) for name in ("names", "value", "desired"))
        for name in ("names", "value", "desired"):
            plain[name] = plain[name][:count]
    return plain


def plain_messages(shape: str) -> st.SearchStrategy[dict[str, Any]]:
    return values(types.type_info(kind_of(shape)))


def example(shape: str) -> dict[str, Any]:
    """Return one message with all fields and with no empty lists or maps."""
    return _matched(_filled(types.type_info(kind_of(shape))))


def _filled(info: Any) -> Any:
    if isinstance(info, types.Metadata):
        return _filled(info.type)
    if isinstance(info, types.StructType):
        return {field.encode_name: _filled(field.type) for field in info.fields}
    if isinstance(info, types.UnionType):
        return _filled(next(option for option in info.types if not isinstance(option, types.NoneType)))
    if isinstance(info, types.VarTupleType):
        return [_filled(info.item_type) for _ in range(info.min_length or 2)]
    if isinstance(info, types.TupleType):
        return [_filled(item) for item in info.item_types]
    if isinstance(info, types.DictType):
        return {"gps": _filled(info.value_type)}
    if isinstance(info, types.LiteralType):
        return info.values[0]
    scalars = {types.IntType: 7, types.FloatType: 2.0, types.StrType: "abc", types.BoolType: True}
    return {**scalars, types.BytesType: JPEG_BEGINS + b"state"}.get(type(info), 1)


Path = tuple[Any, ...]


def leaves(value: Any, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Yield the path and value of every scalar in a plain message, except in free-form content."""
    if FREE.intersection(path):
        return
    if isinstance(value, dict | list):
        for step, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(item, (*path, step))
    else:
        yield path, value


def branches(value: Any, path: Path = ()) -> Iterator[tuple[Path, list[Any]]]:
    """Yield the path and value of every list in a plain message."""
    if isinstance(value, list):
        yield path, value
    if isinstance(value, dict | list):
        for step, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from branches(item, (*path, step))


def replaced(plain: dict[str, Any], path: Path, value: Any) -> dict[str, Any]:
    changed = copy.deepcopy(plain)
    place: Any = changed
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = value
    return changed


def refusal(shape: str, payload: bytes) -> str:
    with pytest.raises(DecodeError) as caught:
        messages.decode(key_of(shape), payload)
    return str(caught.value)


def assert_names(error_text: str, shape: str, field: str) -> None:
    """Check that a refusal is one line that names the key and the field, and says what the value must be."""
    assert error_text.startswith(f"{key_of(shape)}: "), error_text
    assert field in error_text, error_text
    assert "must" in error_text, error_text
    assert error_text.isprintable(), error_text


# Names


def test_the_code_has_exactly_the_messages_of_the_contract():
    assert sorted(messages.types_by_shape()) == SHAPES


@every_message
def test_names_and_lengths_match_the_contract(shape: str):
    """The contract's fields come first, in its order, and are all encoded; further fields are optional."""
    own, kind = CONTRACT[shape].split(), kind_of(shape)
    info = types.type_info(kind)
    assert isinstance(info, types.StructType)
    assert [field.name for field in info.fields][: 2 + len(own)] == ["t_ns", "seq", *own]
    assert not own or not [field.name for field in info.fields[2 + len(own) :] if field.required]
    plain = msgpack.unpackb(messages.encode(messages.decode(key_of(shape), pack(example(shape)))))
    assert list(plain)[:2] == ["t_ns", "seq"]
    assert set(own) <= set(plain)
    assert {name: len(plain[name]) for name in LENGTHS.keys() & set(own)}.items() <= LENGTHS.items()
    assert messages.encoding(key_of(shape)) == f"application/msgpack;{kind.__name__}"
    assert NAMES.get(shape, kind.__name__) == kind.__name__


@pytest.mark.parametrize(
    "key",
    [
        "_",
        "drone",
        "drone/d",
        "drone/d/sensor",
        "drone/d/sensor/radar",
        "drone/d/cmd/velocity/x",
        "worlds/info",
        "process/p",
        "process/p/outputs",
        "cluster/c/control",
        "world/control",
        "drone//truth/",
        "",
        "x" * 500,
    ],
)
def test_other_keys_have_no_message(key: str):
    assert messages.type_of(key) is None
    assert messages.encoding(key) == "application/msgpack"
    with refused(DecodeError, "not a key") as caught:
        messages.decode(key, b"\x80")
    assert len(str(caught.value)) < 200


# Round trips


@every_type
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_messages_survive_a_round_trip_also_through_plain_msgpack(shape: str, data: st.DataObject):
    """The plain `msgpack` package may unpack a message and pack it again, with its keys in any order."""
    kind = kind_of(shape)
    message = msgspec.convert(data.draw(plain_messages(shape)), kind)
    payload = messages.encode(message)
    again = messages.decode(key_of(shape), payload)
    assert type(again) is kind
    assert again == message
    plain = msgpack.unpackb(payload, strict_map_key=False)
    assert isinstance(plain, dict)
    shuffled = dict(data.draw(st.permutations(list(plain.items()))))
    assert messages.decode(key_of(shape), pack(shuffled)) == message


@every_message
def test_equivalent_encodings_and_extra_fields_are_accepted(shape: str):
    """Integers and 32-bit floats may stand for 64-bit floats, and unknown fields are ignored."""
    plain = whole = example(shape)
    for path, value in leaves(plain):
        whole = replaced(whole, path, 2) if isinstance(value, float) else whole
    extras = (1, None, "x", [1, [2]], {"a": {"b": math.nan}}, b"\xff", 1e300)
    others = [pack(whole), pack(plain, use_single_float=True)]
    others += [pack({"aa_new": extra, **plain, "zz_new": extra}) for extra in extras]
    message = messages.decode(key_of(shape), pack(plain))
    assert all(messages.decode(key_of(shape), other) == message for other in others)


def test_the_default_frame_of_a_velocity_is_heading():
    plain = example("drone/*/cmd/velocity")
    del plain["frame"]
    assert messages.decode("drone/d/cmd/velocity", pack(plain)).frame == "heading"


# Refusals


@every_message
def test_a_missing_required_field_is_refused(shape: str):
    info = types.type_info(kind_of(shape))
    assert isinstance(info, types.StructType)
    for field in info.fields:
        plain = example(shape)
        del plain[field.name]
        if field.required:
            assert has_terms(refusal(shape, pack(plain)), key_of(shape), field.name, "missing")
        else:
            messages.decode(key_of(shape), pack(plain))


WRONG = [None, True, 3, 1.5, "text", [1.0, 2.0], {"a": 1}, b"\x00"]
NOT_FINITE = [math.nan, math.inf, -math.inf]


def fits(value: Any, wrong: Any) -> bool:
    """Return whether the type of `wrong` is valid in place of `value`."""
    if isinstance(value, float):
        return isinstance(wrong, int | float) and not isinstance(wrong, bool)
    return type(wrong) is type(value)


@every_message
def test_a_wrong_type_is_refused(shape: str):
    plain = example(shape)
    for (path, value), wrong in product(leaves(plain), WRONG):
        empty_allowed = path[-1] in NULLABLE and wrong is None
        if fits(value, wrong) or empty_allowed:
            continue
        line = refusal(shape, pack(replaced(plain, path, wrong)))
        assert_names(line, shape, str(path[0]))


@every_message
def test_a_value_outside_an_enumeration_is_refused(shape: str):
    plain = example(shape)
    info = types.type_info(kind_of(shape))
    assert isinstance(info, types.StructType)
    for field in info.fields:
        if isinstance(field.type, types.LiteralType):
            line = refusal(shape, pack({**plain, field.name: "sideways"}))
            assert has_terms(line, key_of(shape), field.name, "'sideways'", *map(str, field.type.values))


@every_message
def test_a_non_finite_number_is_refused(shape: str):
    plain = example(shape)
    floats = [path for path, value in leaves(plain) if isinstance(value, float)]
    for path, number, single in product(floats, NOT_FINITE, (False, True)):
        line = refusal(shape, pack(replaced(plain, path, number), use_single_float=single))
        assert_names(line, shape, str(path[0]))
        assert repr(number) in line


@pytest.mark.parametrize("number", NOT_FINITE, ids=repr)
@pytest.mark.parametrize("wrap", [lambda x: x, lambda x: [1, [x]], lambda x: {"a": {"b": x}}, lambda x: {x: 1}])
def test_a_non_finite_number_in_free_form_content_is_refused(number: float, wrap: Any):
    plain = {**example("world/event"), "data": {"some": wrap(number)}}
    assert_names(refusal("world/event", pack(plain)), "world/event", "data")
    request = pack({"op": "acquire", "args": {"some": wrap(number)}})
    with refused(DecodeError, "here", "args", "finite"):
        messages.decode_as(run_messages.ControlRequest, request, "here")


@every_message
def test_a_list_of_the_wrong_length_is_refused(shape: str):
    plain = example(shape)
    for path, value in branches(plain):
        info = types.type_info(kind_of(shape))
        assert isinstance(info, types.StructType)
        field = next(field for field in info.fields if field.name == path[0])
        fixed = isinstance(field.type, types.TupleType) or path[0] in ("covariance", "sensors", "value", "desired")
        if not fixed or path[0] in FREE:
            continue
        for wrong in (value[:-1], [*value, value[-1]], []):
            line = refusal(shape, pack(replaced(plain, path, wrong)))
            assert_names(line, shape, str(path[0]))


@pytest.mark.parametrize("name", ["names", "value", "desired", "desired_rate"])
def test_a_cluster_state_has_four_values_per_drone(name: str):
    plain = example("cluster/*/state")
    assert len(plain["drones"]) == 2
    line = refusal("cluster/*/state", pack({**plain, name: plain[name][:-1]}))
    assert has_terms(line, "cluster/drone1/state", name, "7", "8")


@every_message
def test_t_ns_and_seq_must_be_non_negative_int64(shape: str):
    for name, wrong in product(("t_ns", "seq"), (-1, -(2**63), 2**63, 2**64 - 1, 0.0)):
        line = refusal(shape, pack({**example(shape), name: wrong}))
        assert has_terms(line, key_of(shape), name, str(wrong))


GARBAGE = [
    b"",
    b"\xc1",
    b"\x80",
    b"\x90",
    b"\xc0",
    b"hello",
    b"\x82\xa4t_ns",
    b"\xdd\xff\xff\xff\xff",
    b"\xdf\xff\xff\xff\xff",
    b"\xc6\xff\xff\xff\xff",
    b"\xdb\xff\xff\xff\xff",
    b"\x81\xa4t_ns\xdd\xff\xff\xff\xff",
    b"\x91" * 100_000,
    b"\x81\xa1x" * 100_000,
    b"\x81\xa4\xff\xff\xff\xff\x01",
    b"\x81\x90\x01",
]


@every_message
def test_garbage_is_refused(shape: str):
    for payload in GARBAGE:
        line = refusal(shape, payload)
        assert line.startswith(f"{key_of(shape)}: ")
        assert len(line) < 400


@every_message
def test_a_header_claiming_more_entries_than_follow_is_refused(shape: str):
    plain = example(shape)
    packed = pack(plain)
    headers = (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdc\xff\xff", b"\xc6\xff\xff\xff\xff")
    for name, header in product(plain, headers):
        marker = pack(name)
        place = packed.index(marker) + len(marker)
        refusal(shape, packed[:place] + header)


def test_an_oversized_payload_is_refused_unread():
    payload = b"\x80" * (messages.PAYLOAD_MAX + 1)
    assert has_terms(refusal("clock", payload), "clock", str(len(payload)), str(messages.PAYLOAD_MAX))


def test_excessive_nesting_in_free_form_content_is_refused():
    payload = pack({**example("world/event"), "data": {}})
    cut = payload.index(b"\xa4data") + 5
    for item in (b"\x91", b"\x81\xa1x"):
        refusal("world/event", payload[:cut] + b"\x81\xa1x" + item * 50_000 + b"\xc0")


@every_type
@settings(max_examples=60, deadline=None)
@given(payload=st.binary(max_size=80))
def test_random_bytes_are_decoded_or_refused(shape: str, payload: bytes):
    judge(shape, payload)


@every_type
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_a_damaged_message_is_decoded_or_refused(shape: str, data: st.DataObject):
    damaged = bytearray(pack(example(shape)))
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, max(0, len(damaged) - 1)))
        how = data.draw(st.sampled_from(["set", "cut", "insert", "drop"]))
        if how == "cut":
            del damaged[place:]
        elif how == "insert":
            damaged[place:place] = data.draw(st.binary(max_size=6))
        elif how == "drop":
            del damaged[place : place + data.draw(st.integers(1, 6))]
        elif damaged:
            damaged[place] = data.draw(st.integers(0, 255))
    judge(shape, bytes(damaged))


def decoded_or_refused(kind: type[msgspec.Struct], payload: bytes, key: str) -> Any:
    try:
        return messages.decode_as(kind, payload, key)
    except DecodeError as error:
        error_text = str(error)
    assert error_text.startswith(f"{key}: ")
    return None


def judge(shape: str, payload: bytes) -> None:
    """Check that a payload is refused with its key, or is a finite message that survives a round trip."""
    key = key_of(shape)
    message = decoded_or_refused(kind_of(shape), payload, key)
    if message is None:
        return
    again = messages.decode(key, messages.encode(message))
    assert again == message
    plain = msgspec.to_builtins(message)
    assert all(math.isfinite(value) for _, value in leaves(plain) if isinstance(value, float))


# Requests and answers


@settings(max_examples=50, deadline=None)
@given(op=text, args=st.dictionaries(text, free, max_size=3), source=text)
def test_requests_survive_a_round_trip(op: str, args: dict[str, Any], source: str):
    request = run_messages.ControlRequest(op, args, source)
    assert messages.decode_as(run_messages.ControlRequest, messages.encode(request), "k") == request


@settings(max_examples=50, deadline=None)
@given(ok=st.booleans(), error=text, result=free, more=st.none() | st.integers(0, 2**63 - 1))
def test_answers_survive_a_round_trip(ok: bool, error: str, result: Any, more: int | None):
    answer = run_messages.ControlAnswer(ok, error, result, more)
    assert messages.decode_as(run_messages.ControlAnswer, messages.encode(answer), "k") == answer


def test_a_request_needs_only_an_op():
    request = messages.decode_as(run_messages.ControlRequest, pack({"op": "pause"}), "world/control")
    assert (request.op, request.args, request.source) == ("pause", {}, "")


@pytest.mark.parametrize(
    ("plain", "terms"),
    [
        ({}, ("op", "missing")),
        ({"op": 1}, ("op", "1")),
        ({"op": "x", "args": []}, ("args", "[]")),
        ({"op": "x", "source": None}, ("source", "null")),
        ([], ("[]",)),
        ("pause", ("'pause'",)),
    ],
)
def test_a_malformed_request_is_refused(plain: Any, terms: tuple[str, ...]):
    with refused(DecodeError, "world/control", *terms):
        messages.decode_as(run_messages.ControlRequest, pack(plain), "world/control")


@settings(max_examples=300, deadline=None)
@given(payload=st.binary(max_size=60))
def test_random_bytes_are_decoded_as_a_request_or_refused(payload: bytes):
    request = decoded_or_refused(run_messages.ControlRequest, payload, "world/control")
    assert request is None or isinstance(request, run_messages.ControlRequest)


@pytest.mark.parametrize("drone", ["d1", "d" * 100], ids=["short", "cut short"])
def test_a_refusal_can_be_worded_without_its_key(drone: str):
    key = f"drone/{drone}/camera/front/info"
    with pytest.raises(DecodeError) as caught:
        messages.decode(key, b"\xc0")
    assert str(caught.value).endswith(f": {messages.fault_at(key, caught.value)}")
    assert "drone/" not in messages.fault_at(key, caught.value)
    assert messages.fault_at(key, ValueError("of another kind")) == "of another kind"
