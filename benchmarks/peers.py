"""The environment of the peers (the packages zsim is compared with), and which of them could be installed in it."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / ".venv-bench"
PYTHON = FOLDER / "bin" / "python"
PINS = Path(__file__).parent / "requirements.txt"
STATE = FOLDER / "peers.json"
CPU_TORCH = ("--extra-index-url", "https://download.pytorch.org/whl/cpu")  # PyPI's torch brings gigabytes of CUDA
# peer: (pip arguments, module imported to check the installation)
PEERS: dict[str, tuple[tuple[str, ...], str]] = {
    "helics": (("helics",), "helics"),
    "mosaik": (("mosaik",), "mosaik"),
    "pyzmq": (("pyzmq",), "zmq"),
    "mujoco": (("mujoco",), "mujoco"),
    "pybullet": (("pybullet",), "pybullet"),
    "crazyflow": (("crazyflow",), "crazyflow.sim"),
    "rotorpy": (("rotorpy",), "rotorpy.vehicles.multirotor"),
    "torch": ((*CPU_TORCH, "torch", "torchdiffeq", "roma"), "torchdiffeq"),
}


def ensure(say: Callable[[str], None]) -> None:
    """Create the environment and install missing peers; store why a peer cannot be installed."""
    if not PYTHON.exists():
        say(f"making {FOLDER.name} for the peers")
        subprocess.run([sys.executable, "-m", "venv", str(FOLDER)], check=True)
    state = {peer: _installed(peer, module, arguments, say) for peer, (arguments, module) in PEERS.items()}
    STATE.write_text(json.dumps(state, indent=1))


def missing(peer: str) -> str | None:
    """Return why a peer cannot run, or None if it can."""
    if not STATE.exists():
        return "its environment was not made; `make bench` makes it"
    return json.loads(STATE.read_text()).get(peer)


def versions() -> dict[str, str]:
    names = [argument for arguments, _ in PEERS.values() for argument in arguments if argument.isidentifier()]
    code = (
        "import importlib.metadata as m, json; "
        "print(json.dumps({d.name.lower(): d.version for d in m.distributions()}))"
    )
    if not PYTHON.exists():
        return {}
    shown = subprocess.run([str(PYTHON), "-c", code], capture_output=True, text=True, check=True)
    found = json.loads(shown.stdout)
    return {name: found[name] for name in sorted([*names, "jax", "numpy"]) if name in found}


def _installed(peer: str, module: str, arguments: tuple[str, ...], say: Callable[[str], None]) -> str | None:
    """Install a peer unless it can be imported; return None, or why it still cannot be imported."""
    if _importable(module) is None:
        return None
    say(f"installing {peer} for comparison")
    pip = [str(PYTHON), "-m", "pip", "install", "-q", "--disable-pip-version-check", "-c", str(PINS), *arguments]
    done = subprocess.run(pip, capture_output=True, text=True, check=False)
    if done.returncode:
        errors = [text for text in done.stderr.splitlines() if text.startswith("ERROR")]
        return f"pip: {errors[-1] if errors else done.stderr[-200:]}"
    return _importable(module)


def _importable(module: str) -> str | None:
    done = subprocess.run([str(PYTHON), "-c", f"import {module}"], capture_output=True, text=True, check=False)
    return None if done.returncode == 0 else f"import {module}: {done.stderr.strip().splitlines()[-1]}"
