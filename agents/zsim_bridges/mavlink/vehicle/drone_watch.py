"""What is reported to the pilot of a drone: sensors, battery, fence, faults, refusals, collisions."""

from zsim.contract.run_messages import Event
from zsim_bridges.mavlink.autopilot.enums import Severity
from zsim_bridges.mavlink.autopilot.personality import FenceAction, FlightMode, Settings
from zsim_bridges.mavlink.flight.vehicle_fence import BREACH_NONE, VehicleFence
from zsim_bridges.mavlink.flight.vehicle_flight import Report
from zsim_bridges.mavlink.telemetry.telemetry_source import TelemetrySource

FAULTS = {"fault": "", "fault_end": " is over", "fault_clear": " cleared"}
MODE_OF = {FenceAction.HOLD: FlightMode.HOLD, FenceAction.RETURN: FlightMode.RETURN, FenceAction.LAND: FlightMode.LAND}


class DroneWatch:
    """Watches one drone, reports what changes, and acts at its fence.

    Args:
        drone: its name.
        source: name of this process, whose commands may be refused.
        seen: state and flight of the drone; the breach of its fence is noted there.
        report: sends a text.
    """

    def __init__(
        self,
        drone: str,
        source: str,
        seen: TelemetrySource,
        settings: Settings,
        fence: VehicleFence,
        report: Report,
    ) -> None:
        self._drone = drone
        self._own = source
        self._seen = seen
        self._settings = settings
        self._fence = fence
        self._report = report
        self._failed: set[str] = set()
        self._was_low = False

    def on_event(self, event: Event) -> None:
        """Report an event that is about the drone."""
        if event.kind in FAULTS and event.data.get("target") == self._drone:
            severity = Severity.CRITICAL if event.kind == "fault" else Severity.NOTICE
            self._report(severity, f"Fault {event.data.get('kind')}{FAULTS[event.kind]}")
        elif event.kind == "collision" and self._drone in (pair := (event.subject, event.data.get("other"))):
            self._report(Severity.CRITICAL, f"Collision with {pair[1] if pair[0] == self._drone else pair[0]}")
        elif self._is_refusal(event):
            self._report(Severity.WARNING, f"Refused: {event.data.get('reason', event.text)}")

    def _is_refusal(self, event: Event) -> bool:
        """Return whether a command of ours was refused that is still meant: not a setpoint that a landing overtook."""
        ours = event.kind == "refused" and event.source == self._own and f"/{self._drone}/" in event.subject
        return ours and (event.subject.endswith("/mode") or self._seen.flight.target is not None)

    def look(self) -> None:
        """Report what has changed since the last gate."""
        self._look_at_sensors()
        self._look_at_battery()
        self._look_at_fence()

    def _look_at_sensors(self) -> None:
        failed = set(self._seen.state.failed_sensors())
        for name in sorted(failed - self._failed):
            self._report(Severity.CRITICAL, f"{name.upper()} lost")
        for name in sorted(self._failed - failed):
            self._report(Severity.INFO, f"{name.upper()} back")
        self._failed = failed

    def _look_at_battery(self) -> None:
        low = self._seen.state.is_battery_low
        if low and not self._was_low:
            self._report(Severity.CRITICAL, f"Low battery: {self._seen.battery_percent:.0f} %")
        self._was_low = low

    def _look_at_fence(self) -> None:
        seen, action = self._seen, self._settings.fence_action
        if action is FenceAction.NONE or not seen.state.is_steerable:
            seen.breach = BREACH_NONE
            return
        breach = self._fence.breach(seen.state.position_m, seen.state, self._settings)
        if breach and not seen.breach:
            seen.breaches += 1
            seen.breach_ns = seen.state.t_ns
            self._report(Severity.CRITICAL, f"Geofence breached: {action.name.lower()}")
            if action in MODE_OF and not seen.flight.foreign_commander:
                seen.flight.mission.abort("it left its geofence", failsafe=True)
                seen.flight.set_mode(MODE_OF[action])
        seen.breach = breach
