"""A minimal `world/info`, and messages of which tests check only time stamp, sequence number and source."""

from collections.abc import Sequence
from typing import Any

from zsim.contract.flight_messages import Estimate, Status
from zsim.contract.messages import ClusterInfo, DroneInfo, Imu, Info, Origin

GATE_NS = 20_000_000
ZEROS = (0.0, 0.0, 0.0)


def run_info(drones: Sequence[str] = (), clusters: Sequence[ClusterInfo] = (), **more: Any) -> Info:
    """Return the info of a lockstep run of AR.Drones at 50 Hz; `more` sets its other fields."""
    plain: dict[str, Any] = {"mode": "lockstep", "rate": 0.0, "gate_ns": GATE_NS, "command_delay_ns": GATE_NS}
    texts = dict.fromkeys(("scenario", "scenario_sha256", "version", "fingerprint"), "")
    stock = {"drones": tuple(DroneInfo(name, "ardrone2") for name in drones), "clusters": tuple(clusters)}
    run = {"t_ns": 0, "seq": 0, "contract": 1, "run_id": "r", "federation": "zsim", "physics_dt_ns": 1, "seed": 1}
    return Info(**{**run, **plain, **texts, **stock, "origin": Origin(*ZEROS), **more})


def imu(t_ns: int, seq: int) -> Imu:
    return Imu(t_ns, seq, t_ns, (0.0, 0.0, 9.8), ZEROS)


def status(t_ns: int, seq: int = 0, count: int = 1) -> Status:
    return Status(t_ns, seq, "flying", 50.0, False, None, count)


def estimate(t_ns: int, seq: int, position_m: tuple[float, float, float] = ZEROS, source: str = "") -> Estimate:
    return Estimate(t_ns, seq, position_m, ZEROS, (1.0, *ZEROS), 0.0, (0.0,) * 36, 0.1, ZEROS, {}, source)
