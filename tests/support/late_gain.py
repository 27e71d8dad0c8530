"""A control law with a defect: one of its gains is wrong, in a combination of gust, GPS dropout and late link only."""

from typing import Any

import numpy as np

from zsim.contract.snapshot import State
from zsim.sensors.stock_sensors import Gps
from zsim_agents.formation.control_law import ProportionalLaw
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_analysis.reading.recorded_flight import RecordedFlight

VICTIM = 1  # its place in the cluster
USUAL_S, USUAL_M_S = 0.2, 0.1  # age of the newest sample of a GPS at 5 Hz, and velocity of a formation that holds
DOUBTFUL = 0.004  # s^2 m/s, product of the doubts beyond which the gain has the wrong sign
HELD_S, LOST_M = 6.0, 4.0
WRONG = -6.0  # the least factor of the gain


class LateGain(ProportionalLaw):
    """Weakens the gain of one drone where its position is doubtful: by the product of three doubts, beyond 0.

    Doubtful is what is pushed (mean velocity of the drones), blind (no GPS) and late (age of the others' samples). The
    greatest doubt lasts until the drone has GPS again.
    """

    def reset(self) -> None:
        super().reset()
        self.doubt = 0.0

    def snapshot(self) -> State:
        return {**super().snapshot(), "doubt": self.doubt}

    def restore(self, state: State) -> None:
        super().restore(state)
        self.doubt = state["doubt"]

    def rates(self, c: Array, p_W: Array, v_W: Array, c_des: Array, c_dot_des: Array) -> Array:
        rates = super().rates(c, p_W, v_W, c_des, c_dot_des)
        samples = self.samples("gps", Gps)
        ages_s = [(self.now_ns - each.t_sample_ns) / 1e9 for each in samples if each is not None]
        if len(ages_s) == len(samples):
            late_s = max(min(age_s for place, age_s in enumerate(ages_s) if place != VICTIM) - USUAL_S, 0.0)
            blind_s = max(ages_s[VICTIM] - min(ages_s), 0.0)
            pushed_m_s = max(float(np.linalg.norm(np.mean(v_W[:, :2], axis=0))) - USUAL_M_S, 0.0)
            self.doubt = max(self.doubt, late_s * blind_s * pushed_m_s / DOUBTFUL) if blind_s else 0.0
            rates[4 * VICTIM : 4 * VICTIM + 3] *= max(1.0 - self.doubt**3, WRONG)
        return rates


def kept(flight: RecordedFlight) -> float:
    """Return how much farther [m] a drone may still stray, of LOST_M from where it was when the formation held."""
    strayed_m = []
    for track in flight.tracks:
        held = track.t_ns >= HELD_S * 1e9
        strayed_m.append(float(np.linalg.norm(track.p_W[held] - track.p_W[held][0], axis=1).max()))
    return LOST_M - max(strayed_m)


SCENARIO: dict[str, Any] = {
    "name": "late_gain",
    "seed": 1,
    "duration_s": 16,
    "time": {"command_delay_gates": 5},
    "sensors": {"preset": "paper"},
    "drones": [
        {"name": "drone1", "position_m": [3.0, 0.0, 0.0], "yaw_deg": 90},
        {"name": "drone2", "position_m": [-3.0, 0.0, 0.0], "yaw_deg": 90},
    ],
    "clusters": [
        {
            "name": "main",
            "drones": ["drone1", "drone2"],
            "law": "late_gain:LateGain",
            "law_sensors": ["gps"],
            "plan": {"takeoff_s": 0.5},
        }
    ],
    "report": {"window_s": [6, 16]},
}
WIND = "wind.gust_m_s=uniform(0, 0.3)"
SPACE = (  # what is drawn for it, each of which the stock law stands
    "gust velocity_m_s=0..6 for_s=1..5 at_s=5..12",
    "gps_dropout target=drone2 probability=1 for_s=1..8 at_s=5..12",
    "link_delay target=controller.main/world delay_ms=10..60 for_s=1..8 at_s=5..12",
    "mag_noise factor=2..5",
    "baro_bias value_m=-1..1",
    "sonar_stuck",
)
