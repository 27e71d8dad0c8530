"""An FMU (functional mock-up unit) for co-simulation with FMI 2 or 3: opened, checked and stepped with FMPy.

    model = FmuModel(Path("controller.fmu"))       its description
    unit = FmuInstance(model, "fmu.drone1", say)   its library, loaded into this process
    unit.start(0.0, [(variable, [1.0])])
    unit.step(0.0, 0.02)
    unit.read([variable])

An unusable file raises a RunError; a fault of a running FMU raises a UserCodeError.
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

Kind = Literal["number", "integer", "boolean", "text"]
Values = Sequence[Any]
Inputs = Iterable[tuple["Variable", Values]]

ALLOWED = "must be an FMU of FMI 2 or 3 for co-simulation"
WARNING, FATAL = 1, 4  # statuses of FMI 2 and 3; those above a warning are failures
LABELS = ("ok", "warning", "discard", "error", "fatal", "pending")  # names of the statuses, by number
LINES_KEPT = 5  # number of the FMU's last warnings and errors that are quoted with a failure
NAMED_MAX = 10  # number of variables that an error lists
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
# For each FMI version and type: the kind of value, and the suffix of FMPy's methods get… and set…
TYPES: dict[int, dict[str, tuple[Kind, str]]] = {
    2: {
        "Real": ("number", "Real"),
        "Integer": ("integer", "Integer"),
        "Enumeration": ("integer", "Integer"),
        "Boolean": ("boolean", "Boolean"),
        "String": ("text", "String"),
    },
    3: {
        **{name: ("number", name) for name in ("Float64", "Float32")},
        **{f"{sign}Int{bits}": ("integer", f"{sign}Int{bits}") for sign in ("", "U") for bits in (8, 16, 32, 64)},
        "Enumeration": ("integer", "Int64"),
        "Boolean": ("boolean", "Boolean"),
        "String": ("text", "String"),
    },
}


class Unit(NamedTuple):
    """A unit: a value x in this unit equals `factor` x + `offset` in the SI unit with the same exponents."""

    name: str
    exponents: tuple[int, ...] | None = None  # of BASE_UNITS; None if the FMU does not define the unit
    factor: float = 1.0
    offset: float = 0.0


class Variable(NamedTuple):
    """A variable of an FMU, or an array whose elements are separate variables, as in FMI 2."""

    name: str
    causality: str
    type: str  # FMI's name of the type
    kind: Kind
    call: str  # suffix of FMPy's methods get… and set…
    references: tuple[int, ...]
    size: int  # number of values
    unit: Unit | None


class FmuModel:
    """The description of an FMU.

    Attributes:
        path: path of the file; all error messages begin with it.
        version: FMI version, 2 or 3.
        step_s: suggested communication step [s]; None if the FMU suggests none.
        is_step_fixed: whether the FMU accepts no other step.
        can_restore: whether the state of an instance can be saved as bytes and restored.

    Raises:
        RunError: the file is not an FMU for co-simulation with FMI 2 or 3, or has no library for this machine.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.description: Any = _read_description(path)
        self.version = int(self.description.fmiVersion.partition(".")[0])
        co_simulation = self.description.coSimulation
        folder = fmpy.platform if self.version == 2 else fmpy.platform_tuple
        self.library = f"binaries/{folder}/{co_simulation.modelIdentifier}{fmpy.sharedLibraryExtension}"
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
        if self.library not in names:
            platforms = {name.split("/")[1] for name in names if name.startswith("binaries/") and name.count("/") == 2}
            platforms_text = ", ".join(sorted(platforms)) or "none"
            raise RunError(
                f"{path}: has no library for {folder}, only for {platforms_text}; export it for this machine"
            )
        experiment = self.description.defaultExperiment
        fixed_step_s = co_simulation.fixedInternalStepSize
        self.step_s = fixed_step_s if fixed_step_s is not None else _number(experiment.stepSize) if experiment else None
        self.is_step_fixed = self.step_s is not None and not co_simulation.canHandleVariableCommunicationStepSize
        self.can_restore = co_simulation.canGetAndSetFMUstate and co_simulation.canSerializeFMUstate
        units = {unit.name: _unit(unit) for unit in self.description.unitDefinitions}
        types = TYPES[self.version]
        self._unsupported: dict[str, str] = {}  # unsupported types, by variable name
        self.variables: dict[str, Variable] = {}
        for each in self.description.modelVariables:
            if each.type not in types:
                self._unsupported[each.name] = each.type
                continue
            kind, call = types[each.type]
            unit_name = each.unit or (each.declaredType.unit if each.declaredType else None)
            self.variables[each.name] = Variable(
                name=each.name,
                causality=each.causality or "local",
                type=each.type,
                kind=kind,
                call=call,
                references=(each.valueReference,),
                size=math.prod(each.shape or ()),
                unit=units.get(unit_name, Unit(unit_name)) if unit_name else None,
            )

    def variable(self, name: str) -> Variable:
        """Return a variable by its name, or the array whose elements are named `name[0]` (or `name[1]`) and so on.

        Raises:
            RunError: the FMU has no such variable, or its type is not supported.
        """
        variable = self.variables.get(name)
        if variable is not None:
            return variable
        first = next((i for i in (0, 1) if f"{name}[{i}]" in self.variables), None)
        if first is not None:
            elements = []
            while (element := self.variables.get(f"{name}[{first + len(elements)}]")) is not None:
                elements.append(element)
            references = tuple(reference for element in elements for reference in element.references)
            return elements[0]._replace(name=name, references=references, size=sum(each.size for each in elements))
        if name in self._unsupported:
            allowed = ", ".join(TYPES[self.version])
            raise RunError(f"{self.path}: {name} is of type {self._unsupported[name]}; must be one of {allowed}")
        ports = [each.name for each in self.variables.values() if each.causality in ("input", "output")]
        candidates = ports or [*self.variables]
        more = f" and {len(candidates) - NAMED_MAX} more" if len(candidates) > NAMED_MAX else ""
        hint = suggestion(name, self.variables)
        raise RunError(
            f"{self.path}: has no variable {name!r}; {hint}must be one of {', '.join(candidates[:NAMED_MAX])}{more}"
        )


