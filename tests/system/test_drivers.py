"""Formations of which one drone is hardware: another world plays it, and its own wire joins the two."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from federation import Federation
from mixed_formation import SECOND_NS, Hardware, Mixed, true_rms


@pytest.fixture
def hardware(tmp_path: Path, compiled: None) -> Iterator[Hardware]:
    made = Hardware(tmp_path / "hardware")
    with made.federation:
        yield made


@pytest.fixture
def mixed(tmp_path: Path, compiled: None) -> Iterator[Mixed]:
    with Federation(tmp_path) as federation:
        yield Mixed(federation)


@pytest.mark.parametrize(
    "wire", ["px4", *(pytest.param(wire, marks=pytest.mark.soak) for wire in ("ardupilot", "ardrone"))]
)
def test_two_simulated_drones_and_one_of_hardware_fly_in_formation(hardware: Hardware, mixed: Mixed, wire: str) -> None:
    driver = mixed.drive("drone3", wire, hardware.serve(wire)[2])
    engaged_ns = mixed.engaged_ns()
    until_ns = mixed.engaged_ns(engaged_ns + 20 * SECOND_NS)
    link = mixed.links.now()[-1].message
    assert (link["state"], link["source"]) == ("armed", "driver.drone3")
    assert link["age_ms"] >= 0
    assert link["loss_percent"] is not None
    mixed.ends()
    driver.line("left")
    hardware.ends()
    rms = true_rms(mixed, hardware, ["drone3"], (engaged_ns / 1e9 + 8, until_ns / 1e9))
    assert max(rms["x_c"], rms["y_c"], rms["p"], rms["q"]) < 1.0  # m: the GPS alone has 2
    assert max(rms["z_c"], rms["yaw"], rms["beta"]) < 0.3


def test_a_driver_that_is_killed_in_flight_and_started_again_flies_on(hardware: Hardware, mixed: Mixed) -> None:
    ports = hardware.serve("px4")[2]
    driver = mixed.drive("drone3", "px4", ports)
    engaged_ns = mixed.engaged_ns()
    driver.signal(signal.SIGKILL)
    held = mixed.formation.until(lambda m: m["phase"] != "engaged" or "drone3" in m["reason"]).message
    mixed.drive("drone3", "px4", ports)
    mixed.engaged_ns(max(held["t_ns"], engaged_ns) + 5 * SECOND_NS)
    mixed.ends()
