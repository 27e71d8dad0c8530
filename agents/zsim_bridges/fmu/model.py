"""An FMU, a functional mock-up unit of FMI 2 or 3 for co-simulation: opened, checked, and stepped by FMPy.

    model = FmuModel(Path("controller.fmu"))       what its description says
    unit = FmuInstance(model, "fmu.drone1", say)   its library, loaded into this process
    unit.start(0.0, [(variable, [1.0])])
    unit.step(0.0, 0.02)
    unit.read([variable])

A refused file raises a RunError; a fault of a running FMU raises a UserCodeError.
"""

import math
import weakref
import zipfile
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from ctypes import byref
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, NamedTuple

import fmpy
from fmpy import calloc, free
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import (
    FMU2Slave,
    fmi2CallbackAllocateMemoryTYPE,
    fmi2CallbackFreeMemoryTYPE,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
)
from fmpy.fmi3 import FMU3Slave
from fmpy.logging import addLoggerProxy
from fmpy.model_description import ValidationError, read_model_description

from zsim.errors import RunError, UserCodeError, reason_of
from zsim.output_folder import temporary_folder
from zsim.schema.checker import suggestion

Kind = Literal["number", "whole", "flag", "text"]
Values = Sequence[Any]
Inputs = Iterable[tuple["Variable", Values]]

ALLOWED = "must be an FMU of FMI 2 or 3 for co-simulation"
WARNING, FATAL = 1, 4  # of the statuses of FMI 2 and 3; those beyond a warning are failures
LABELS = ("ok", "warning", "discard", "error", "fatal", "pending")  # of the statuses
LINES_KEPT = 5  # of an FMU's log, to explain a failure
NAMED_MAX = 10  # variables in a refusal
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
# Of FMI's types: what they hold, and the name in FMPy's get… and set…
TYPES: dict[int, dict[str, tuple[Kind, str]]] = {
    2: {
        "Real": ("number", "Real"),
        "Integer": ("whole", "Integer"),
        "Enumeration": ("whole", "Integer"),
        "Boolean": ("flag", "Boolean"),
        "String": ("text", "String"),
    },
    3: {
        **{name: ("number", name) for name in ("Float64", "Float32")},
        **{f"{sign}Int{bits}": ("whole", f"{sign}Int{bits}") for sign in ("", "U") for bits in (8, 16, 32, 64)},
        "Enumeration": ("whole", "Int64"),
        "Boolean": ("flag", "Boolean"),
        "String": ("text", "String"),
    },
}


class Unit(NamedTuple):
    """A unit: x of it are `factor` x + `offset` in SI units, of these exponents; None where an FMU does not say."""

    name: str
    exponents: tuple[int, ...] | None = None  # as BASE_UNITS
    factor: float = 1.0
    offset: float = 0.0


class Variable(NamedTuple):
    """A variable of an FMU, or the elements of an array that FMI 2 has as one variable each."""

    name: str
    causality: str
    type: str  # as FMI names it
    kind: Kind
    call: str  # in the names of FMPy's functions
    references: tuple[int, ...]
    size: int  # how many values it has
    unit: Unit | None


