"""FMUs for tests: the example, and others written in a few lines, built by pythonfmu3 (FMI 3) or pythonfmu (FMI 2)."""

from pathlib import Path
from textwrap import indent

from pythonfmu import FmuBuilder as Builder2
from pythonfmu3 import FmuBuilder as Builder3

EXAMPLE = Path(__file__).parents[2] / "examples" / "waypoint_fmu.py"
HEAD_3 = """
from pythonfmu3 import *

class {name}(Fmi3Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time = 0.0
        self.register_variable(Float64("time", causality=Fmi3Causality.independent))
        self.register_units([Unit("deg", rad=1, factor=0.017453292519943295), Unit("km/h", m=1, s=-1, factor=1 / 3.6)])
        self.register_units([Unit("K", K=1)])
        I, O, P = Fmi3Causality.input, Fmi3Causality.output, Fmi3Causality.parameter
        Real, Whole = Float64, Int32

        def variable(name, start, causality, Type=Float64, **more):
            setattr(self, name.replace("[", "_").replace("]", ""), start)
            place = name.replace("[", "_").replace("]", "")
            tunable = dict(variability=Fmi3Variability.tunable) if causality is P else dict(
                variability=Fmi3Variability.continuous if Type is Float64 else Fmi3Variability.discrete)
            if isinstance(start, list):
                more["dimensions"] = [Dimension(start=str(len(start)))]
            self.register_variable(Type(name, causality=causality, **tunable, **more,
                getter=lambda: getattr(self, place), setter=lambda v: setattr(self, place, v)))

{variables}

    def do_step(self, time, step):
        self.time = time + step
{law}
        return Fmi3StepResult(status=Fmi3Status.ok)
"""
HEAD_2 = """
from pythonfmu import *
from pythonfmu.enums import *

class {name}(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        I, O, P = Fmi2Causality.input, Fmi2Causality.output, Fmi2Causality.parameter
        Whole = Integer

        def variable(name, start, causality, Type=Real):
            setattr(self, name.replace("[", "_").replace("]", ""), start)
            place = name.replace("[", "_").replace("]", "")
            tunable = dict(variability=Fmi2Variability.tunable) if causality is P else dict(
                variability=Fmi2Variability.continuous if Type is Real else Fmi2Variability.discrete)
            exact = dict(initial=Fmi2Initial.exact if causality is O else None)
            self.register_variable(Type(name, causality=causality, **tunable, **exact,
                getter=lambda: getattr(self, place), setter=lambda v: setattr(self, place, v)))

{variables}

    def do_step(self, time, step):
{law}
        return True
"""


def example(folder: Path) -> Path:
    """Build the FMU of examples/waypoint_fmu.py; return its path."""
    return Builder3.build_FMU(EXAMPLE, folder, canGetAndSetFMUState=True, canSerializeFMUState=True)


def build(folder: Path, name: str, version: int, variables: str, law: str, restores: bool = True) -> Path:
    """Build an FMU; return its path.

    Args:
        name: name of its class, which must be unique in a process.
        version: major version of FMI, 2 or 3.
        variables: calls of `variable(name, start, causality)`, with causality I, O or P and optionally a type Real,
            Whole, Boolean or String; a list as start value declares an array, in FMI 3 only.
        law: statements of a step; a variable NAME is `self.NAME`, and the element `v[0]` of an array is `self.v_0`.
        restores: whether its state can be read and restored.
    """
    head = {2: HEAD_2, 3: HEAD_3}[version]
    parts = {"variables": indent(variables.strip("\n"), " " * 8), "law": indent(law.strip("\n"), " " * 8)}
    script = folder / f"{name.lower()}_{version}.py"
    script.write_text(head.format(name=name, **parts))
    if version == 2:
        return Builder2.build_FMU(script, folder, canGetAndSetFMUstate=restores, canSerializeFMUstate=restores)
    return Builder3.build_FMU(script, folder, canGetAndSetFMUState=restores, canSerializeFMUState=restores)
