"""Records of synthetic flights, with errors known in closed form."""

import math
import pickle
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.record import RecordWriter
from zsim.scenario import scenario_file
from zsim.schema.message import Message
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_analysis.reading.recorded_flight import FlightReader, RecordedFlight

GATE_NS = 20_000_000
SCENARIOS = Path(__file__).parents[2] / "scenarios"
Entries = Iterable[tuple[str, Any, int]]
"""Key, message and wall time [ns] of all messages of a run."""


@dataclass
class Flown:
    """A synthetic flight in which a cluster follows its desired values.

    Attributes:
        duration_s: last instant.
        amplitude: (4n,) amplitude of the true error, a sine with period `period_s`.
        offset: (4n,) mean of the true error.
        est_amplitude: (4n,) amplitude of estimate − desired, the same sine.
        other_traffic: whether to include sensors, estimates and commands, as in a real run.
    """

    duration_s: float = 30.0
    scenario: str = "step"
    overrides: tuple[str, ...] = ()
    amplitude: np.ndarray = field(default_factory=lambda: np.zeros(12))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(12))
    est_amplitude: np.ndarray = field(default_factory=lambda: np.zeros(12))
    period_s: float = 2.0
    climb_s: float = 0.0
    noise: float = 0.0
    other_traffic: bool = False
    end: dict[str, Any] | None = field(default_factory=lambda: {"reason": "duration reached"})
    events: tuple[run_messages.Event, ...] = ()


def write(path: Path, flown: Flown) -> None:
    """Write the record of a flight."""
    record(path, traffic(flown))


def record(path: Path, entries: Entries) -> None:
    """Write a record of messages."""
    with RecordWriter(path) as writer:
        for key, message, wall_ns in entries:
            writer.add(key, messages.encode(message), messages.encoding(key), message.t_ns, wall_ns)


def flight(entries: Entries, answers: bool = False) -> RecordedFlight:
    """Return the flight read from messages; with `answers`, including estimates and commands."""
    reader = FlightReader(answers)
    for key, message, wall_ns in entries:
        reader.add_message(key, message, wall_ns)
    return reader.flight()


def traffic(flown: Flown) -> Iterator[tuple[str, Message, int]]:
    """Yield key, message and wall time [ns] of all messages of a flight."""
    yield from _flight(pickle.dumps(replace(flown, end=None, events=())))
    last = round(flown.duration_s * 1e9) // GATE_NS
    for event in flown.events:
        yield keys.EVENT, event, 1_000_000 * last
    if flown.end is not None:
        event = run_messages.Event(last * GATE_NS, len(flown.events), "end", "world", "world", "the end", flown.end)
        yield keys.EVENT, event, 1_000_000 * last