class FmuModel:
    """The description of an FMU.

    Attributes:
        path: of the file; its name begins the texts of all faults.
        version: of FMI, 2 or 3.
        step_s: the communication step that it suggests [s]; None for none.
        is_step_fixed: whether it takes no other step.
        restores: whether its state can be taken and given back as bytes.

    Raises:
        RunError: it is no such FMU, or has no library for this machine.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.description: Any = _described(path)
        self.version = int(self.description.fmiVersion.partition(".")[0])
        about = self.description.coSimulation
        folder = fmpy.platform if self.version == 2 else fmpy.platform_tuple
        self.library = f"binaries/{folder}/{about.modelIdentifier}{fmpy.sharedLibraryExtension}"
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
        if self.library not in names:
            has = {name.split("/")[1] for name in names if name.startswith("binaries/") and name.count("/") == 2}
            listed = ", ".join(sorted(has)) or "none"
            raise RunError(f"{path}: has no library for {folder}, this machine; has {listed}: export it for this one")
        experiment = self.description.defaultExperiment
        fixed_s = about.fixedInternalStepSize
        self.step_s = fixed_s if fixed_s is not None else _number(experiment.stepSize) if experiment else None
        self.is_step_fixed = self.step_s is not None and not about.canHandleVariableCommunicationStepSize
        self.restores = about.canGetAndSetFMUstate and about.canSerializeFMUstate
        units = {unit.name: _unit(unit) for unit in self.description.unitDefinitions}
        types = TYPES[self.version]
        self._unknown: dict[str, str] = {}  # type by name, of variables that cannot be used
        self.variables: dict[str, Variable] = {}
        for each in self.description.modelVariables:
            if each.type not in types:
                self._unknown[each.name] = each.type
                continue
            kind, call = types[each.type]
            named = each.unit or (each.declaredType.unit if each.declaredType else None)
            self.variables[each.name] = Variable(
                name=each.name,
                causality=each.causality or "local",
                type=each.type,
                kind=kind,
                call=call,
                references=(each.valueReference,),
                size=math.prod(each.shape or ()),
                unit=units.get(named, Unit(named)) if named else None,
            )

    def variable(self, name: str) -> Variable:
        """Return a variable by its name, or the array whose elements are named `name[0]`, or `name[1]`, and so on.

        Raises:
            RunError: there is none of that name.
        """
        found = self.variables.get(name)
        if found is not None:
            return found
        first = next((i for i in (0, 1) if f"{name}[{i}]" in self.variables), None)
        if first is not None:
            elements = []
            while (element := self.variables.get(f"{name}[{first + len(elements)}]")) is not None:
                elements.append(element)
            references = tuple(reference for element in elements for reference in element.references)
            return elements[0]._replace(name=name, references=references, size=sum(each.size for each in elements))
        if name in self._unknown:
            allowed = ", ".join(TYPES[self.version])
            raise RunError(f"{self.path}: variable {name} is of type {self._unknown[name]}; must be one of {allowed}")
        open_to_all = [each.name for each in self.variables.values() if each.causality in ("input", "output")]
        known = open_to_all or [*self.variables]
        more = f" and {len(known) - NAMED_MAX} more" if len(known) > NAMED_MAX else ""
        hint = suggestion(name, self.variables)
        raise RunError(
            f"{self.path}: has no variable {name!r}; {hint}must be one of {', '.join(known[:NAMED_MAX])}{more}"
        )


class FmuInstance:
    """An FMU that runs in this process.

    Args:
        name: of the instance, in its own log.
        say: takes the lines that it logs, from warnings on; all of them if `log`.

    Raises:
        RunError: its library cannot be loaded, or it refuses to be instantiated.
    """

    def __init__(self, model: FmuModel, name: str, say: Callable[[str], None], log: bool = False) -> None:
        self.model = model
        self._log = FmuLog(model.path.name, say, log)
        try:
            status = model.path.stat()
            folder = _unpacked(model.path.resolve(), status.st_mtime_ns, status.st_size)
            description = model.description
            identity = {
                "guid": description.guid if model.version == 2 else description.instantiationToken,
                "modelIdentifier": description.coSimulation.modelIdentifier,
                "unzipDirectory": str(folder),
                "instanceName": name,
            }
            if model.version == 2:
                self._unit: Any = FMU2Slave(**identity)
                self._unit.instantiate(callbacks=self._log.callbacks(), loggingOn=True)
            else:
                self._unit = FMU3Slave(**identity, libraryPath=str(folder / model.library))
                self._unit.instantiate(loggingOn=True, logMessage=self._log.take_3)
        except Exception as error:  # FMPy raises bare ones, and a library may lack another
            raise RunError(f"{model.path}: cannot be started: {self._explained(reason_of(error))}") from error
        self._end = weakref.finalize(self, _freed, self._unit, model.version)
        self._end.atexit = False  # a library that embeds an interpreter cannot be left while that ends

    def start(self, t_s: float, inputs: Inputs) -> None:
        """Initialise it at a simulated time [s] with the inputs of that time."""
        if self.model.version == 2:
            self._calling(self._unit.setupExperiment, startTime=t_s)
            self._calling(self._unit.enterInitializationMode)
        else:
            self._calling(self._unit.enterInitializationMode, startTime=t_s)
        self._calling(self._write, inputs)
        self._calling(self._unit.exitInitializationMode)

    def write(self, inputs: Inputs) -> None:
        """Set inputs, and parameters before the start."""
        self._calling(self._write, inputs)

    def step(self, t_s: float, step_s: float) -> None:
        """Advance from t_s by step_s."""
        result = self._calling(self._unit.doStep, t_s, step_s)
        if result is not None and result[1]:
            raise UserCodeError(self._explained(f"{self.model.path}: asks to end the simulation"))

    def read(self, variables: Sequence[Variable]) -> list[list[Any]]:
        """Return the values of each variable, as Python's numbers, flags and texts."""
        return self._calling(self._read, variables)

    def state(self) -> bytes:
        """Return its state; only where the model `restores`."""
        return self._calling(self._state)

    def restore(self, state: bytes) -> None:
        """Take over a state, started or not."""
        self._calling(self._restore, state)

    def _write(self, inputs: Inputs) -> None:
        grouped: dict[str, tuple[list[int], list[Any]]] = {}
        for variable, values in inputs:
            references, together = grouped.setdefault(variable.call, ([], []))
            references += variable.references
            together += values
        for call, (references, together) in grouped.items():
            getattr(self._unit, f"set{call}")(references, together)

    def _read(self, variables: Sequence[Variable]) -> list[list[Any]]:
        grouped: dict[str, list[Variable]] = {}
        for variable in variables:
            grouped.setdefault(variable.call, []).append(variable)
        values: dict[str, list[Any]] = {}
        for call, together in grouped.items():
            references = [reference for variable in together for reference in variable.references]
            size = () if self.model.version == 2 or call == "String" else (sum(each.size for each in together),)
            found = getattr(self._unit, f"get{call}")(references, *size)
            begin = 0
            for variable in together:
                own = found[begin : begin + variable.size]
                begin += variable.size
                values[variable.name] = [_plain(value, variable.kind) for value in own]
        return [values[variable.name] for variable in variables]

    def _state(self) -> bytes:
        held = self._unit.getFMUState()
        try:
            return self._unit.serializeFMUState(held)
        finally:
            self._unit.freeFMUState(held)

    def _restore(self, state: bytes) -> None:
        held = self._unit.deserializeFMUState(state)
        try:
            self._unit.setFMUState(held)
        finally:
            self._unit.freeFMUState(held)

    def _calling(self, function: Callable[..., Any], *arguments: Any, **more: Any) -> Any:
        try:
            return function(*arguments, **more)
        except FMICallException as error:
            if error.status == FATAL:
                self._end.detach()  # nothing may be called any more (FMI 3.0.2, 2.1.3)
            label = LABELS[error.status] if error.status in range(len(LABELS)) else f"status {error.status}"
            text = f"{self.model.path}: {error.function} returns {label}"
            raise UserCodeError(self._explained(text)) from error

    def _explained(self, text: str) -> str:
        lines = "; ".join(self._log.lines)
        return f"{text}; its last words: {lines}" if lines else text


