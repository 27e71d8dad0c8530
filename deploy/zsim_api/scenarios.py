"""A scenario in Python: the same document as in YAML, changed by path, with classes as values, and the same checks."""

import copy
import json
import shutil
from collections.abc import Mapping
from functools import cache, cached_property
from inspect import Parameter, Signature
from pathlib import Path
from typing import Any, Self, get_type_hints

import numpy as np

from zsim.errors import ScenarioError
from zsim.output_folder import temporary_folder
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario as Resolved
from zsim.schema import plugin, yaml_file
from zsim.schema.checker import suggestion
from zsim_agents.hosting import check_classes, check_plans


class Scenario:
    """An immutable scenario.

        zsim.Scenario.load("step.yaml").with_({"environment.wind.gust_m_s": 1.0}, seed=3)
        zsim.Scenario(name="pair", duration_s=20, drones=[{"name": "drone1", "position_m": [0, 0, 0]}])

    It is checked as a whole when it is flown, or when `resolved` is read.

    Args:
        fields: top-level fields, with maps and lists as in YAML; docs/scenario.md lists them all.
    """

    def __init__(self, **fields: Any) -> None:
        self._document: dict[str, Any] = copy.deepcopy(fields)
        self.source = "scenario"  # its origin, as named in error messages
        self.folders: tuple[Path, ...] = (Path.cwd(),)  # folders searched for the modules that it names
        self.changes: tuple[str, ...] | None = None  # overrides `a.b.c=value` applied to its file; None without one

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return the scenario in a YAML file; raise ScenarioError if it cannot be read."""
        path = Path(path)
        scenario = cls(**yaml_file.read(path, scenario_file.EXAMPLE, ScenarioError))
        scenario.source, scenario.folders, scenario.changes = path.name, (path.parent,), ()
        return scenario

    def with_(self, set: Mapping[str, Any] = {}, /, **fields: Any) -> Self:
        """Return the scenario with changed values.

        Args:
            set: values by path, `{"drones.drone2.mass_kg": 0.5}`; where a class is named, the class itself is accepted.
            fields: top-level fields.

        Raises:
            ScenarioError: with a line for each path that does not exist.
        """
        changed = copy.copy(self)
        changed.__dict__.pop("resolved", None)
        changed._document = document = copy.deepcopy(self._document)
        faults: list[str] = []
        for path, raw in {**fields, **set}.items():
            value = changed.named(raw)
            if fault := scenario_file.apply_override(document, f"{path}=", lambda _, value=value: copy.deepcopy(value)):
                faults.append(fault.replace("--set ", "", 1))
            elif changed.changes is not None:
                changed.changes = (*changed.changes, f"{path}={value if isinstance(value, str) else json.dumps(value)}")
        if faults:
            raise ScenarioError([f"{self.source}: {line}" for line in faults])
        return changed

    def changed(
        self,
        seed: int | None = None,
        duration_s: float | None = None,
        set: Mapping[str, Any] | None = None,
        law: type | None = None,
        estimator: type | None = None,
    ) -> Self:
        """Return the scenario as changed by these arguments of `zsim.run`."""
        values = dict(set or {})
        values |= {k: v for k, v in (("seed", seed), ("duration_s", duration_s)) if v is not None}
        if estimator is not None:
            values["estimation.algorithm"] = estimator
        if law is not None:
            values |= {f"clusters[{i}].law": law for i in range(len(self._document.get("clusters") or ()))}
        return self.with_(values) if values else self

    @cached_property
    def resolved(self) -> Resolved:
        """The scenario with all defaults, as it is flown; raises ScenarioError with a line for every fault."""
        self.search()
        scenario = scenario_file.resolve(self._document, self.source)
        check_classes(scenario, self.source)
        check_plans(scenario, self.source)
        return scenario

    def search(self) -> None:
        """Have the scenario's folders searched for modules, in this process and in those that it starts."""
        plugin.search(*self.folders)

    def keep_modules(self, folder: Path) -> None:
        """Copy the modules of notebook classes that the scenario names to a run's folder, for `zsim rerun`."""
        for name in self.resolved.own_code():
            file = scratch_folder() / f"{name.partition(':')[0]}.py"
            if file.exists():
                shutil.copy(file, folder)

    def __getitem__(self, path: str) -> Any:
        """Return the value at a path as it is flown, with maps and lists as in YAML: `s["environment.wind.gust_m_s"]`.

        Raises:
            ScenarioError: the path does not exist, or the scenario has faults.
        """
        values = _by_path(self._whole)
        if path not in values:
            raise ScenarioError(
                [f"{self.source}: {path} is not known; {suggestion(path, [*values])}see docs/scenario.md"]
            )
        return copy.deepcopy(values[path])

    def _ipython_key_completions_(self) -> list[str]:
        """Return all paths, with which notebooks complete `scenario["…`."""
        return [*_by_path(self._whole)]

    @property
    def _whole(self) -> dict[str, Any]:
        return yaml_file.value(scenario_file.to_text(self.resolved))

    def document(self) -> dict[str, Any]:
        """Return a copy of the document, as in YAML."""
        return copy.deepcopy(self._document)

    def to_yaml(self) -> str:
        """Return the document as YAML text."""
        return yaml_file.dump(self._document)

    def save(self, path: str | Path) -> None:
        """Write the document as a YAML file."""
        Path(path).write_text(self.to_yaml(), encoding="utf-8")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Scenario) and (self._document, self.folders) == (other._document, other.folders)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        drones = self._document.get("drones")
        count = len(drones) if isinstance(drones, list) else 0
        return f"<Scenario {self._document.get('name')!r} of {self.source}, {count} drones>"

    def named(self, value: Any) -> Any:
        """Return a value with names in place of classes and functions; add their modules' folders to `folders`."""
        if callable(value):
            from zsim_api.own_code import module_folders, name_of

            name = name_of(value, scratch_folder())
            self.folders = tuple(dict.fromkeys((*self.folders, *module_folders([name]))))
            return name
        if isinstance(value, Mapping):
            return {key: self.named(each) for key, each in value.items()}
        if isinstance(value, list | tuple):
            return [self.named(each) for each in value]
        return value.item() if isinstance(value, np.generic) else value


