"""The golden hashes: the truth_sha256 of every scenario of the repository, which is the same on every machine.

python tests/support/golden_flights.py              flies all scenarios and prints a new golden.yaml
python tests/support/golden_flights.py step swarm   flies the scenarios named
"""

import sys
import tempfile
from pathlib import Path

import yaml

import zsim

ROOT = Path(__file__).parents[2]
GOLDEN = Path(__file__).with_name("golden.yaml")
DURATION_S = 25.0  # greatest simulated duration; the paper's tests take off at 20 s
LARGE_S = 5.0  # the same for the scenarios in LARGE, which run slower
LARGE = {"eyes", "forest", "grid30", "ring10", "triads"}
UNFIT = {"plain_client", "hosts", "mixed"}  # needs a program besides zsim; is an inventory; has an external body


def scenarios() -> dict[str, Path]:
    """Return the scenario files of the repository by name."""
    files = sorted([*(ROOT / "scenarios").glob("*.yaml"), *(ROOT / "examples").glob("*.yaml")])
    return {file.stem: file for file in files if file.stem not in UNFIT}


def fly(name: str) -> str:
    """Return the truth_sha256 of the first seconds of a scenario, flown in this process."""
    file = scenarios()[name]
    most_s = LARGE_S if name in LARGE else DURATION_S
    duration_s = min(yaml.safe_load(file.read_text())["duration_s"], most_s)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "run")
        return zsim.run(file, duration_s=duration_s, out=out, progress=False).truth_sha256 or ""


if __name__ == "__main__":
    for chosen in sys.argv[1:] or scenarios():
        print(f"{chosen}: {fly(chosen)}", flush=True)