@lru_cache(maxsize=4)
def _flight(pickled: bytes) -> list[tuple[str, Message, int]]:
    """Return a flight's messages except events; cached because many tests use the same flight."""
    flown = pickle.loads(pickled)
    scenario = scenario_file.load(SCENARIOS / f"{flown.scenario}.yaml", flown.overrides)
    entries: list[tuple[str, Message, int]] = [(keys.INFO, info(scenario), 0)]
    for seq, name in enumerate(["estimator.drone1", "controller.main"]):
        join = run_messages.Join(0, seq, "run", 7, name.split(".")[0], "host-a", 100 + seq, GATE_NS, "0.1.0", "f" * 16)
        entries.append((keys.process(name, "join"), join, 0))
    rng, space = np.random.default_rng(1), cluster_space(3)
    for k in range(round(flown.duration_s * 1e9) // GATE_NS + 1):
        entries += [(*each, 1_000_000 * k) for each in _gate(flown, scenario, space, k, rng)]
    return entries


def info(scenario) -> messages.Info:
    text = scenario_file.to_text(scenario)
    return messages.Info(
        t_ns=0,
        seq=0,
        contract=1,
        run_id="run",
        federation="zsim",
        mode="lockstep",
        rate=0.0,
        gate_ns=GATE_NS,
        physics_dt_ns=2_500_000,
        command_delay_ns=GATE_NS,
        seed=scenario.seed,
        origin=messages.Origin(-34.6, -58.4, 25.0),
        drones=tuple(
            messages.DroneInfo(drone.name, drone.model, body="external" if drone.is_external else messages.UNSET)
            for drone in scenario.drones
        ),
        clusters=tuple(messages.ClusterInfo(c.name, tuple(c.drones)) for c in scenario.clusters),
        scenario=text,
        scenario_sha256=scenario_file.sha256(text),
        version="0.1.0",
        fingerprint="f" * 16,
    )


def desired_at(flown: Flown, t_s: float) -> np.ndarray:
    """Return c_des (12,) of the paper's tests, which begins with a climb if `climb_s` is not 0."""
    rise = min(1.0, t_s / flown.climb_s) if flown.climb_s else 1.0
    if flown.scenario == "step":
        return np.array([5, -5, 15 * rise, 0, 0, math.pi / 2, 0, 0, 0, 4, 4, math.pi / 4])
    w = 2 * math.pi * 0.01 * t_s
    x, y, z = 5 * math.cos(w), -5 * (1 + 0.5 * math.sin(2 * w)), rise * (15 + 2.5 * (1 - math.cos(1.5 * w)))
    return np.array([x, y, z, 0, 0, 0.1 * t_s, 0, 0, 0, 4, 4, math.pi / 4])


def true_at(flown: Flown, t_s: float) -> np.ndarray:
    """Return the true cluster variables (12,)."""
    wave = math.sin(2 * math.pi * t_s / flown.period_s)
    return desired_at(flown, t_s) + flown.offset + flown.amplitude * wave


def _gate(
    flown: Flown, scenario, space: ClusterSpace, k: int, rng: np.random.Generator
) -> Iterator[tuple[str, Message]]:
    t_ns, t_s = k * GATE_NS, k * GATE_NS / 1e9
    desired = desired_at(flown, t_s)
    wave = math.sin(2 * math.pi * t_s / flown.period_s)
    p_W, yaw = space.inverse(true_at(flown, t_s) + flown.noise * rng.standard_normal(12))
    for i, drone in enumerate(scenario.drones):
        if flown.other_traffic:
            yield from _sensors(drone.name, t_ns, k, rng)
        yield keys.truth(drone.name), _truth(t_ns, k, p_W[i], yaw[i])
        state = "landed" if t_s < 0.1 * flown.climb_s else "taking_off" if t_s < 0.2 * flown.climb_s else "flying"
        yield keys.status(drone.name), flight_messages.Status(t_ns, k, state, 100 - t_s / 20 - i, False, None, 5)
        if flown.other_traffic:
            yield from _answers(drone.name, t_ns, k, p_W[i].tolist(), rng)
    yield keys.CLOCK, run_messages.Clock(t_ns, k, "run", k, "running", 1.0)
    if scenario.clusters:
        value = space.wrapped(desired + flown.est_amplitude * wave + flown.noise * rng.standard_normal(12))
        state = flight_messages.ClusterState(
            t_ns=t_ns,
            seq=k,
            phase="engaged",
            drones=tuple(drone.name for drone in scenario.drones),
            names=space.names,
            value=tuple(value.tolist()),
            desired=tuple(desired.tolist()),
            desired_rate=(0.0,) * 12,
            trajectory_t_s=None,
            margin=1.0,
            reason="",
        )
        yield keys.cluster_state("main"), state


def _truth(t_ns: int, seq: int, p_W: np.ndarray, yaw: float) -> flight_messages.Truth:
    x, y, z = p_W.tolist()
    q_WB = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
    return flight_messages.Truth(
        t_ns, seq, (x, y, z), (0.1, 0.2, 0.3), q_WB, (0.4, 0.5, 0.6), (0.0, 0.0, 0.0), (3.0, 3.0, 3.0, 3.0)
    )


def _sensors(name: str, t_ns: int, k: int, rng: np.random.Generator) -> Iterator[tuple[str, Message]]:
    """Yield IMU samples at 200 Hz and samples of slow sensors at 25 Hz, about as many as in a real run."""
    for part in range(4):
        a, b, c, d, e, f = rng.standard_normal(6).tolist()
        yield keys.sensor(name, "imu"), messages.Imu(t_ns, 4 * k + part, t_ns, (a, b, c), (d, e, f))
    if k % 2 == 0:
        yield (
            keys.sensor(name, "baro"),
            messages.Baro(t_ns, k // 2, t_ns, 101_325.0, float(rng.standard_normal())),
        )
        yield (
            keys.sensor(name, "mag"),
            messages.Mag(t_ns, k // 2, t_ns, (1.0, 2.0, float(rng.standard_normal()))),
        )


def _answers(name: str, t_ns: int, k: int, p_W: list[float], rng: np.random.Generator) -> Iterator[tuple[str, Message]]:
    x, y, z = p_W
    covariance = tuple(rng.standard_normal(36).tolist())
    yield (
        keys.estimate(name),
        flight_messages.Estimate(
            t_ns,
            k,
            (x, y, z),
            (0.0, 0.0, 0.0),
            (1.0, 0.0, 0.0, 0.0),
            0.0,
            covariance,
            0.1,
            (0.0, 0.0, 0.0),
            {},
        ),
    )
    yield keys.command(name, "velocity"), flight_messages.Velocity(t_ns, k, "controller.main", (0.1, 0.2, 0.3), 0.0)
    yield keys.process(f"estimator.{name}", "done"), run_messages.Done(t_ns, k, "run", 7, t_ns, 1)
