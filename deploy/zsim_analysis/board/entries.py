"""What a board flies: laws by name, scenarios by name, and the scenario document of one law in one of them.

A law is `cluster_space`, the stock controller with a template; one of `zsim.scenario.scenario.LAWS`; or a subclass of
`zsim_agents.laws.pilot.Pilot` of a user's, `package.module:Class`. All fly the same drones from the same places with
the same sensors, wind and seeds; a law has the parameters that are its defaults.
"""

import copy
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import yaml

from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import LAWS, Scenario
from zsim_agents.laws.pilot import polygon

CLUSTER_SPACE = "cluster_space"
LAW_NAMES = (CLUSTER_SPACE, *LAWS)
PILOT, CONTROLLER = "pilot", "main"


@cache
def shipped() -> Mapping[str, Any]:
    return yaml.safe_load(files("zsim_analysis.board").joinpath("scenarios.yaml").read_text(encoding="utf-8"))


def scenario_names() -> list[str]:
    return [*shipped()["scenarios"]]


def about(scenario: str) -> str:
    return shipped()["scenarios"][scenario]["about"]


def chosen(given: str | None, known: Sequence[str], option: str, open_to_classes: bool = False) -> list[str]:
    """Return the names of a list with commas, each once; all that are known for None.

    Raises:
        ScenarioError: with a line for each that is unknown.
    """
    names = [*dict.fromkeys(name.strip() for name in given.split(",") if name.strip())] if given else [*known]
    allowed = f"must be of {', '.join(known)}{', or package.module:Class' if open_to_classes else ''}"
    unknown = [name for name in names if name not in known and not (open_to_classes and ":" in name)]
    if not names:
        raise ScenarioError([f"{option} is {given!r}; {allowed}"])
    if unknown:
        raise ScenarioError([f"{option} has {name!r}; {allowed}" for name in unknown])
    return names


def resolved(law: str, scenario: str, seed: int) -> Scenario:
    """Return the scenario of a flight; ScenarioError: a user's class cannot be flown."""
    return scenario_file.resolve(document(law, scenario, seed), f"board, {law} in {scenario}")


def document(law: str, scenario: str, seed: int) -> dict[str, Any]:
    """Return the scenario of a law, as a file holds it."""
    entry, flight = shipped()["scenarios"][scenario], shipped()["flight"]
    found = copy.deepcopy(shipped()["base"])
    found |= {"name": f"board-{scenario.replace('_', '-')}", "seed": seed, "report": {"window_s": entry["window_s"]}}
    for path, value in entry.get("set", {}).items():
        *sections, last = path.split(".")
        inner = found
        for section in sections:
            inner = inner.setdefault(section, {})
        inner[last] = copy.deepcopy(value)
    names = [drone["name"] for drone in found["drones"]]
    lost = entry.get("radio", {}).get("loss", 0.0)
    if law == CLUSTER_SPACE:
        found["clusters"] = [_cluster(names, entry["centre_m"], flight)]
        links = [f"estimator.{name}/controller.{CONTROLLER}" for name in names] + [f"world/controller.{CONTROLLER}"]
        losses = [{"kind": "link_loss", "target": link, "probability": lost} for link in links] if lost else []
        found["faults"] = [*found.get("faults", []), *losses]
        return found
    parameters = {"takeoff_s": flight["takeoff_s"], "height_m": flight["height_m"], "start_s": flight["start_s"]}
    found["agents"] = {PILOT: {"class": law, "parameters": {**parameters, "centre_m": entry["centre_m"]}}}
    if lost:
        found["radio"] = {"loss": lost}
    return found


def _cluster(names: list[str], centre_m: list[float | str], flight: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cluster that flies the same: a template of the pentagon, gathered, then led along the centre."""
    places = [[*place, 0.0] for place in polygon(len(names), flight["radius_m"]).tolist()]
    start = {"x_c": 0, "y_c": 0, "z_c": flight["height_m"], "yaw": 0}
    expressions = {"x_c": centre_m[0], "y_c": centre_m[1]}
    trajectory = {"start_s": flight["start_s"], "expressions": expressions}
    plan = {"takeoff_s": flight["takeoff_s"], "target": start, "trajectory": trajectory}
    return {"name": CONTROLLER, "drones": names, "space": "template", "template_m": places, "plan": plan}
