"""A MAVLink vehicle modelled as a point, for tests of the driver; only the codec is zsim's."""

import math
from collections.abc import Iterator
from typing import Any

from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import Link, Parser, Signing

PX4, ARDUPILOT = 12, 3
ON_GROUND, IN_AIR, TAKING_OFF, LANDING = 1, 2, 3, 4
OFFBOARD, HOLD, LAND = 6 << 16, 4 << 16 | 3 << 24, 4 << 16 | 6 << 24
GUIDED = 4
STEP_NS = 20_000_000
HOME_SEA_M = 30.0
LAG_S = 0.2


class FakeAutopilot:
    """One vehicle, which follows its velocity setpoints, in NED about the place where it was switched on.

    Attributes:
        position, velocity: [m, m/s; NED].
        armed, mode, landed: state as its telemetry reports it.
        commands: numbers of the commands received, in order.
    """

    def __init__(self, autopilot: int = PX4, system: int = 1, signing: Signing | None = None) -> None:
        self.autopilot, self.system = autopilot, system
        self._link, self._parser = Link(system, 1, signing), Parser(signing)
        self.position, self.velocity = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        self.armed, self.mode, self.landed = False, HOLD if autopilot == PX4 else 0, ON_GROUND
        self.commands: list[int] = []
        self.setpoints: list[dialect.SetPositionTargetLocalNed] = []
        self._setpoint_ns = self._now_ns = 0
        self._height_m = 0.0
        self._outbox: list[Any] = []

    def receive(self, datagram: bytes, now_ns: int) -> None:
        for received in self._parser.feed(datagram):
            match received.message:
                case dialect.CommandLong() as command:
                    self.commands.append(command.command)
                    self._on_command(command)
                case dialect.SetPositionTargetLocalNed() as setpoint:
                    self.setpoints.append(setpoint)
                    self._setpoint_ns = now_ns
                case dialect.Timesync() as question if question.tc1 == 0:
                    self._outbox.append(dialect.Timesync(tc1=now_ns + 7_000_000_000, ts1=question.ts1))

    def _on_command(self, command: Any) -> None:
        result = 0
        match command.command:
            case 176:
                main, sub = int(command.param2), int(command.param3)
                self.mode = main << 16 | sub << 24 if self.autopilot == PX4 else main
            case 400 if command.param1 == 0 and command.param2 == 21196:
                self.armed, self.landed = False, ON_GROUND
            case 400:
                self.armed = command.param1 == 1
            case 22 if self.armed and (self.autopilot == PX4 or self.mode == GUIDED):
                above = HOME_SEA_M if self.autopilot == PX4 else 0.0
                self.landed, self._height_m = TAKING_OFF, command.param7 - above
            case 21:
                self.landed = LANDING
            case 511 | 512:
                pass
            case _:
                result = 4
        self._outbox.append(dialect.CommandAck(command=command.command, result=result))

    def step(self, now_ns: int) -> Iterator[bytes]:
        """Advance by a step; yield the datagrams that it sends."""
        self._now_ns = now_ns
        dt = STEP_NS * 1e-9
        wanted = self._wanted()
        for axis in range(3):
            self.velocity[axis] += (wanted[axis] - self.velocity[axis]) * dt / LAG_S
            self.position[axis] += dt * self.velocity[axis]
        if self.landed == TAKING_OFF and -self.position[2] > 0.98 * self._height_m:
            self.landed = IN_AIR
            self.mode = HOLD if self.autopilot == PX4 else self.mode
        if self.position[2] > 0.0:
            self.position[2] = self.velocity[2] = 0.0
            if self.landed == LANDING:
                self.landed, self.armed = ON_GROUND, False
        for message in (*self._outbox, *self._telemetry()):
            yield self._link.pack(message)
        self._outbox.clear()

    def _wanted(self) -> tuple[float, float, float]:
        fresh = self._now_ns - self._setpoint_ns < 500_000_000
        if self.landed == TAKING_OFF:
            return 0.0, 0.0, -1.0
        if self.landed == LANDING:
            return 0.0, 0.0, 0.5
        if self.landed == IN_AIR and fresh and self.mode in (OFFBOARD, GUIDED):
            setpoint = self.setpoints[-1]
            return setpoint.vx, setpoint.vy, setpoint.vz
        return 0.0, 0.0, 0.0

    def _telemetry(self) -> Iterator[Any]:
        boot_ms = (self._now_ns + 7_000_000_000) // 1_000_000
        (x, y, z), (vx, vy, vz) = self.position, self.velocity
        yield dialect.HighresImu(
            1000 * boot_ms, 0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 0.2, 0.0, 0.3, 1010.0, 0, 0, 20, 0x1FFF
        )
        yield dialect.AttitudeQuaternion(boot_ms, math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # facing east
        yield dialect.LocalPositionNed(boot_ms, x, y, z, vx, vy, vz)
        if self._now_ns // STEP_NS % 10 == 0:
            flags = 128 if self.armed else 0
            yield dialect.Heartbeat(2, self.autopilot, 1 | flags, self.mode, 4 if self.armed else 3, 3)
            yield dialect.ExtendedSysState(0, self.landed)
            yield dialect.SysStatus(battery_remaining=77)
            yield dialect.GlobalPositionInt(boot_ms, alt=round(1e3 * (HOME_SEA_M - z)))
            yield dialect.GpsRawInt(1000 * boot_ms, 3, -346030000, -583680000, 25000, 100, 100, 0, 0, 9, 25000)
            yield dialect.GpsGlobalOrigin(-346030000, -583680000, 25000)
