"""Fields of a scenario as a reader knows them: sensors.gps.position_m.noise is the "GPS position noise" in m. Pure."""

import re

from msgspec import Struct

from zsim_agents.formation.spaces.cluster_space import unit as unit_of_variable

UNITS = {  # by the end of a name, longer ones first
    "_kg_m2": "kg m²",
    "_kg_m3": "kg/m³",
    "_nm_s2": "N m s²",
    "_rad_s": "rad/s",
    "_deg_s": "deg/s",
    "_n_s_m": "N s/m",
    "_n_s2": "N s²",
    "_1_s2": "1/s²",
    "_m_s2": "m/s²",
    "_percent": "%",
    "_1_s": "1/s",
    "_m_s": "m/s",
    "_px2": "px²",
    "_deg": "deg",
    "_rad": "rad",
    "_mah": "mAh",
    "_px": "px",
    "_kg": "kg",
    "_hz": "Hz",
    "_ms": "ms",
    "_ut": "µT",
    "_m": "m",
    "_s": "s",
}
OF_CHANNEL = {  # units: zsim.sensors
    "noise": "",
    "density": "/√Hz",
    "bias": "",
    "bias_walk": "/√s",
    "bias_instability": "",
    "quantum": "",
}
SECTIONS = ("environment", "sensors", "drones", "clusters", "metrics")  # what stands in them names itself
WORDS = {
    "gps": "GPS",
    "imu": "IMU",
    "mag": "magnetometer",
    "baro": "barometer",
    "accel": "accelerometer",
    "gyro": "gyroscope",
    "takeoff": "take-off",
}
OF_VARIABLES = ("target", "values", "expressions")  # maps of a plan, by the variables of its cluster
_STEP = re.compile(r"([^.\[\]]+)|\[([^\[\]]+)\]")  # as in zsim.scenario.scenario_file


class FieldName(Struct, frozen=True):
    """Words and unit of a field; no unit where it has none."""

    words: str
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.words} ({self.unit})" if self.unit else self.words

    def at(self, value: str) -> str:
        """Return the field with a value of it in short, e.g. "wind gust 1.5 m/s"."""
        return f"{self.words} {value}{f' {self.unit}' if self.unit else ''}"


def field_name(path: str) -> FieldName:
    """Return the name of a field of a scenario, or of a column `metrics.NAME`, by its path from the top."""
    steps = [word or bracket for word, bracket in _STEP.findall(path)] or [path]
    kept = steps[1:] if steps[0] in SECTIONS and len(steps) > (1 if steps[0] == "metrics" else 2) else steps
    kept = [f"{steps[0].removesuffix('s')} {kept[0]}", *kept[1:]] if kept[0].isdigit() else kept
    parted = [_parted(step) for step in kept]
    if steps[0] == "clusters" and "plan" in steps[2:-2] and steps[-2] in OF_VARIABLES:
        parted[-1] = _variable(steps[-1])
    unit = parted[-1][1]
    if kept[-1] in OF_CHANNEL and len(kept) > 1 and parted[-2][1]:
        unit = parted[-2][1] + OF_CHANNEL[kept[-1]]
    return FieldName(" ".join(words for words, _ in parted), unit)


def _variable(name: str) -> tuple[str, str]:
    """Return name and unit of a variable of a cluster: angles are in rad, in deg where their name ends so."""
    return (name[:-4], "deg") if name.endswith("_deg") else (name, unit_of_variable(name))


def _parted(step: str) -> tuple[str, str]:
    """Return the words and the unit of one step."""
    end = next((end for end in UNITS if step.endswith(end) and step != end), "")
    words = step.removesuffix(end).split("_")
    return " ".join(WORDS.get(word, word) for word in words), UNITS.get(end, "")
