"""The wheelhouse: its key, the requests to pip, and that nothing is fetched or built twice."""

import asyncio
import errno
import os
import socket
import tarfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from refused import has_terms, refused

from zsim.errors import HostsError
from zsim_deploy.hosts import wheelhouse
from zsim_deploy.hosts.wheelhouse import (
    Wheelhouse,
    WheelSet,
    WheelTarget,
    download_wheels,
    pip,
    requirement,
    wheel_target,
)

BACKEND = """
# A build backend without dependencies: a wheel with one module.
import zipfile

def build_wheel(folder, config_settings=None, metadata_directory=None):
    with zipfile.ZipFile(f"{{folder}}/{name}-1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr("{name}.py", "")
        wheel.writestr("{name}-1.0.dist-info/METADATA", "Metadata-Version: 2.1\\nName: {name}\\nVersion: 1.0\\n{needs}")
        wheel.writestr("{name}-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n")
        wheel.writestr("{name}-1.0.dist-info/RECORD", "{name}.py,,\\n")
    return "{name}-1.0-py3-none-any.whl"
"""
PYPROJECT = """
[build-system]
requires = []
build-backend = "backend"
backend-path = ["."]
[tool.hatch.build.targets.wheel]
packages = ["source"]
"""
NEEDS = "Requires-Dist: gadget; extra == 'agents'\\nProvides-Extra: agents\\n"
ELSEWHERE = WheelTarget((3, 12), "cp312", ("manylinux_2_31_aarch64", "linux_aarch64"))


def write_project(folder: Path, name: str, needs: str = "") -> Path:
    """Write a project that builds without an index."""
    (folder / "source").mkdir(parents=True)
    texts = {"pyproject.toml": PYPROJECT, "backend.py": BACKEND.format(name=name, needs=needs), "README.md": ""}
    for file, text in {**texts, "PKG-INFO": f"Name: {name}\n", "source/flight.py": "height_m = 4\n"}.items():
        (folder / file).write_text(text)
    return folder


def write_wheel(index: Path, name: str) -> None:
    """Put a wheel of the given name into an index."""
    backend: dict[str, Any] = {}
    exec(BACKEND.format(name=name, needs=""), backend)
    backend["build_wheel"](index)


@pytest.fixture
def index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the only folder that pip searches, with a wheel of pip 1.0 and gadget 1.0 as sources only."""
    folder = tmp_path / "index"
    gadget = write_project(folder / "gadget-1.0", "gadget")
    with tarfile.open(folder / "gadget-1.0.tar.gz", "w:gz") as archive:
        archive.add(gadget, gadget.name)
    write_wheel(folder, "pip")
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))
    return folder


@pytest.fixture
def checkout(index: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a checkout of a project whose extra `agents` needs gadget; the index has a wheel of gadget."""
    write_wheel(index, "gadget")
    folder = write_project(tmp_path / "checkout", "zsim", NEEDS)
    monkeypatch.setattr(wheelhouse, "checkout", lambda: folder)
    return folder


def test_other_versions_than_the_local_ones_are_taken_only_if_necessary(index: Path, tmp_path: Path) -> None:
    """A project without wheels is built on this machine, even for another target."""

    def download(*held: str) -> bool:
        into = tmp_path / " ".join(held)
        limits = [[each] for each in held]
        others = asyncio.run(download_wheels(["gadget"], ELSEWHERE, into, limits, tmp_path / "kept", print))
        assert [path.name for path in into.glob("*.whl")] == ["gadget-1.0-py3-none-any.whl"]
        return others

    assert not download("gadget==1.0")
    write_wheel(index, "gadget")  # from here on, nothing is built
    assert download("gadget==0.9")
    assert download("gadget==0.9", "gadget==1.0")


def house(folder: Path, extras: list[str], host: str = "h") -> tuple[WheelSet, list[str]]:
    """Return a wheel set of the wheelhouse in a folder, and the lines printed meanwhile."""
    lines: list[str] = []
    return asyncio.run(Wheelhouse(folder, lines.append).wheel_set(host, ELSEWHERE, extras)), lines


