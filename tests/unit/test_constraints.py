"""constraints.txt has a version of each package that zsim needs, for every Python that it supports, and nothing else."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
LINES = [line for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines() if not line.startswith("#")]
LEFT_OUT = {"soak"}  # extras without constraints
PLATFORMS = {"linux": ("Linux", "posix"), "darwin": ("Darwin", "posix"), "win32": ("Windows", "nt")}


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def needed() -> Iterator[Requirement]:
    document = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    extras = document["project"]["optional-dependencies"]
    of_extras = [line for name, lines in extras.items() if name not in LEFT_OUT for line in lines]
    for line in [*document["project"]["dependencies"], *document["build-system"]["requires"], *of_extras]:
        if not line.startswith("zsim["):
            yield Requirement(line)


def test_every_line_pins_a_version_and_none_has_an_address() -> None:
    found = [Requirement(line) for line in LINES]
    assert len(found) > 100
    for each in found:
        (only,) = each.specifier
        assert (only.operator, each.url, each.extras) == ("==", None, set())
    assert not any("://" in line or " @ " in line or line.startswith("-") for line in LINES)


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize("minor", [11, 12, 13, 14])
def test_each_package_has_one_version_that_zsim_accepts(minor: int, platform: str) -> None:
    system, os_name = PLATFORMS[platform]
    here = {"python_version": f"3.{minor}", "python_full_version": f"3.{minor}.7", "sys_platform": platform}
    here |= {"platform_system": system, "os_name": os_name, "implementation_version": f"3.{minor}.7"}
    held: dict[str, list[str]] = {}
    for each in map(Requirement, LINES):
        if each.marker is None or each.marker.evaluate(here):
            held.setdefault(canonical(each.name), []).append(next(iter(each.specifier)).version)
    assert {name: versions for name, versions in held.items() if len(versions) > 1} == {}
    for requirement in needed():
        if requirement.marker is None or requirement.marker.evaluate(here):
            (version,) = held.get(canonical(requirement.name), [""])
            assert version, requirement
            assert requirement.specifier.contains(version, prereleases=True), (requirement, version)
