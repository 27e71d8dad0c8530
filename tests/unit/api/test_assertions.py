"""The assertions that users' tests make about a run, and their messages."""

from pathlib import Path
from typing import Any

import pytest

import zsim
from zsim.errors import RunError
from zsim_api.assertions import Assertions
from zsim_api.recorded import Run

PAIR: dict[str, Any] = {
    "name": "pair",
    "seed": 3,
    "duration_s": 10,
    "drones": [
        {"name": "drone1", "position_m": [1, 0, 0], "yaw_deg": 90},
        {"name": "drone2", "position_m": [-1, 0, 0], "yaw_deg": 90},
    ],
    "clusters": [{"name": "main", "drones": ["drone1", "drone2"], "plan": {"takeoff_s": 0.5}}],
}


class Recorded(Assertions):
    def __init__(self, run: Run) -> None:
        self._run = run

    def run(self) -> Run:
        return self._run


class Together(zsim.Agent):
    """An agent that makes two drones collide."""

    def receive(self, key: str, message: Any) -> None: ...

    def step(self, t_ns: int) -> list[Any]:
        if t_ns == 20_000_000:
            return [self.command(t_ns, drone, zsim.takeoff()) for drone in ("drone1", "drone2")]
        if t_ns < 4e9:
            return []
        towards = {"drone1": -1.0, "drone2": 1.0}
        return [self.command(t_ns, drone, zsim.velocity(v, 0, 0, frame="world")) for drone, v in towards.items()]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return Recorded(zsim.run(PAIR, out=tmp_path_factory.mktemp("flown") / "run", progress=False))


def test_formation_errors_are_asserted_within_the_window(flown: Recorded) -> None:
    formation = flown.run().judged_formation()
    rms = formation.errors((8, 10))["p"].true_rms
    assert rms is not None
    flown.assert_errors(p=rms, window=(8, 10))
    with pytest.raises(AssertionError, match=rf"8 to 10 s.* p is {rms:.3g} m; .*0\.001;"):
        flown.assert_errors(p=0.001, window=(8, 10))
    with pytest.raises(AssertionError, match=r"main .* [1-9]\d%"):
        flown.assert_errors(p=100, window=(4, 8))
    with pytest.raises(AssertionError, match="ended at 10 s"):
        flown.assert_errors(p=100, window=(8, 99))
    with pytest.raises(AssertionError, match=r"main .* 0%"):
        flown.assert_errors(p=100, window=(0, 1))
    with pytest.raises(RunError, match=r"'length'; .*x_c, y_c, z_c"):
        flown.assert_errors(length=1)


def test_the_absence_of_collisions_is_asserted(flown: Recorded, tmp_path: Path) -> None:
    flown.assert_no_collision()
    alone = {**PAIR, "clusters": [], "processes": {"expect": []}}
    met = zsim.run(alone, agents=[Together()], out=tmp_path / "met", progress=False)
    with pytest.raises(AssertionError, match=r"drone[12] and drone[12] collide, at [45]\.\d\d s"):
        Recorded(met).assert_no_collision()


def test_bitwise_identity_of_runs_is_asserted(flown: Recorded, tmp_path: Path) -> None:
    def other(name: str, **change: Any) -> Run:
        return zsim.run(PAIR, out=tmp_path / name, progress=False, **change)

    flown.assert_same_bits(flown)
    flown.assert_same_bits(flown.run().folder)
    with pytest.raises(AssertionError, match=r"other run ends, .*5\.02 s"):
        flown.assert_same_bits(other("shorter", duration_s=5))
    gust = {"kind": "gust", "target": "world", "at_s": 3, "for_s": 1, "velocity_m_s": [1, 0, 0]}
    with pytest.raises(AssertionError, match=r"differs .* drone1 at 3\.0[24]0 s by .* m, .* m/s"):
        flown.assert_same_bits(other("gust", duration_s=4, set={"faults": [gust]}))
