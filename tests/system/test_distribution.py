"""The sdist and the wheel contain the right files, and an installation flies without a checkout.

Environments and runs are in folders whose names would break careless shell or path handling.
"""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from deployment import in_process
from federation import Record
from forked_commands import ROOT

import zsim
from zsim.record import RecordReader

INSTALL_S = 900.0  # wall time that pip may take, for 130 MB of wheels
FLIGHT_S = 900.0  # wall time that a flight may take, with compilation of the kernels
ODD = "a ü 飛"  # name of an environment: pip's programs break at a $, and venv refuses a colon, the separator of PATH
ODDER = "at 12:30 $x"
CHANGED = "clusters.main.plan.takeoff_s=0.5"
FLIGHT_DURATION_S = 8.0
SHORT = ("--set", CHANGED, "--duration", f"{FLIGHT_DURATION_S:g}", "--no-report")

pytestmark = pytest.mark.soak


def clean() -> dict[str, str]:
    """Return the environment without variables that lead to a checkout, and with pip held to constraints.txt."""
    names = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "ZSIM_CONNECT", "ZSIM_FEDERATION")
    held = (ROOT / "constraints.txt").as_uri()  # a URI, because pip splits a path at its spaces
    kept = {name: text for name, text in os.environ.items() if name not in names}
    return {**kept, "PIP_CONSTRAINT": held, "PIP_BUILD_CONSTRAINT": held, "PIP_DISABLE_PIP_VERSION_CHECK": "1"}


def done(command: list[str | Path], folder: Path, timeout_s: float = INSTALL_S) -> str:
    """Run a command, which must succeed, in a folder; return its output."""
    ended = subprocess.run(
        [*map(str, command)], cwd=folder, env=clean(), capture_output=True, text=True, timeout=timeout_s, check=False
    )
    assert ended.returncode == 0, (command, ended.stdout[-2000:], ended.stderr[-4000:])
    return ended.stdout


def environment(python: str, folder: Path, *packages: str | Path) -> Path:
    """Create a virtual environment with packages; return the folder of its programs."""
    done([python, "-m", "venv", folder], folder.parent)
    done([folder / "bin/pip", "install", "-q", "--no-compile", *packages], folder.parent)
    return folder / "bin"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The sdist and the wheel of this checkout."""
    folder = tmp_path_factory.mktemp(ODD)
    builder = environment(sys.executable, folder / "builder", "hatchling")
    done([builder / "hatchling", "build", "-d", folder / "dist"], ROOT)
    (sdist,), (wheel,) = (folder / "dist").glob("*.tar.gz"), (folder / "dist").glob("*.whl")
    return sdist, wheel


def tracked() -> set[str]:
    """Return the files of the checkout, including uncommitted ones."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return {name for name in printed.split("\0") if name and (ROOT / name).exists()}


def members(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="git lists what a checkout holds")
def test_the_sdist_holds_the_checkout_and_the_wheel_its_packages(built: tuple[Path, Path], tmp_path: Path) -> None:
    """A wheel built from the sdist equals that of the checkout, although the sdist has no git to state the commit."""
    sdist, wheel = built
    with tarfile.open(sdist) as archive:
        (top,) = {name.partition("/")[0] for name in archive.getnames()}
        files = {name.partition("/")[2] for name in archive.getnames()}
    assert files == tracked() | {"PKG-INFO"}
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    roots = [name.rpartition("/")[0] for name in packages["packages"]]
    names = [name.rpartition("/")[2] for name in packages["packages"]]
    expected = {
        path.removeprefix(f"{root}/")
        for path in tracked()
        for root, name in zip(roots, names, strict=True)
        if path.startswith(f"{root}/{name}/".removeprefix("/"))
    }
    found = members(wheel)
    described = {name for name in found if re.match(r"zsim-[\d.]+\.dist-info/", name)}
    assert set(found) - described == expected
    assert {name.rpartition("/")[2] for name in described} >= {"METADATA", "entry_points.txt"}
    assert found["zsim/commit.txt"].decode().strip() == zsim.commit()
    code = {name for name in files if re.match(r"([a-z]+/)?(zsim\w*)/__init__\.py$", name)}
    assert {name.rpartition("/")[0].rpartition("/")[2] for name in code} == set(names)
    builder = wheel.parent.parent / "builder/bin"
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    done([builder / "hatchling", "build", "-t", "wheel", "-d", tmp_path / "again"], tmp_path / top)
    (again,) = (tmp_path / "again").iterdir()
    assert members(again) == found


def other_python() -> str:
    """Return the newest supported Python of another minor version; empty if the machine has none."""
    places = [*Path.home().glob(".pyenv/versions/3.*/bin/python3"), *map(shutil.which, ("python3.14", "python3.13"))]
    code = "import sys, ensurepip; print(*sys.version_info[:2])"
    versions = {}
    for place in filter(None, places):
        asked = subprocess.run([place, "-c", code], env=clean(), capture_output=True, text=True, check=False)
        version = tuple(map(int, asked.stdout.split()))
        if version >= (3, 11) and version != sys.version_info[:2]:
            versions[version] = str(place)
    return versions[max(versions)] if versions else ""


def test_an_installed_sdist_flies_without_a_checkout(built: tuple[Path, Path], tmp_path: Path) -> None:
    """On another Python, runs in one process, in several, and from a bundle have the bits of the checkout."""
    bin = environment(other_python() or sys.executable, tmp_path / ODD, f"{built[0]}[python]")
    folder = tmp_path / ODD / ODDER
    folder.mkdir()
    program: list[str | Path] = [bin / "zsim"]  # its shebang cannot name a Python in such a folder
    assert done([*program, "--version"], folder) == f"zsim {zsim.__version__}\n"
    where = done([bin / "python", "-c", "import zsim, zsim_deploy; print(zsim.__file__, zsim_deploy.__file__)"], folder)
    assert str(ROOT) not in where
    shutil.copy(ROOT / "scenarios/step.yaml", folder)  # as a user might have it from the sdist or elsewhere
    done([*program, "run", "step.yaml", *SHORT, "--in-process", "--out", "in one"], folder, FLIGHT_S)
    done([*program, "run", "step.yaml", *SHORT, "--out", "processes"], folder, FLIGHT_S)
    checkout = in_process(tmp_path, FLIGHT_DURATION_S, [CHANGED])
    for name in ("in one", "processes"):
        with RecordReader(folder / name / "run.mcap") as record:
            assert Record(record).sha256() == checkout
    done([*program, "report", "processes"], folder)
    done([*program, "bundle", "processes", "-o", "ü:1.zsim"], folder)
    assert checkout in done([*program, "rerun", "ü:1.zsim"], folder)
    assert done([*program, "doctor", "step.yaml"], folder)
    assert {each.name for each in folder.iterdir()} == {"step.yaml", "in one", "processes", "ü:1.zsim"}
