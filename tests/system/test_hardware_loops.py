"""Test 1 of the paper with hardware drones (played by a second world) and without, and the effects of a cut link."""

import math
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from federation import Federation
from mavlink_programs import free_udp_ports
from mixed_formation import SECOND_NS, Hardware, Mixed, Radio, true_rms

from zsim_analysis.reading.formation import formations_of
from zsim_analysis.reading.recorded_flight import read_flight

pytestmark = [pytest.mark.soak, pytest.mark.slow]

STEP = Path(__file__).parents[2] / "scenarios" / "step.yaml"
WINDOW_S = (120.0, 320.0)
DRONES = ("drone1", "drone2", "drone3")
LANDS_S = 4.0  # 2 s of com_watchdog and 2 s of hovering
MOST = 1.3  # maximum ratio to the errors without hardware drones
AS_ONE = {"p": ("p", "q"), "x_c": ("x_c", "y_c"), "roll": ("roll", "pitch")}  # errors of the same kind, combined
JUDGED = ("x_c", "z_c", "roll", "yaw", "p", "beta")
RADIO = {"a wire": (0.0, 0.0, 0.0), "a radio": (20.0, 10.0, 0.02)}  # simulated delay and jitter in ms, packet loss


def kinds(rms: dict[str, float]) -> dict[str, float]:
    """Return the judged errors, with those of the same kind combined."""
    return {name: math.hypot(*(rms[each] for each in AS_ONE.get(name, (name,)))) for name in JUDGED}


@pytest.fixture(scope="module")
def direct(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> dict[str, float]:
    """The RMS errors of Test 1 without hardware drones."""
    with Federation(tmp_path_factory.mktemp("direct")) as federation:
        federation.run(STEP.read_text(), "--in-process").ends(with_code=0)
        (formation,) = formations_of(read_flight(federation.out / "run.mcap"))
    rows = formation.true_error[formation.within(WINDOW_S)]
    return kinds(dict(zip(formation.names, np.sqrt(np.mean(rows**2, axis=0)).tolist(), strict=True)))


@pytest.mark.parametrize("external", [("drone3",), DRONES], ids=["one", "all"])
@pytest.mark.parametrize("radio", RADIO)
@pytest.mark.parametrize("wire", ["px4", "ardrone"])
def test_test_1_has_similar_errors_with_hardware_drones(
    tmp_path: Path, direct: dict[str, float], wire: str, radio: str, external: tuple[str, ...]
) -> None:
    # AT commands are 15 to 30 ms of wall time apart, so twice real time would halve their number per flight.
    rate = 2.0 if wire == "px4" and len(external) > 1 else 1.0
    pace = ("--realtime", "--rate", f"{rate:g}")
    delay_ms, jitter_ms, loss = RADIO[radio]
    hardware = Hardware(tmp_path / "hardware", STEP.read_text(), (*pace, "--duration", "3600"))
    sets = [word for drone in external for word in ("--set", f"drones.{drone}.body=external")]
    with hardware.federation, Federation(tmp_path) as federation:
        served = hardware.serve(wire)
        link, ports = through_radio(wire, served, (delay_ms / rate, jitter_ms / rate, loss))
        with closing(link):
            mixed = Mixed(federation, STEP.read_text(), (*pace, *sets))
            for drone in external:
                mixed.drive(drone, wire, ports[DRONES.index(drone)])
            mixed.run.ends(with_code=0, within_s=600)
            hardware.ends()
        rms = kinds(true_rms(mixed, hardware, external, WINDOW_S, rate))
    ratios = {name: rms[name] / direct[name] for name in JUDGED}
    print({name: f"{rms[name]:.4f} ({ratios[name]:.2f})" for name in JUDGED})
    assert max(ratios.values()) <= MOST, ratios


def through_radio(
    wire: str, served: list[list[str]], radio: tuple[float, float, float]
) -> tuple[Radio, list[list[str]]]:
    """Return a radio link to some aircraft and the addresses that reach them through it."""
    if wire == "ardrone":
        ports = [[re.sub(r"^127\.(\d+)", lambda m: f"127.{int(m[1]) + 100}", each) for each in own] for own in served]
    else:
        first = free_udp_ports(len(served))
        ports = [[f"127.0.0.1:{first + i}"] for i in range(len(served))]
    pairs = [
        f"{here}={there}"
        for own, others in zip(ports, served, strict=True)
        for here, there in zip(own, others, strict=True)
    ]
    return Radio(pairs, *radio), ports


class Flight:
    """An engaged mixed formation with drone3 behind a radio."""

    def __init__(self, mixed: Mixed, hardware: Hardware, radio: Radio) -> None:
        self.mixed, self.radio = mixed, radio
        self.aircraft = hardware.federation.client().subscribe("drone/drone3/sensor/status")

    def states(self) -> list[str]:
        """Return the states of the aircraft since the last call, without consecutive repetitions."""
        seen: list[str] = []
        for received in self.aircraft.now():
            if seen[-1:] != [received.message["state"]]:
                seen.append(received.message["state"])
        self.aircraft.received.clear()
        return seen


@pytest.fixture
def flown(tmp_path: Path, compiled: None, request: Any) -> Iterator[Flight]:
    hardware = Hardware(tmp_path / "hardware")
    with hardware.federation, Federation(tmp_path) as federation:
        served = hardware.serve(request.param)
        radio, ports = through_radio(request.param, served, (0.0, 0.0, 0.0))
        with closing(radio):
            mixed = Mixed(federation)
            mixed.drive("drone3", request.param, ports[2])
            mixed.engaged_ns(mixed.engaged_ns() + 5 * SECOND_NS)
            yield Flight(mixed, hardware, radio)


@pytest.mark.parametrize("flown", ["px4", "ardupilot"], indirect=True)
@pytest.mark.parametrize("cut_s", [1.0, 3.0, 10.0])
def test_a_mavlink_vehicle_holds_during_a_cut_and_flies_on_after_it(flown: Flight, cut_s: float) -> None:
    flown.states()
    flown.radio.cut(cut_s / 2)
    now_ns = flown.mixed.formation.until(lambda m: True).message["t_ns"]
    flown.mixed.engaged_ns(now_ns + 5 * SECOND_NS)
    assert set(flown.states()) <= {"flying", "hovering"}
    assert flown.mixed.links.now()[-1].message["state"] == "armed"
    flown.mixed.ends()


@pytest.mark.parametrize("flown", ["ardrone"], indirect=True)
@pytest.mark.parametrize("cut_s", [1.0, 3.0, 10.0])
def test_an_ardrone_flies_on_after_a_short_cut_and_lands_during_a_long_one(flown: Flight, cut_s: float) -> None:
    flown.states()
    flown.radio.cut(cut_s / 2)
    if cut_s < LANDS_S:
        now_ns = flown.mixed.formation.until(lambda m: True).message["t_ns"]
        flown.mixed.engaged_ns(now_ns + 5 * SECOND_NS)
        assert set(flown.states()) <= {"flying", "hovering"}
    else:
        flown.mixed.until("landed", flown.mixed.status.now()[-1].message["t_ns"])
        assert flown.states()[-2:] == ["landing", "landed"]
