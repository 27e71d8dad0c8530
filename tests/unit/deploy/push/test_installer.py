"""The Python of a host that is taken, and what pip is asked for it."""

import subprocess

import pytest
from refused import has_terms, refused

from zsim.errors import HostsError
from zsim_deploy.push.installer import (
    Interpreter,
    choose_interpreter,
    interpreter_query,
    parse_interpreters,
    wheel_target,
)

HERE = (3, 11)
SAID = {
    "version": [3, 12],
    "implementation": "cpython",
    "free_threaded": False,
    "platform": "linux-aarch64",
    "libc": ["glibc", "2.31"],
}


def found(**versions: str) -> list[Interpreter]:
    """Return interpreters: python3_12="3.12.1" is the command python3.12."""
    lines = (f"{name.replace('_', '.')} {version} /usr/bin/{name}" for name, version in versions.items())
    return parse_interpreters("\n".join(lines))


def test_the_launchers_minor_version_is_taken_as_python3_where_it_is_that() -> None:
    several = found(python3="3.13.2", python3_12="3.12.1", python3_11="3.11.9")
    assert choose_interpreter("h", several, HERE).command == "python3.11"
    assert choose_interpreter("h", found(python3="3.11.2", python3_11="3.11.9"), HERE).command == "python3"


@pytest.mark.parametrize(
    ("there", "terms"),
    [
        (found(python3="3.9.2"), ("python3 3.9.2", "3.11", "python3.11")),
        (found(python3="3.13.2", python3_13="3.13.2", python3_12="3.12.1"), ("python3.12 3.12.1", "python3 3.13.2", "3.11")),
        ([], ("python3", "3.11", "python3.11")),
    ],
)  # fmt: skip
def test_a_python_of_another_minor_version_is_a_line_before_anything_is_copied(
    there: list[Interpreter], terms: tuple[str, ...]
) -> None:
    """No run takes a host with another one."""
    with refused(HostsError, "onboard1", *terms):
        choose_interpreter("onboard1", there, HERE)


def test_the_question_finds_the_pythons_of_a_machine() -> None:
    answer = subprocess.run(["sh", "-c", interpreter_query()], capture_output=True, text=True, check=True).stdout
    assert parse_interpreters(answer)
    for each in parse_interpreters(answer):
        version = subprocess.run([each.path, "--version"], capture_output=True, text=True, check=True).stdout
        assert version.strip() == f"Python {'.'.join(map(str, each.version))}"


def test_a_greeting_of_the_login_shell_is_no_python() -> None:
    output = "Welcome to lab\nlast login 3.11.2 today\n\npython3 3.11.2 /usr/bin/python3\npython3.12 is here\n"
    assert parse_interpreters(output) == [Interpreter("python3", (3, 11, 2), "/usr/bin/python3")]


def test_linux_takes_the_wheels_of_its_glibc_and_of_older_ones() -> None:
    aim = wheel_target("h", SAID)
    assert (aim.version, aim.abi) == ((3, 12), "cp312")
    assert aim.platforms[0] == "manylinux_2_31_aarch64"
    assert {"manylinux_2_17_aarch64", "manylinux2014_aarch64", "linux_aarch64"} <= set(aim.platforms)
    assert "manylinux_2_32_aarch64" not in aim.platforms
    assert has_terms(str(aim), "3.12", "manylinux_2_31_aarch64")


def test_a_mac_and_a_free_threaded_python() -> None:
    mac = wheel_target("h", {**SAID, "platform": "macosx-14.2-arm64", "libc": ["", ""], "free_threaded": True})
    assert mac.platforms == ("macosx_14_2_arm64",)
    assert mac.abi == "cp312t"


@pytest.mark.parametrize(
    ("other", "terms"),
    [
        ({"implementation": "pypy"}, ("h", "pypy", "CPython")),
        ({"libc": ["", ""]}, ("h", "linux-aarch64", "glibc", "macOS")),
        ({"platform": "win-amd64"}, ("h", "win-amd64", "glibc 2.31", "glibc", "macOS")),
    ],
)  # fmt: skip
def test_what_wheels_are_not_made_for_is_a_line(other: dict[str, object], terms: tuple[str, ...]) -> None:
    with pytest.raises(HostsError) as caught:
        wheel_target("h", {**SAID, **other})
    assert has_terms(str(caught.value), *terms)
