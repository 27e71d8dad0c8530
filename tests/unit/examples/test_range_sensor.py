"""examples/range_sensor.py: it ends by itself without a world."""

from types import SimpleNamespace
from typing import Any

import msgpack
import pytest
import range_sensor
from range_sensor import ME, RangeSensor, world_info
from refused import refused

INFO = {"run_id": "r", "seed": 1, "gate_ns": 20_000_000, "drones": [{"name": "drone1"}, {"name": "drone2"}]}


class Session:
    """A session on which a world answers with `info`, or not at all, and publishes nothing."""

    def __init__(self, info: dict[str, Any] | None) -> None:
        payload = SimpleNamespace(to_bytes=lambda: msgpack.packb(info))
        self._replies = [SimpleNamespace(ok=SimpleNamespace(payload=payload))] if info else []

    def get(self, *_: Any, **__: Any) -> list[Any]:
        return self._replies

    def declare_subscriber(self, *_: Any) -> None: ...
    def put(self, *_: Any, **__: Any) -> None: ...

    def liveliness(self) -> Any:
        return SimpleNamespace(declare_token=lambda _: None)


def test_a_silent_world_ends_the_sensor_with_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(range_sensor, "SILENCE_S", 0.05)
    with refused(SystemExit, ME, "silent", "0.05", "0", "ranges") as raised:
        RangeSensor(Session(INFO)).run()  # type: ignore[arg-type]
    assert len(str(raised.value).splitlines()) == 1


def test_a_run_without_one_of_the_drones_ends_the_sensor_with_one_line() -> None:
    with refused(SystemExit, ME, "drone2", "drone1"):
        RangeSensor(Session(INFO | {"drones": [{"name": "drone1"}]}))  # type: ignore[arg-type]


def test_a_world_that_never_answers_ends_the_sensor_with_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(range_sensor, "START_S", 0.05)
    with refused(SystemExit, ME, "no", "world", "0.05"):
        world_info(Session(None))  # type: ignore[arg-type]
