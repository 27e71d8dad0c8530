"""Foreign programs in the lockstep, by zenoh and msgpack alone: who is waited for, from when, and until when."""

import msgpack
from federation import ONE, Federation, Role
from wire import Client, Heard, Participant, Watch

GATE_NS = 20_000_000
DELAY_NS = GATE_NS  # command delay of the scenarios here, one gate
ME = "tester.one"


class Lockstep:
    """A world with one drone that waits for this program and tells it everything rare."""

    def __init__(self, federation: Federation, *options: str, scenario: str = ONE, period_ns: int = GATE_NS) -> None:
        self.world: Role = federation.world(scenario, "--expect", ME, *options)
        self.client: Client = federation.client()
        self.clock: Watch = self.client.watch("clock")
        self.events: Watch = self.client.watch("world/event")
        self.info = self.client.info()
        self.me: Participant = self.client.join(ME, self.info, period_ns)

    def stands_at(self, t_ns: int, *names: str) -> Heard:
        """Wait until time stands at t_ns and the processes of these names are waited for."""
        heard = self.clock.until(lambda m: m["waiting_for"] and m["t_ns"] >= t_ns)
        assert heard.message["t_ns"] == t_ns
        assert {w["name"] for w in heard.message["waiting_for"]} == (set(names) or {ME})
        return heard

    def go_to(self, t_ns: int) -> None:
        """Let the world publish every gate up to t_ns."""
        for gate_ns in range(0, t_ns - DELAY_NS, GATE_NS):
            self.me.done(gate_ns)
        self.clock.until(lambda m: m["t_ns"] >= t_ns)

    def event(self, kind: str, subject: str) -> Heard:
        return self.events.until(lambda m: (m["kind"], m["subject"]) == (kind, subject))


def test_no_gate_without_its_done(federation: Federation) -> None:
    """The only wait there is.

        done 0 │ gates up to 0 + command delay + one gate │ stands

    Scenario: one drone, one program that gates, command delay one gate.
    Expected: time stands exactly two gates after what the program is through with, each time.
    """
    step = Lockstep(federation)
    step.stands_at(DELAY_NS)
    for done_ns in (0, 3 * GATE_NS, 50 * GATE_NS):
        for gate_ns in range(0, done_ns + GATE_NS, GATE_NS):
            step.me.done(gate_ns)
        entry = step.stands_at(done_ns + DELAY_NS + GATE_NS).message["waiting_for"][0]
        assert entry["host"] == "elsewhere"


def test_a_period_of_several_gates(federation: Federation) -> None:
    """A program that answers every third gate.

        gates  0  20  40  60  80 ms          done 0 allows 80 ms, done 60 allows 140 ms
        done   0          60

    Expected: the world runs on to one period and the command delay after its done.
    """
    period_ns = 3 * GATE_NS
    step = Lockstep(federation, period_ns=period_ns)
    step.stands_at(DELAY_NS)
    for done_ns in (0, period_ns, 2 * period_ns):
        step.me.done(done_ns)
        step.stands_at(done_ns + period_ns + DELAY_NS)


def test_a_program_that_does_not_gate(federation: Federation) -> None:
    """period_ns 0: it takes part, nobody waits for it.

    Expected: its join is an event, and the run ends by itself.
    """
    step = Lockstep(federation, "--duration", "1", period_ns=0)
    assert step.event("join", ME).message["data"]["from_ns"] == 0
    step.me.bye(0)
    step.world.ends(with_code=0)


def test_a_late_joiner(federation: Federation) -> None:
    """A second program joins while time runs, then dies without a word.

        tester.one  ──┬──────────────────────────────────▶ end
        tester.late   └─ join ── (stands) ── done … ── dies

    Expected: it is waited for from the gate after its join on, and no longer once it is dead (on_death: drop).
    """
    step = Lockstep(federation, "--duration", "4", "--set", "processes.on_death={tester: drop}")
    step.go_to(50 * GATE_NS)
    late = step.client.join("tester.late", step.info, GATE_NS)
    from_ns = step.event("join", "tester.late").message["data"]["from_ns"]
    assert from_ns == 51 * GATE_NS
    for gate_ns in range(0, 5_000_000_000, GATE_NS):
        step.me.done(gate_ns)
        if gate_ns == 49 * GATE_NS:
            break
    step.me.done(51 * GATE_NS)
    for gate_ns in range(50 * GATE_NS, 5_000_000_000, GATE_NS):
        step.me.done(gate_ns)
    step.world.ends(with_code=0)
