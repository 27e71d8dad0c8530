"""An AR.Drone modelled as a point that tilts as commanded, for tests of the driver; only the codec is zsim's."""

import math
from typing import Any

from zsim_bridges.ardrone import at_commands, navdata
from zsim_bridges.ardrone.navdata import GPS_TAG, LAYOUTS, TAGS_BY_NAME

STEP_NS = 5_000_000
G = 9.80665
DRAG_1_S = 0.58
TILT_LAG_S = 0.14
LANDED, FLYING, HOVERING, TAKING_OFF, LANDING = 2, 3, 4, 6, 8
ACK, BOOTSTRAP, EMERGENCY = 1 << 6, 1 << 11, 1 << 31
FIELD_UT = (-2.8, 17.8, 14.0)


class FakeAircraft:
    """One aircraft; in packets x is forward and y right; yaw [rad] is counter-clockwise from east.

    Attributes:
        position: [m; W].
        velocity: [m/s; W].
        wind_m_s2: acceleration by the wind [m/s^2; W].
        config: entries of its configuration.
        names: names of the AT commands received.
    """

    def __init__(self, yaw: float = 1.0) -> None:
        self.position, self.velocity, self.yaw = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], yaw
        self.boot_yaw = yaw
        self.tilt = [0.0, 0.0]  # forward, left
        self.wind_m_s2 = (0.0, 0.0)
        self.state, self.bits = LANDED, BOOTSTRAP
        self.config: dict[str, str] = {}
        self.names: list[str] = []
        self.has_client = False
        self._pcmd = at_commands.Pcmd(0, 0, 0.0, 0.0, 0.0, 0.0)
        self._sequence = 0
        self._newest = -1
        self._toggle = False

    def receive(self, channel: int, datagram: bytes) -> None:
        if channel == 0:
            self.has_client = True
            return
        parsed = at_commands.parse(datagram)
        assert parsed.refusals == []
        for command in parsed.commands:
            assert command.sequence > self._newest
            self._newest = command.sequence
            self.names.append(type(command).__name__)
            self._on_command(command)

    def _on_command(self, command: Any) -> None:
        match command:
            case at_commands.Config():
                self.config[command.key] = command.value
                self.bits = (self.bits | ACK) & ~BOOTSTRAP
            case at_commands.Control() if command.mode == 5:
                self.bits &= ~ACK
            case at_commands.Pcmd():
                self._pcmd = command
            case at_commands.Ref():
                if command.emergency and not self._toggle:
                    self.bits ^= EMERGENCY
                self._toggle = command.emergency
                if self.bits & EMERGENCY:
                    self.state = LANDED
                elif command.takes_off and self.state == LANDED:
                    self.state = TAKING_OFF
                elif not command.takes_off and self.state in (FLYING, HOVERING, TAKING_OFF):
                    self.state = LANDING

    def step(self, now_ns: int) -> bytes | None:
        """Advance by a step; return the packet that it sends, if any."""
        self._move(STEP_NS * 1e-9)
        self._sequence += 1
        if not self.has_client:
            return None
        if self.bits & BOOTSTRAP:
            return navdata.pack(self.bits, self._sequence, 0)
        return navdata.pack(self.bits, self._sequence, 0, self._options(now_ns))

    def _move(self, dt: float) -> None:
        climb = {TAKING_OFF: 0.5, LANDING: -0.5}.get(self.state, 0.0)
        wanted = (0.0, 0.0)
        if self.state in (FLYING, HOVERING):
            progressive = self._pcmd.flag & 1
            self.state = FLYING if progressive else HOVERING
            most = math.tan(float(self.config["control:euler_angle_max"]))
            wanted = (-self._pcmd.pitch * most, -self._pcmd.roll * most) if progressive else (0.0, 0.0)
            climb = self._pcmd.gaz * float(self.config["control:control_vz_max"]) / 1e3 if progressive else 0.0
            self.yaw -= self._pcmd.yaw * float(self.config["control:control_yaw"]) * dt if progressive else 0.0
        for axis in (0, 1):
            self.tilt[axis] += (wanted[axis] - self.tilt[axis]) * dt / TILT_LAG_S
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        accel = G * (self.tilt[0] * c - self.tilt[1] * s), G * (self.tilt[0] * s + self.tilt[1] * c)
        for axis in (0, 1):
            flies = self.position[2] > 0.0
            self.velocity[axis] += dt * (accel[axis] - DRAG_1_S * self.velocity[axis] + self.wind_m_s2[axis]) * flies
            self.position[axis] += dt * self.velocity[axis]
        self.velocity[2] = climb
        self.position[2] = max(0.0, self.position[2] + dt * climb)
        if self.state == TAKING_OFF and self.position[2] >= 1.0:
            self.state = HOVERING
        if self.state == LANDING and self.position[2] == 0.0:
            self.state, self.velocity = LANDED, [0.0, 0.0, 0.0]

    def _options(self, now_ns: int):
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        vx, vy, vz = self.velocity
        forward, left = vx * c + vy * s, vy * c - vx * s
        demo = (
            LAYOUTS[0]
            .zeros()
            ._replace(
                ctrl_state=self.state << 16,
                battery_percent=66,
                psi_mdeg=-1e3 * math.degrees(self.yaw - self.boot_yaw),
                altitude_mm=round(1e3 * self.position[2]),
                vx_mm_s=1e3 * forward,
                vy_mm_s=-1e3 * left,
                vz_mm_s=-1e3 * vz,
            )
        )
        seconds, rest = divmod(now_ns + 3_000_000_000, 1_000_000_000)
        field = FIELD_UT[0] * c + FIELD_UT[1] * s, FIELD_UT[1] * c - FIELD_UT[0] * s, FIELD_UT[2]
        mag = (
            LAYOUTS[TAGS_BY_NAME["magneto"]]
            .zeros()
            ._replace(mx=round(field[0] / 0.3), my=round(-field[1] / 0.3), mz=round(-field[2] / 0.3))
        )
        phys = (
            LAYOUTS[TAGS_BY_NAME["phys_measures"]]
            .zeros()
            ._replace(phys_accs_mg=(0.0, 0.0, -1000.0), phys_gyros_deg_s=(1.0, 2.0, self._sequence % 7))
        )
        altitude = LAYOUTS[TAGS_BY_NAME["altitude"]].zeros()._replace(altitude_raw_mm=round(1e3 * self.position[2]))
        pressure = LAYOUTS[TAGS_BY_NAME["pressure_raw"]].zeros()._replace(pressure_pa=100_000)
        yield 0, demo
        yield TAGS_BY_NAME["time"], (seconds << 21 | rest // 1000,)
        yield TAGS_BY_NAME["phys_measures"], phys
        yield TAGS_BY_NAME["altitude"], altitude
        yield TAGS_BY_NAME["pressure_raw"], pressure
        yield TAGS_BY_NAME["magneto"], mag
        if self._sequence % 40 == 0:
            yield (
                GPS_TAG,
                LAYOUTS[GPS_TAG]
                .zeros()
                ._replace(
                    latitude_deg=-34.603 + self.position[1] / 110_900,
                    longitude_deg=-58.368 + self.position[0] / 91_700,
                    elevation_m=25.0,
                    data_available=1,
                    ehpe_m=2.0,
                    satellites=9,
                ),
            )
