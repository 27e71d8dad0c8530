"""Formations with hardware drones, which a second world plays and which are connected by their own protocols."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ardrone_clients import addresses
from federation import Federation, Role
from loop_truth import true_formation
from mavlink_programs import free_udp_ports
from wire import Client, Subscription

FORMATION = """
name: mixed
seed: 4
duration_s: 600
sensors: {preset: paper}
environment: {wind: {gust_m_s: 0.3}}
drones:
  - {name: drone1, position_m: [0.0, 2.0, 0.0], yaw_deg: 90}
  - {name: drone2, position_m: [-2.0, -2.0, 0.0], yaw_deg: 90}
  - {name: drone3, position_m: [2.0, -2.0, 0.0], yaw_deg: 90BODY}
clusters:
  - {name: main, drones: [drone1, drone2, drone3], plan: {takeoff_s: 8}}
"""
"""Three drones that take off once the estimators have determined their positions."""
PATIENT = "silence: {hover_s: 5, land_s: 60}\n"
"""Part of a scenario whose drones must not land because a loaded machine pauses."""
EXTERNAL, SIMULATED = FORMATION.replace("BODY", ", body: external"), FORMATION.replace("BODY", "")
UNFLOWN = """
name: unflown
duration_s: 36000
drones:
  - {name: drone1, position_m: [0, 0, 0]}
  - {name: drone2, position_m: [4, 0, 0], body: external}
processes: {expect: []}
"""
"""A simulated and a hardware drone, which no process commands."""
PACE = ("--realtime", "--rate", "2")
SECOND_NS = 1_000_000_000
DRONES = 3
RELAY = Path(__file__).parent / "udp_relay.py"
AT_AND_NAVDATA = (5554, 5556)


class Radio:
    """A link with delay, jitter and loss, that can be cut."""

    def __init__(self, pairs: Sequence[str], delay_ms: float = 0.0, jitter_ms: float = 0.0, loss: float = 0.0) -> None:
        command = [sys.executable, str(RELAY), str(delay_ms), str(jitter_ms), str(loss), "1", *pairs]
        self._process: Any = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout.readline() == "ready\n"

    def cut(self, wall_s: float) -> None:
        """Cut the link for a while; return once it is restored."""
        self._process.stdin.write(f"cut {wall_s}\n")
        self._process.stdin.flush()
        assert self._process.stdout.readline() == "done\n"

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._process.stdin.close()
        self._process.stdout.close()


class Hardware:
    """A world whose drones are served by the protocols of real aircraft, and its record.

    Args:
        folder: folder for this world alone.
        scenario: scenario of the drones; its clusters are omitted.
        pace: options that set the pace of the run.
    """

    def __init__(self, folder: Path, scenario: str = SIMULATED, pace: tuple[str, ...] = PACE) -> None:
        self.federation = Federation(folder)
        alone = ("--set", "clusters=[]", "--set", "processes.expect=[recorder]")
        folder.mkdir(parents=True, exist_ok=True)
        self.world = self.federation.world(scenario, *pace, *alone)
        self.recorder = self.federation.role("record", "--out", str(self.federation.out))

    def serve(self, wire: str) -> list[list[str]]:
        """Serve the drones by a protocol (px4, ardupilot, ardrone); return each drone's ports as HOST:PORT."""
        return self._ardrone() if wire == "ardrone" else self._mavlink(wire)

    def _mavlink(self, autopilot: str) -> list[list[str]]:
        api, gcs, api_local, gcs_local = (free_udp_ports(DRONES) for _ in range(4))
        ports = ("--api", f"127.0.0.1:{api}", "--gcs", f"127.0.0.1:{gcs}", "--autopilot", autopilot)
        local = ("--api-local", str(api_local), "--gcs-local", str(gcs_local))
        self.federation.start("mavlink", "serve", "--connect", self.federation.endpoint, *ports, *local).line(
            "programs"
        )
        return [[f"127.0.0.1:{api_local + i}"] for i in range(DRONES)]

    def _ardrone(self) -> list[list[str]]:
        hosts = addresses(DRONES)
        served = self.federation.start(
            "ardrone", "serve", "--connect", self.federation.endpoint, "--addresses", hosts[0]
        )
        served.line(f"is an AR.Drone 2.0 at {hosts[-1]}")
        return [[f"{host}:{port}" for port in AT_AND_NAVDATA] for host in hosts]

    def ends(self) -> None:
        """End the run with a complete record."""
        assert self.federation.client().request("world/control", "stop")["ok"]
        self.recorder.ends(with_code=0)


class Mixed:
    """The run that includes the hardware drones.

    Args:
        federation: federation of this run alone.
        scenario: scenario of the run.
        pace: options that set the pace of the run.
    """

    def __init__(self, federation: Federation, scenario: str = EXTERNAL, pace: tuple[str, ...] = PACE) -> None:
        self.federation = federation
        self.run: Role = federation.run(scenario, *pace)
        self.client: Client = federation.client()
        self.formation: Subscription = self.client.subscribe("cluster/main/state")
        self.status: Subscription = self.client.subscribe("drone/drone3/sensor/status")
        self.links: Subscription = self.client.subscribe("drone/drone3/link")

    def drive(self, drone: str, wire: str, ports: Sequence[str], *options: str) -> Role:
        """Start the driver of a drone, armed, on the ports of its aircraft."""
        host = ports[0].rpartition(":")[0]
        how = (
            ("ardrone", "drive", drone, host) if wire == "ardrone" else ("mavlink", "drive", drone, f"udp://{ports[0]}")
        )
        return self.federation.start(*how, "--connect", self.federation.endpoint, "--armed", "--speed", "3", *options)

    def engaged_ns(self, after_ns: int = 0) -> int:
        """Wait until the formation is engaged; return the time [ns]."""
        return self.formation.until(lambda m: m["phase"] == "engaged" and m["t_ns"] > after_ns).message["t_ns"]

    def until(self, state: str, after_ns: int = 0) -> int:
        """Wait for a state of drone3; return the time [ns]."""
        return self.status.until(lambda m: m["state"] == state and m["t_ns"] > after_ns).message["t_ns"]

    def ends(self) -> None:
        """Land and end the run."""
        assert self.client.request("cluster/main/control", "land")["ok"]
        self.until("landing")
        self.until("landed")
        assert self.client.request("world/control", "stop")["ok"]
        self.run.ends(with_code=(0, 1))  # 1 if the formation was held for long, for instance while a driver was absent


def true_rms(
    mixed: Mixed, hardware: Hardware, drones: Sequence[str], window_s: tuple[float, float], rate: float = 2.0
) -> dict[str, float]:
    """Return the RMS errors of the true formation, with the truth of `drones` from the hardware's record."""
    records = (mixed.federation.out / "run.mcap", hardware.federation.out / "run.mcap")
    formation = true_formation(*records, drones, rate)
    rows = formation.true_error[formation.within(window_s)]
    return dict(zip(formation.names, np.sqrt(np.mean(rows**2, axis=0)).tolist(), strict=True))
