"""Formations with one hardware drone, which a second world simulates behind the drone's own protocol."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from federation import Federation
from mixed_formation import EXTERNAL, PATIENT, SECOND_NS, SIMULATED, Hardware, Mixed, true_rms

PACE = ("--realtime", "--rate", "1")


@pytest.fixture
def hardware(tmp_path: Path, compiled: None) -> Iterator[Hardware]:
    made = Hardware(tmp_path / "hardware", SIMULATED + PATIENT, PACE)
    with made.federation:
        yield made


@pytest.fixture
def mixed(tmp_path: Path, compiled: None) -> Iterator[Mixed]:
    with Federation(tmp_path) as federation:
        yield Mixed(federation, EXTERNAL + PATIENT, PACE)


@pytest.mark.parametrize("wire", ["px4", pytest.param("ardupilot", marks=pytest.mark.soak)])
def test_two_simulated_drones_and_a_hardware_drone_fly_in_formation(
    hardware: Hardware, mixed: Mixed, wire: str
) -> None:
    """The formation engages again after the driver was killed in flight and restarted."""
    ports = hardware.serve(wire)[2]
    driver = mixed.drive("drone3", wire, ports)
    engaged_ns = mixed.engaged_ns()
    driver.signal(signal.SIGKILL)
    held = mixed.formation.until(lambda m: m["phase"] != "engaged" or "drone3" in m["reason"]).message
    driver = mixed.drive("drone3", wire, ports)
    again_ns = mixed.engaged_ns(max(held["t_ns"], engaged_ns) + SECOND_NS)
    until_ns = mixed.engaged_ns(again_ns + 8 * SECOND_NS)
    link = mixed.links.now()[-1].message
    assert (link["state"], link["source"]) == ("armed", "driver.drone3")
    assert link["age_ms"] >= 0
    assert link["loss_percent"] is not None
    mixed.ends()
    driver.line("left")
    hardware.ends()
    rms = true_rms(mixed, hardware, ["drone3"], (again_ns / 1e9 + 4, until_ns / 1e9), rate=1.0)
    assert max(rms["x_c"], rms["y_c"], rms["p"], rms["q"]) < 1.0  # m; the GPS alone errs by 2 m
    assert max(rms["z_c"], rms["yaw"], rms["beta"]) < 0.3