def test_a_wheel_set_has_what_a_host_needs_and_is_gathered_once(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lost wheel causes another gathering, and a changed file the build of the project alone.

    Wheels that are kept need no index, even if other packages have since been installed on this machine, which
    changes the key of the set.
    """
    first, lines = house(tmp_path / "cache", ["agents"])
    wheels = (first.project, first.pip, *first.others)
    assert [wheel.path.name.partition("-")[0] for wheel in wheels] == ["zsim", "pip", "gadget"]
    assert first.extras == ("agents",)
    building, gathering = lines
    assert has_terms(building, "building", "zsim")
    assert has_terms(gathering, "gathering", str(ELSEWHERE), "agents")
    again, lines = house(tmp_path / "cache", ["agents"])
    assert (again, lines) == (first, [])
    first.others[0].path.unlink()
    second, lines = house(tmp_path / "cache", ["agents"])
    assert lines == [gathering]
    assert second.others[0].path.exists()
    (checkout / "source/flight.py").write_text("height_m = 5\n")
    third, lines = house(tmp_path / "cache", ["agents"])
    assert lines == [building]
    assert third.project.path != second.project.path
    assert third.pip == second.pip
    nowhere(monkeypatch)
    monkeypatch.setattr(wheelhouse, "constraints", lambda: ["gadget==1.0", "widget==2.0"])
    again, lines = house(tmp_path / "cache", ["agents"])
    assert (again, lines) == (third, [gathering])


def test_a_missing_wheel_is_reported_with_host_package_and_system(no_gadget: None, tmp_path: Path) -> None:
    with refused(HostsError, "onboard1", "gadget", str(ELSEWHERE), "PIP_FIND_LINKS"):
        house(tmp_path / "cache", ["agents"], "onboard1")


def test_a_project_that_cannot_be_built_is_reported_in_one_line(checkout: Path, tmp_path: Path) -> None:
    (checkout / "backend.py").write_text("raise ImportError('no backend')\n")
    with refused(HostsError, "launcher", "zsim", str(checkout)) as raised:
        house(tmp_path / "cache", [])
    assert "\n" not in str(raised.value)


@pytest.fixture
def no_gadget(index: Path, checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Remove every version of gadget."""
    monkeypatch.setattr(wheelhouse, "constraints", list)
    (index / "gadget-1.0.tar.gz").unlink()
    (index / "gadget-1.0-py3-none-any.whl").unlink()


@pytest.fixture
def no_index(index: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Add an index that refuses connections to the folder."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    monkeypatch.delenv("PIP_NO_INDEX")
    monkeypatch.setenv("PIP_INDEX_URL", f"http://127.0.0.1:{port}/simple")


def test_an_unreachable_index_is_not_reported_as_a_missing_wheel(
    no_gadget: None, no_index: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[str, ...]] = []

    async def counted(*arguments: str, **options: Any) -> None:
        calls.append(arguments)
        await pip(*arguments, **options)

    monkeypatch.setattr(wheelhouse, "pip", counted)
    lines: list[str] = []
    kept = Wheelhouse(tmp_path / "cache", lines.append)
    for _ in range(2):
        with pytest.raises(HostsError) as caught:
            asyncio.run(kept.wheel_set("h", ELSEWHERE, ["agents"]))
        remedy = "PIP_NO_INDEX=1", "PIP_FIND_LINKS=FOLDER"
        assert has_terms(str(caught.value), "launcher", "index", os.strerror(errno.ECONNREFUSED), *remedy)
    assert [arguments[0] for arguments in calls] == ["wheel", "download"]
    assert has_terms(lines[-1], "index", os.strerror(errno.ECONNREFUSED), "once more")


def nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give pip an index that refuses connections and no folder."""
    monkeypatch.delenv("PIP_NO_INDEX", raising=False)
    monkeypatch.delenv("PIP_FIND_LINKS")
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:1/simple")  # tcpmux, on which nothing listens


@pytest.mark.soak
def test_the_build_requirements_of_the_project_are_kept(
    checkout: Path, index: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (checkout / "pyproject.toml").write_text(PYPROJECT.replace("requires = []", 'requires = ["gadget"]'))
    house(tmp_path / "cache", [])
    nowhere(monkeypatch)
    (checkout / "source/flight.py").write_text("height_m = 5\n")
    _, lines = house(tmp_path / "cache", [])
    (line,) = lines
    assert has_terms(line, "building", "zsim")


def test_wheels_in_a_folder_need_no_index(checkout: Path, no_index: None, tmp_path: Path) -> None:
    assert house(tmp_path / "cache", ["agents"])[0].others


@pytest.mark.parametrize(
    ("shown", "terms"),
    [
        ("\"HTTPSConnection(host='a.b', port=443): Failed to resolve 'a.b' ([Errno -2] Name or service not known)\"", ("'a.b'", 'known')),
        ("'<pip._vendor.urllib3.connection.HTTPSConnection object at 0x7f>, 'Connection to a.b timed out. (connect timeout=15)'", ('a.b', 'timeout=15')),
        ("'Cannot connect to proxy.', OSError('Tunnel connection failed: 403 Forbidden')", ('403',)),
    ],
)  # fmt: skip
def test_the_reason_of_an_unreachable_index_is_extracted(shown: str, terms: tuple[str, ...]) -> None:
    assert has_terms(wheelhouse._reason(shown), *terms)


@pytest.mark.parametrize(
    ("origin", "wanted"),
    [
        ("", "zsim==0.1.0"),
        ('{"url": "file:///tmp/zsim.whl", "archive_info": {}}', "zsim @ file:///tmp/zsim.whl"),
        (
            '{"url": "https://host/zsim.git", "vcs_info": {"vcs": "git", "commit_id": "abc"}}',
            "zsim @ git+https://host/zsim.git@abc",
        ),
    ],
)
def test_an_installed_distribution_is_required_from_its_origin(origin: str, wanted: str) -> None:
    installed: Any = SimpleNamespace(version="0.1.0", read_text={"direct_url.json": origin}.get)
    assert requirement(installed) == wanted


SAID = {
    "version": [3, 12],
    "implementation": "cpython",
    "free_threaded": False,
    "platform": "linux-aarch64",
    "libc": ["glibc", "2.31"],
}


def test_linux_takes_wheels_up_to_its_glibc_and_macos_its_own() -> None:
    aim = wheel_target("h", SAID)
    assert (aim.version, aim.abi) == ((3, 12), "cp312")
    assert aim.platforms[0] == "manylinux_2_31_aarch64"
    assert {"manylinux_2_17_aarch64", "manylinux2014_aarch64", "linux_aarch64"} <= set(aim.platforms)
    assert "manylinux_2_32_aarch64" not in aim.platforms
    assert has_terms(str(aim), "3.12", "manylinux_2_31_aarch64")
    mac = wheel_target("h", {**SAID, "platform": "macosx-14.2-arm64", "libc": ["", ""], "free_threaded": True})
    assert (mac.platforms, mac.abi) == (("macosx_14_2_arm64",), "cp312t")


@pytest.mark.parametrize(
    ("other", "terms"),
    [
        ({"implementation": "pypy"}, ("h", "pypy", "CPython")),
        ({"libc": ["", ""]}, ("h", "linux-aarch64", "glibc", "macOS")),
        ({"platform": "win-amd64"}, ("h", "win-amd64", "glibc 2.31", "glibc", "macOS")),
    ],
)  # fmt: skip
def test_a_system_without_wheels_is_refused(other: dict[str, object], terms: tuple[str, ...]) -> None:
    with refused(HostsError, *terms):
        wheel_target("h", {**SAID, **other})
