"""The Python API: `zsim.run`, `zsim.Simulation` and more; see docs/python.md.

Each name is imported from its module on first use, so that an onboard computer needs only the packages that it uses.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for editors, which do not read _WHERE
    from zsim.contract.messages import AgentMessage as AgentMessage
    from zsim.errors import ZsimError as ZsimError
    from zsim.runtime.agent import Agent as Agent
    from zsim.runtime.agent import Output as Output
    from zsim.schema.parameters import Parameters as Parameters
    from zsim_agents.estimation.drone_estimator import DroneEstimator as DroneEstimator
    from zsim_agents.estimation.drone_estimator import StateEstimate as StateEstimate
    from zsim_agents.formation.assembly import assign as assign
    from zsim_agents.formation.control_law import ControlLaw as ControlLaw
    from zsim_agents.formation.spaces.cluster_space import ClusterSpace as ClusterSpace
    from zsim_api.commands import Command as Command
    from zsim_api.commands import PilotedDrone as PilotedDrone
    from zsim_api.commands import ardrone as ardrone
    from zsim_api.commands import attitude as attitude
    from zsim_api.commands import emergency as emergency
    from zsim_api.commands import land as land
    from zsim_api.commands import rotors as rotors
    from zsim_api.commands import takeoff as takeoff
    from zsim_api.commands import velocity as velocity
    from zsim_api.environments import any_of as any_of
    from zsim_api.environments import collided as collided
    from zsim_api.environments import far_away as far_away
    from zsim_api.environments import flipped as flipped
    from zsim_api.environments import gym_env as gym_env
    from zsim_api.environments import parallel_env as parallel_env
    from zsim_api.environments import vector_env as vector_env
    from zsim_api.federation import Federation as Federation
    from zsim_api.flight import run as run
    from zsim_api.policy import Interface as Interface
    from zsim_api.policy import PolicyAgent as PolicyAgent
    from zsim_api.recorded import Run as Run
    from zsim_api.recorded import load as load
    from zsim_api.scenarios import Scenario as Scenario
    from zsim_api.simulation import Simulation as Simulation
    from zsim_api.sweeping import sweep as sweep
    from zsim_bridges.fmu.agent import Fmu as Fmu

_WHERE = {
    "zsim.contract.messages": ("AgentMessage",),
    "zsim.errors": ("ZsimError",),
    "zsim.runtime.agent": ("Agent", "Output"),
    "zsim.schema.parameters": ("Parameters",),
    "zsim_agents.estimation.drone_estimator": ("DroneEstimator", "StateEstimate"),
    "zsim_agents.formation.assembly": ("assign",),
    "zsim_agents.formation.control_law": ("ControlLaw",),
    "zsim_agents.formation.spaces.cluster_space": ("ClusterSpace",),
    "zsim_api.commands": (
        *("Command", "ardrone", "attitude", "emergency", "land", "rotors", "takeoff", "velocity"),
        "PilotedDrone",
    ),
    "zsim_api.environments": (
        *("any_of", "collided", "far_away", "flipped"),
        *("gym_env", "parallel_env", "vector_env"),
    ),
    "zsim_api.federation": ("Federation",),
    "zsim_api.flight": ("run",),
    "zsim_api.policy": ("Interface", "PolicyAgent"),
    "zsim_api.recorded": ("Run", "load"),
    "zsim_api.scenarios": ("Scenario",),
    "zsim_api.simulation": ("Simulation",),
    "zsim_bridges.fmu.agent": ("Fmu",),
    "zsim_api.sweeping": ("sweep",),
}
_MODULES = {name: module for module, names in _WHERE.items() for name in names}
__all__ = [*_MODULES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from zsim.errors import what_is_missing

    with what_is_missing():
        return getattr(importlib.import_module(_MODULES[name]), name)