class FmuLog:
    """Takes the log of an FMU: warnings and errors, or all lines, go to `say`; the last bad ones are kept."""

    def __init__(self, name: str, say: Callable[[str], None], all_lines: bool) -> None:
        self._name, self._say, self._all = name, say, all_lines
        self.lines: deque[str] = deque(maxlen=LINES_KEPT)

    def callbacks(self) -> Any:
        """Return what an FMU of FMI 2 calls."""
        callbacks = fmi2CallbackFunctions()
        callbacks.logger = fmi2CallbackLoggerTYPE(self._take_2)
        callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
        callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
        addLoggerProxy(byref(callbacks))
        return callbacks

    def _take_2(self, _component: Any, _instance: bytes, status: int, _category: bytes, text: bytes) -> None:
        self._take(status, text)

    def take_3(self, _environment: Any, status: int, _category: bytes, text: bytes) -> None:
        """Take a line of an FMU of FMI 3, as its callback."""
        self._take(status, text)

    def _take(self, status: int, text: bytes | None) -> None:
        line = " ".join((text or b"").decode(errors="replace").split())
        if status >= WARNING:
            self.lines.append(line)
        if self._all or status >= WARNING:
            label = LABELS[status] if status in range(len(LABELS)) else str(status)
            self._say(f"{self._name}: {label}: {line}")


def _described(path: Path) -> Any:
    try:
        with zipfile.ZipFile(path) as archive:
            if "modelDescription.xml" not in archive.namelist():
                raise RunError(f"{path}: is no FMU (it holds no modelDescription.xml); {ALLOWED}")
        description = read_model_description(BytesIO(path.read_bytes()))  # FMPy leaves a refused file open
    except zipfile.BadZipFile as error:
        raise RunError(f"{path}: is no FMU (no zip archive); {ALLOWED}") from error
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror}); {ALLOWED}") from error
    except ValidationError as error:
        first = " ".join(str(error.problems[0]).split())
        raise RunError(f"{path}: its modelDescription.xml is invalid: {first}") from error
    except RunError:
        raise
    except Exception as error:  # lxml's, and bare ones of FMPy's
        raise RunError(f"{path}: is no FMU that can be read: {reason_of(error)}; {ALLOWED}") from error
    if str(description.fmiVersion).partition(".")[0] not in ("2", "3"):
        raise RunError(f"{path}: is of FMI {description.fmiVersion}; {ALLOWED}")
    if description.coSimulation is None:
        raise RunError(f"{path}: is for model exchange, without a solver; export it for co-simulation")
    return description


def _unit(definition: Any) -> Unit:
    base = definition.baseUnit
    if base is None:
        return Unit(definition.name)
    exponents = tuple(int(getattr(base, name)) for name in BASE_UNITS)
    return Unit(definition.name, exponents, float(base.factor), float(base.offset))


def _number(text: Any) -> float | None:
    return float(text) if text is not None else None


def _plain(value: Any, kind: Kind) -> Any:
    if kind == "text":
        return value.decode(errors="replace") if isinstance(value, bytes) else value or ""
    return bool(value) if kind == "flag" else value


@cache
def _unpacked(path: Path, _mtime_ns: int, _size: int) -> Path:
    """Return the folder in which an FMU is unpacked, once for all its instances in this process."""
    folder = temporary_folder("fmu-")
    fmpy.extract(path, folder)
    return folder


def _freed(unit: Any, version: int) -> None:
    """End an instance; its library stays loaded, since one that embeds an interpreter cannot be unloaded."""
    with suppress(Exception):  # it may have failed before
        unit.terminate()
    with suppress(Exception):
        getattr(unit, f"fmi{version}FreeInstance")(unit.component)