def _by_path(values: Any, path: str = "") -> dict[str, Any]:
    """Return all values by path; a list entry is found under its name, and omitted if it has none."""
    result = {path: values} if path else {}
    parts: dict[str, Any] = values if isinstance(values, dict) else {}
    if isinstance(values, list):
        parts = {each["name"]: each for each in values if isinstance(each, dict) and "name" in each}
    for name, each in parts.items():
        result |= _by_path(each, f"{path}.{name}" if path else name)
    return result


# Lets editors complete the fields and show their declared types.
_OWN = [Parameter(name, Parameter.KEYWORD_ONLY, annotation=kind) for name, kind in get_type_hints(Resolved).items()]
setattr(Scenario, "__signature__", Signature(_OWN))  # noqa: B010
_SELF = [Parameter("self", Parameter.POSITIONAL_ONLY), Parameter("set", Parameter.POSITIONAL_ONLY, default={})]
setattr(Scenario.with_, "__signature__", Signature([*_SELF, *_OWN]))  # noqa: B010

AnyScenario = str | Path | Mapping[str, Any] | Scenario | Resolved


def scenario_of(given: AnyScenario) -> Scenario:
    """Return a Scenario, given a path, a mapping as in YAML, a Scenario, or a resolved scenario."""
    if isinstance(given, Scenario):
        return given
    if isinstance(given, Resolved):
        return Scenario(**yaml_file.value(scenario_file.to_text(given)))
    if isinstance(given, Mapping):
        return Scenario(**given)
    return Scenario.load(given)


@cache
def scratch_folder() -> Path:
    """Return this process's temporary folder for modules of notebook classes that are not yet in a run's folder."""
    return temporary_folder("modules-")
