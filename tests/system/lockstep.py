"""A world that waits for one external program at every gate: time advances only when the test sends done."""

from typing import Any

from federation import ONE, Federation, Role
from wire import Client, Participant, Received, Subscription

GATE_NS = 20_000_000
DELAY_NS = GATE_NS  # the scenarios' command delay, one gate
TAKEOFF_GATES = 300  # longer than a take-off
ME = "tester.one"


class Lockstep:
    """A world with one drone that waits for this program, which follows its clock and events."""

    def __init__(self, federation: Federation, *options: str, scenario: str = ONE, period_ns: int = GATE_NS) -> None:
        self.world: Role = federation.world(scenario, "--expect", ME, *options)
        self.client: Client = federation.client()
        self.clock: Subscription = self.client.subscribe("clock")
        self.events: Subscription = self.client.subscribe("world/event")
        self.info = self.client.info()
        self.me: Participant = self.client.join(ME, self.info, period_ns)
        self.now_ns = -1

    def answer(self, until_ns: int) -> None:
        """Send done for every gate up to until_ns, once each is reached."""
        for gate_ns in range(self.me.done_ns + self.me.period_ns, until_ns + 1, self.me.period_ns):
            self.see(gate_ns)
            self.me.done(gate_ns)

    def see(self, gate_ns: int) -> None:
        """Wait for a gate."""
        if self.now_ns < gate_ns:
            received = self.clock.until(lambda m: m["state"] == "running" and m["t_ns"] >= gate_ns)
            self.now_ns = received.message["t_ns"]

    def stands_at(self, t_ns: int, *names: str) -> Received:
        """Wait until time stands still for exactly these processes; check that it does at t_ns. Skip older messages."""
        expected = set(names) or {ME}
        self.clock.now()
        received = self.clock.until(
            lambda m: (
                m["state"] == "running" and {w["name"] for w in m["waiting_for"]} == expected and m["t_ns"] >= t_ns
            )
        )
        assert received.message["t_ns"] == t_ns
        self.now_ns = t_ns
        return received

    def event(self, kind: str, subject: str) -> Received:
        return self.events.until(lambda m: (m["kind"], m["subject"]) == (kind, subject))

    def leave(self) -> None:
        """Leave the run, and wait for its end."""
        self.me.bye(self.now_ns)
        self.world.ends(with_code=0)

    def put(self, key: str, **fields: Any) -> None:
        """Publish an output for the next gate to be answered, once that is reached, and count it for the next done."""
        gate_ns = self.me.done_ns + self.me.period_ns
        self.see(gate_ns)
        self.client.put(key, **{"t_ns": gate_ns, "source": ME, **fields})
        self.me.sent += 1

    def status(self) -> dict[str, Any]:
        """Return the latest status of the drone."""
        return self.client.get("drone/drone1/sensor/status")["drone/drone1/sensor/status"]

    def fly(self) -> None:
        """Take off, and let time stand still once the drone hovers."""
        self.put("drone/drone1/cmd/mode", mode="takeoff")
        self.answer(self.me.done_ns + TAKEOFF_GATES * GATE_NS)
        self.stands_at(self.me.done_ns + DELAY_NS + GATE_NS)
        assert self.status()["state"] == "hovering"
