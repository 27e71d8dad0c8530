"""What `zsim doctor` makes of what hosts say; and the probe's round trip and bandwidth over loopback."""

import platform
import socket
import threading

import pytest

from zsim import __version__
from zsim_deploy import probe
from zsim_deploy.doctor import Path, Report, compared, path_faults

SOUND = {
    "python": platform.python_version(),
    "zsim": __version__,
    "fingerprint": "a" * 16,
    "cores": 2,
    "load": 0.1,
    "governors": ["performance"],
    "free_bytes": 50_000_000_000,
    "time_ns": 0,
}


def report(offset_s: float = 0.0, **changes) -> Report:
    return Report({**SOUND, **changes}, round_trip_s=0.01, clock_offset_s=offset_s)


def test_sound_hosts_raise_nothing():
    assert compared({"h1": report(), "h2": report()}) == ([], [])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"zsim": "0.0.1"}, f"h1: zsim is 0.0.1; must be {__version__} as here"),
        ({"python": "3.9.2"}, "h1: Python is 3.9.2; must be"),
    ],
)
def test_another_version_is_a_fault(changes, says):
    faults, _ = compared({"h1": report(**changes), "h2": report()})
    assert [line.startswith(says) for line in faults] == [True]


@pytest.mark.parametrize(
    ("found", "says"),
    [
        (report(offset_s=3600.0), "h1: its clock is +3600.0 s off"),
        (report(load=1.9), "h1: load is 1.9 on 2 cores"),
        (report(governors=["powersave"]), "h1: the CPU governor is powersave"),
        (report(free_bytes=10_000_000), "h1: 0.0 GB are free on its disk"),
        (
            report(fingerprint="b" * 16),
            "the hosts compute with different numeric fingerprints (h1 bbbbbbbb, h2 aaaaaaaa)",
        ),
    ],
)
def test_what_slows_or_differs_is_a_warning(found, says):
    faults, warnings = compared({"h1": found, "h2": report()})
    assert faults == []
    assert [line.startswith(says) for line in warnings] == [True]


def test_a_path_that_is_not_there_is_a_fault_and_a_slow_one_a_warning():
    faults, slow = path_faults(
        [
            Path("h2", "h1", 7447, {"error": "Connection refused"}),
            Path("h3", "h1", 7447, {"round_trip_s": 0.1, "bits_per_s": 2e6}),
            Path("h4", "h1", 7447, {"round_trip_s": 0.001, "bits_per_s": 2e9}),
        ]
    )
    assert len(faults) == 1
    assert faults[0].startswith("h2: port 7447 of h1 cannot be reached (Connection refused)")
    assert slow == ["h3 reaches h1 at 2.0 Mbit/s only"]


def test_the_probe_measures_what_answers():
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            with server.accept()[0] as connection:
                probe._answer(connection)

        thread = threading.Thread(target=answer)
        thread.start()
        found = probe.reach("127.0.0.1", server.getsockname()[1])
        thread.join()
    assert found["round_trip_s"] > 0.0
    assert found["bits_per_s"] > 1e6


def test_the_probe_says_why_nothing_answers():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    assert "refused" in probe.reach("127.0.0.1", port)["error"]


def test_governors_are_read_where_the_system_tells(tmp_path):
    for cpu, text in (("cpu0", "powersave\n"), ("cpu1", "performance\n")):
        folder = tmp_path / cpu / "cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text(text)
    assert probe.governors(tmp_path) == ["performance", "powersave"]
    assert probe.governors(tmp_path / "nowhere") == []