class FmuInstance:
    """An FMU that runs in this process.

    Args:
        name: name of the instance in its own log.
        say: receives the warnings and errors that the instance logs, or all lines if `log`.

    Raises:
        RunError: the library cannot be loaded, or the FMU cannot be instantiated.
    """

    def __init__(self, model: FmuModel, name: str, say: Callable[[str], None], log: bool = False) -> None:
        self.model = model
        self._log = FmuLog(model.path.name, say, log)
        try:
            status = model.path.stat()
            folder = _unpacked_folder(model.path.resolve(), status.st_mtime_ns, status.st_size)
            description = model.description
            identity = {
                "guid": description.guid if model.version == 2 else description.instantiationToken,
                "modelIdentifier": description.coSimulation.modelIdentifier,
                "unzipDirectory": str(folder),
                "instanceName": name,
            }
            if model.version == 2:
                self._instance: Any = FMU2Slave(**identity)
                self._instance.instantiate(callbacks=self._log.callbacks(), loggingOn=True)
            else:
                self._instance = FMU3Slave(**identity, libraryPath=str(folder / model.library))
                self._instance.instantiate(loggingOn=True, logMessage=self._log.log_fmi3)
        except Exception as error:  # FMPy raises bare exceptions, and a library that the FMU needs may be missing
            raise RunError(f"{model.path}: cannot be started: {self._with_log_lines(reason_of(error))}") from error
        self._finalizer = weakref.finalize(self, _free, self._instance, model.version)
        self._finalizer.atexit = False  # at exit, an interpreter embedded in the library may be gone

    def start(self, t_s: float, inputs: Inputs) -> None:
        """Initialise the FMU at simulated time t_s with the inputs at that time."""
        if self.model.version == 2:
            self._call(self._instance.setupExperiment, startTime=t_s)
            self._call(self._instance.enterInitializationMode)
        else:
            self._call(self._instance.enterInitializationMode, startTime=t_s)
        self._call(self._write, inputs)
        self._call(self._instance.exitInitializationMode)

    def write(self, inputs: Inputs) -> None:
        """Set inputs or, before the start, parameters."""
        self._call(self._write, inputs)

    def step(self, t_s: float, step_s: float) -> None:
        """Advance by step_s from simulated time t_s; raise a UserCodeError if the FMU ends the simulation."""
        result = self._call(self._instance.doStep, t_s, step_s)
        if result is not None and result[1]:
            raise UserCodeError(self._with_log_lines(f"{self.model.path}: requests the end of the simulation"))

    def read(self, variables: Sequence[Variable]) -> list[list[Any]]:
        """Return each variable's values, as float, int, bool or str."""
        return self._call(self._read, variables)

    def state(self) -> bytes:
        """Return the serialised state; only if the model `can_restore`."""
        return self._call(self._state)

    def restore(self, state: bytes) -> None:
        """Restore a serialised state, whether or not the FMU has been started."""
        self._call(self._restore, state)

    def _write(self, inputs: Inputs) -> None:
        grouped: dict[str, tuple[list[int], list[Any]]] = {}
        for variable, values in inputs:
            references, all_values = grouped.setdefault(variable.call, ([], []))
            references += variable.references
            all_values += values
        for call, (references, all_values) in grouped.items():
            getattr(self._instance, f"set{call}")(references, all_values)

    def _read(self, variables: Sequence[Variable]) -> list[list[Any]]:
        grouped: dict[str, list[Variable]] = {}
        for variable in variables:
            grouped.setdefault(variable.call, []).append(variable)
        values: dict[str, list[Any]] = {}
        for call, call_variables in grouped.items():
            references = [reference for variable in call_variables for reference in variable.references]
            size = () if self.model.version == 2 or call == "String" else (sum(each.size for each in call_variables),)
            results = getattr(self._instance, f"get{call}")(references, *size)
            start = 0
            for variable in call_variables:
                variable_values = results[start : start + variable.size]
                start += variable.size
                values[variable.name] = [_plain(value, variable.kind) for value in variable_values]
        return [values[variable.name] for variable in variables]

    def _state(self) -> bytes:
        handle = self._instance.getFMUState()
        try:
            return self._instance.serializeFMUState(handle)
        finally:
            self._instance.freeFMUState(handle)

    def _restore(self, state: bytes) -> None:
        handle = self._instance.deserializeFMUState(state)
        try:
            self._instance.setFMUState(handle)
        finally:
            self._instance.freeFMUState(handle)

    def _call(self, function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        try:
            return function(*arguments, **keywords)
        except FMICallException as error:
            if error.status == FATAL:
                self._finalizer.detach()  # no function of the FMU may be called any more (FMI 3.0.2, 2.1.3)
            label = LABELS[error.status] if error.status in range(len(LABELS)) else f"status {error.status}"
            text = f"{self.model.path}: {error.function} returns {label}"
            raise UserCodeError(self._with_log_lines(text)) from error

    def _with_log_lines(self, text: str) -> str:
        lines = "; ".join(self._log.lines)
        return f"{text}; its last log lines: {lines}" if lines else text


class FmuLog:
    """Receives an FMU's log: passes warnings and errors, or all lines, to `say`; keeps the last warnings and errors."""

    def __init__(self, name: str, say: Callable[[str], None], all_lines: bool) -> None:
        self._name, self._say, self._all = name, say, all_lines
        self.lines: deque[str] = deque(maxlen=LINES_KEPT)

    def callbacks(self) -> Any:
        """Return the callback functions for an FMU of FMI 2."""
        callbacks = fmi2CallbackFunctions()
        callbacks.logger = fmi2CallbackLoggerTYPE(self._log_fmi2)
        callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
        callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
        addLoggerProxy(byref(callbacks))
        return callbacks

    def _log_fmi2(self, _component: Any, _instance: bytes, status: int, _category: bytes, text: bytes) -> None:
        self._log_line(status, text)

    def log_fmi3(self, _environment: Any, status: int, _category: bytes, text: bytes) -> None:
        """Receive a log line; this is the log callback for an FMU of FMI 3."""
        self._log_line(status, text)

    def _log_line(self, status: int, text: bytes | None) -> None:
        line = " ".join((text or b"").decode(errors="replace").split())
        if status >= WARNING:
            self.lines.append(line)
        if self._all or status >= WARNING:
            label = LABELS[status] if status in range(len(LABELS)) else str(status)
            self._say(f"{self._name}: {label}: {line}")


def _read_description(path: Path) -> Any:
    try:
        with zipfile.ZipFile(path) as archive:
            if "modelDescription.xml" not in archive.namelist():
                raise RunError(f"{path}: is not an FMU (it contains no modelDescription.xml); {ALLOWED}")
        description = read_model_description(BytesIO(path.read_bytes()))  # FMPy leaves invalid files open
    except zipfile.BadZipFile as error:
        raise RunError(f"{path}: is not an FMU (not a zip archive); {ALLOWED}") from error
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror}); {ALLOWED}") from error
    except ValidationError as error:
        first = " ".join(str(error.problems[0]).split())
        raise RunError(f"{path}: its modelDescription.xml is invalid: {first}") from error
    except RunError:
        raise
    except Exception as error:  # lxml and FMPy raise various exceptions
        raise RunError(f"{path}: cannot be read as an FMU: {reason_of(error)}; {ALLOWED}") from error
    if str(description.fmiVersion).partition(".")[0] not in ("2", "3"):
        raise RunError(f"{path}: is for FMI {description.fmiVersion}; {ALLOWED}")
    if description.coSimulation is None:
        raise RunError(f"{path}: does not support co-simulation; export it for co-simulation")
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
    return bool(value) if kind == "boolean" else value


@cache
def _unpacked_folder(path: Path, _mtime_ns: int, _size: int) -> Path:
    """Return the folder of the unpacked FMU, shared by all its instances in this process until the file changes."""
    folder = temporary_folder("fmu-")
    fmpy.extract(path, folder)
    return folder


def _free(instance: Any, version: int) -> None:
    """Free an instance; its library stays loaded, since a library with an embedded interpreter cannot be unloaded."""
    with suppress(Exception):  # the FMU may have failed already
        instance.terminate()
    with suppress(Exception):
        getattr(instance, f"fmi{version}FreeInstance")(instance.component)
