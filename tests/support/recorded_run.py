"""The record of a real run, with messages of every type of the contract."""

from pathlib import Path
from typing import Any

import msgspec
from msgspec import inspect
from synthetic_pictures import jpeg

from zsim.contract import messages
from zsim.record import RecordReader, RecordWriter
from zsim.scenario import scenario_file
from zsim.sensors.scanner import Depth, Lidar
from zsim_analysis.in_process import fly

SCENARIO: dict[str, Any] = {
    "name": "trio",
    "seed": 3,
    "duration_s": 6,
    "sensors": {"preset": "paper"},
    "environment": {"wind": {"gust_m_s": 0.3}},
    "drones": [
        {"name": "drone1", "position_m": [2, 0, 0], "yaw_deg": 90},
        {"name": "a-b.c", "position_m": [-2, 0, 0], "yaw_deg": 90},
        {"name": "end", "position_m": [0, 3, 0], "yaw_deg": 90},
    ],
    "clusters": [{"name": "main", "drones": ["drone1", "a-b.c", "end"], "plan": {"takeoff_s": 0.5}}],
}
FLUSH_EVERY = 700  # messages per chunk; an unpaced run would have few chunks of its own


def write(path: Path) -> None:
    """Record a flight of six seconds in many chunks, with a message of each type that it does not publish itself."""
    flown = path.with_name("flown.mcap")
    fly(scenario_file.resolve(SCENARIO), flown, run_id="run")
    with RecordReader(flown) as reader, RecordWriter(path) as writer:
        there, last_ns, wall_ns = {messages.type_of(key) for key in reader.topics()}, 0, 0
        for count, message in enumerate(reader.messages(by_time=False), start=1):
            writer.add(message.key, message.payload, messages.encoding(message.key), message.t_ns, message.wall_ns)
            last_ns, wall_ns = message.t_ns, message.wall_ns
            if count % FLUSH_EVERY == 0:
                writer.flush()
        for shape, kind in messages.types_by_shape().items():
            if kind not in there:
                key = shape.replace("*", "drone1" if shape.startswith("drone/") else "main")
                writer.add(key, payload(kind, last_ns), messages.encoding(key), last_ns, wall_ns)
        writer.add("own/thing", msgspec.msgpack.encode({"t_ns": last_ns, "x": [1, 2]}), "", last_ns, wall_ns)
        writer.add("own/noise", b"\xc1\x00", "", last_ns, wall_ns)


def payload(kind: type[msgspec.Struct], t_ns: int) -> bytes:
    """Return an encoded message of a type with a value in each field."""
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    values = {field.name: _some(field.type) for field in info.fields}
    if kind in (Lidar, Depth):
        values["ranges_m" if kind is Lidar else "depth_m"] = bytes(4 * 7 * 7)  # float32, 7 rows and 7 columns
    return msgspec.msgpack.encode({**values, "t_ns": t_ns, "seq": 0})


def _some(info: inspect.Type) -> Any:
    if isinstance(info, inspect.LiteralType):
        return info.values[0]
    if isinstance(info, inspect.TupleType):
        return [_some(each) for each in info.item_types]
    if isinstance(info, inspect.VarTupleType | inspect.ListType):
        return [_some(info.item_type)] * max(info.min_length or 0, 1)
    if isinstance(info, inspect.DictType):
        return {"one": _some(info.value_type)}
    if isinstance(info, inspect.StructType):
        return {field.name: _some(field.type) for field in info.fields}
    if isinstance(info, inspect.UnionType):
        return _some(info.types[0])
    simple = {inspect.BoolType: True, inspect.StrType: "text", inspect.IntType: 7, inspect.FloatType: 1.5}
    return {**simple, inspect.BytesType: jpeg()}.get(type(info), 7)


def messages_on(run: Path, key: str) -> list[Any]:
    """Return the messages on a key in the record of a run."""
    with RecordReader(run / "run.mcap") as reader:
        return [messages.decode(key, message.payload) for message in reader.messages({key})]
