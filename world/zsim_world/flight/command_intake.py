"""Commands on their way to the firmware: stamped, ordered, judged, applied, and told where it matters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from zsim.contract import keys, messages
from zsim_world.flight.command_links import CommandLinks
from zsim_world.flight.commander import Due

if TYPE_CHECKING:
    from zsim_world.flight.world import World


class CommandDesk:
    """Takes commands as they come, and hands them to the fleet at their instants."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._links = CommandLinks(world)

    def take(self, drone: str, kind: str, message: Any) -> bool:
        """Keep a command until its instant, or refuse it; return False for one that has come before."""
        world, source = self._world, message.source
        gating = world.barrier.is_gating(source)  # its name was looked at when it joined
        if not gating and not keys.PROCESS_NAME.fullmatch(source):
            reason = f"source is {source[:48]!r}; must be 1 to 48 of a-z 0-9 _ . -"
            world.refuse("somebody", f"drone/{drone[:40]}/cmd/{kind}", reason)
            return True
        index = world.index.get(drone)
        reason = "no such drone; see world/info" if index is None else self._age_refusal(message, gating)
        if index is None or reason:
            world.refuse(source, f"drone/{drone[:40]}/cmd/{kind}", reason or "")
            return True
        gate_ns = message.t_ns if gating else world.next_ns
        late_ns = self._links.delay_ns(drone, keys.command(drone, kind), message, gate_ns)
        if late_ns is None:
            return True  # its sender has sent it, and nobody hears it
        apply_ns = gate_ns + world.delay_ns + late_ns
        if not gating:
            self._tell_foreign(drone, kind, message, apply_ns)
        return world.commanders.push(index, kind, message, apply_ns)

    def _age_refusal(self, message: Any, gating: bool) -> str | None:
        world = self._world
        now_ns = world.now_ns
        if world.mode == "realtime":
            age_ms, limit_ms = (now_ns - message.t_ns) / 1e6, world.scenario.time.max_command_age_ms
            if age_ms > limit_ms:
                return f"age is {age_ms:.0f} ms; must be <= {limit_ms:g} ms"
        if gating and message.t_ns > now_ns:
            return f"t_ns is {message.t_ns}; must be <= {now_ns}, the newest gate"
        return None

    def _tell_foreign(self, drone: str, kind: str, message: Any, apply_ns: int) -> None:
        """Say when a command takes effect whose sender is not in the lockstep."""
        world, source = self._world, message.source
        fields = {name: getattr(message, name) for name in messages.fields(type(message))}
        text = f"{source} sends {kind} to {drone}"
        world.event("command", drone, text, source=source, command=kind, apply_t_ns=apply_ns, message=fields)

    def apply(self, t_ns: int) -> None:
        """Hand the commands that are due at t_ns to the firmware."""
        for due in self._world.commanders.pop(t_ns):
            if self._links.lost_on_air(due, t_ns + self._world.gate_ns):
                continue
            refusal = self._world.commanders.refusal(due) or self._hand_over(due)
            if refusal:
                subject = keys.command(self._world.fleet.names[due.drone], due.kind)
                self._world.refuse(due.source, subject, refusal)

    def _hand_over(self, due: Due) -> str | None:
        """Hand a command to the firmware; return why it is refused."""
        if due.kind == "mode":
            return self._mode(due)
        refusal = self._setpoint(due)
        if refusal is None and self._world.commanders.take(due.drone, due.source):
            name = self._world.fleet.names[due.drone]
            self._world.event("commander", name, f"{due.source} flies {name}", source=due.source)
        return refusal

    def _setpoint(self, due: Due) -> str | None:
        m, i, fleet = due.message, due.drone, self._world.fleet
        if due.kind == "velocity":
            return fleet.set_velocity(i, m.velocity_m_s, m.yaw_rate_rad_s, m.frame)
        if due.kind == "ardrone":
            return fleet.set_ardrone(i, m.forward, m.left, m.up, m.yaw_left, m.hover)
        if due.kind == "attitude":
            return fleet.set_attitude(i, m.orientation_wxyz, m.thrust_n, m.yaw_rate_rad_s)
        return fleet.set_rotors(i, m.speed_rad_s)

    def _mode(self, due: Due) -> str | None:
        fleet, mode = self._world.fleet, due.message.mode
        act = {
            "takeoff": fleet.takeoff,
            "land": fleet.land,
            "emergency": fleet.emergency,
            "reset": fleet.reset,
        }
        refusal = act[mode](due.drone)
        if refusal is None:
            name = fleet.names[due.drone]
            self._world.event("mode", name, f"{due.source} asks {name} to {mode}", source=due.source, mode=mode)
        return refusal
