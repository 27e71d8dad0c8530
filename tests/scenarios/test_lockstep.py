"""Foreign programs take part in the lockstep by zenoh and msgpack alone: whom the world waits for, and for how long."""

from federation import ONE, Federation
from lockstep import DELAY_NS, GATE_NS, ME, Lockstep
from refused import has_terms, parts
from wire import kinds


def refusal(step: Lockstep, key: str) -> tuple[str, str]:
    return parts(step.event("refused", key).message["data"]["reason"])


def test_the_world_waits_for_each_done(federation: Federation) -> None:
    """The only wait in the lockstep.

        done 0 │ gates up to 0 + command delay + one gate │ waits

    Scenario: one drone, one gating program, a command delay of one gate.
    Expected: each time, the world waits exactly two gates after the last gate that the program has done.
    """
    step = Lockstep(federation)
    step.stands_at(DELAY_NS)
    for done_ns in (0, 3 * GATE_NS, 50 * GATE_NS):
        step.answer(done_ns)
        entry = step.stands_at(done_ns + DELAY_NS + GATE_NS).message["waiting_for"][0]
        assert entry["host"] == "elsewhere"
    step.leave()


def test_a_longer_command_delay_lets_the_world_run_further_ahead(federation: Federation) -> None:
    """A command delay of three gates allows the world to be three gates ahead.

    Expected: after done t, the world waits at t + 3 gates + one gate.
    """
    step = Lockstep(federation, "--set", "time.command_delay_gates=3")
    step.stands_at(3 * GATE_NS)
    step.answer(10 * GATE_NS)
    step.stands_at(14 * GATE_NS)
    step.leave()


def test_a_program_may_answer_every_third_gate(federation: Federation) -> None:
    """The period of a program is three gates.

        gates  0  20  40  60  80 ms          done 0 allows 80 ms, done 60 allows 140 ms
        done   0          60

    Expected: after each done, the world runs on for one period plus the command delay.
    """
    period_ns = 3 * GATE_NS
    step = Lockstep(federation, period_ns=period_ns)
    step.stands_at(DELAY_NS)
    for done_ns in (0, period_ns, 2 * period_ns):
        step.answer(done_ns)
        step.stands_at(done_ns + period_ns + DELAY_NS)
    step.leave()


def test_the_world_does_not_wait_for_a_program_with_period_0(federation: Federation) -> None:
    """A program with period_ns 0 takes part without being waited for.

    Expected: an event reports its join, and the run ends by itself.
    """
    step = Lockstep(federation, "--duration", "1", period_ns=0)
    assert step.event("join", ME).message["data"]["from_ns"] == 0
    assert step.event("end", "world").message["data"]["last_ns"] == 1_000_000_000
    step.leave()


def test_a_late_joiner_is_waited_for_until_it_dies(federation: Federation) -> None:
    """A second program joins in mid-run, is waited for, and dies without a bye.

        tester.one   ──50──┬─────────53────────────────60──▶ bye ──▶ end
        tester.late        └ join (from 53) ──53── dies
        newest gate       52         54        55      62

    Expected: the world waits for it from the gate after its join until its death (on_death: drop).
    """
    step = Lockstep(federation, "--duration", "4")
    step.answer(50 * GATE_NS)
    step.stands_at(52 * GATE_NS)
    late = step.client.join("tester.late", step.info, GATE_NS)
    assert step.event("join", "tester.late").message["data"]["from_ns"] == 53 * GATE_NS
    step.answer(53 * GATE_NS)
    step.stands_at(54 * GATE_NS, "tester.late")
    late.done(53 * GATE_NS)
    step.stands_at(55 * GATE_NS, ME, "tester.late")
    late.die()
    assert step.event("death", "tester.late").message["data"]["on_death"] == "drop"
    step.event("drop", "tester.late")
    step.answer(60 * GATE_NS)
    step.stands_at(62 * GATE_NS)
    step.leave()


def test_a_newer_incarnation_takes_over(federation: Federation) -> None:
    """A program of the same name joins while the older one is still there and keeps sending.

        tester.one #1  ──5──┐ superseded   done 6 (refused)
        tester.one #2       └─ join (done 5) ── done 6 ──▶

    Expected: the newer one continues where the older one was, whose messages are refused with the reason.
    """
    step = Lockstep(federation)
    step.answer(5 * GATE_NS)
    step.stands_at(7 * GATE_NS)
    older = step.me
    step.me = step.client.join(ME, step.info, GATE_NS)
    data = step.event("superseded", ME).message["data"]
    assert (data["incarnation"], data["done_ns"]) == (step.me.run["incarnation"], 5 * GATE_NS)
    older.done(6 * GATE_NS)
    assert refusal(step, f"process/{ME}/done") == ("incarnation", str(older.run["incarnation"]))
    step.stands_at(7 * GATE_NS)
    step.me.done_ns = 5 * GATE_NS
    step.answer(6 * GATE_NS)
    step.stands_at(8 * GATE_NS)
    step.leave()


def test_a_restarted_program_continues_where_it_died(federation: Federation) -> None:
    """A program dies, the world waits (on_death: wait), and the program comes back as a new incarnation.

        tester.one #1  ──5── dies          #2 join ──6──▶

    Expected: `clock` names it while it is away; a `restart` event gives the gate after which it continues.
    """
    step = Lockstep(federation, "--set", "processes.on_death={tester.one: wait}")
    step.answer(5 * GATE_NS)
    step.stands_at(7 * GATE_NS)
    step.me.die()
    assert step.event("death", ME).message["data"]["on_death"] == "wait"
    step.stands_at(7 * GATE_NS)
    step.me = step.client.join(ME, step.info, GATE_NS)
    assert step.event("restart", ME).message["data"]["done_ns"] == 5 * GATE_NS
    step.me.done_ns = 5 * GATE_NS
    step.answer(6 * GATE_NS)
    step.stands_at(8 * GATE_NS)
    step.leave()


def test_another_program_takes_over_from_a_dead_one(federation: Federation) -> None:
    """A program dies, the world waits (on_death: wait), and a program of another name joins to do its work.

        tester.one  ──5── dies
        tester.two         └─ join (serves tester.one) ──6──▶

    Expected: the newcomer continues where the dead program was, which the world no longer waits for.
    """
    step = Lockstep(federation, "--set", "processes.on_death={tester.one: wait}")
    step.answer(5 * GATE_NS)
    step.stands_at(7 * GATE_NS)
    step.me.die()
    step.event("death", ME)
    step.me = step.client.join("tester.two", step.info, GATE_NS, (ME,))
    assert step.event("join", "tester.two").message["data"]["done_ns"] == 5 * GATE_NS
    step.stands_at(7 * GATE_NS, "tester.two")
    step.me.done_ns = 5 * GATE_NS
    step.answer(6 * GATE_NS)
    step.stands_at(8 * GATE_NS, "tester.two")
    step.leave()


def test_one_of_two_programs_with_the_same_work_may_die(federation: Federation) -> None:
    """A program joins that also does the work of another program, which then dies.

        tester.one  ──5──┬──────── dies
        tester.two       └ join (serves tester.one) ──8──▶

    Expected: an event reports the doubled work; the survivor does it alone, and the world does not wait for the dead.
    """
    step = Lockstep(federation, "--set", "processes.on_death={tester.one: wait}")
    step.answer(5 * GATE_NS)
    step.stands_at(7 * GATE_NS)
    two = step.client.join("tester.two", step.info, GATE_NS, (ME,))
    assert ME in step.event("doubled", "tester.two").message["text"]
    step.me.die()
    assert "tester.two" in step.event("death", ME).message["text"]
    step.me, two.done_ns = two, 7 * GATE_NS
    step.answer(8 * GATE_NS)
    step.stands_at(10 * GATE_NS, "tester.two")
    step.leave()


def test_invalid_joins_and_dones_are_refused(federation: Federation) -> None:
    """A join or a done that does not fit the run is refused with the reason and changes nothing.

    Expected: one event for each refusal; time does not advance.
    """
    step = Lockstep(federation)
    step.stands_at(DELAY_NS)
    cases = [
        ({"period_ns": GATE_NS + 1}, ("period_ns", str(GATE_NS + 1))),
        ({"run_id": "another"}, ("run_id", "'another'")),
    ]
    for number, (fields, expected) in enumerate(cases):
        name = f"stranger.{number}"
        step.client.join(name, step.info, **{"period_ns": GATE_NS, **fields})
        assert refusal(step, f"process/{name}/join") == expected
    step.me.done(3600 * 10**9)
    assert refusal(step, f"process/{ME}/done") == ("done_ns", str(3600 * 10**9))
    step.me.done(0)
    step.client.put("process/nobody.there/done", t_ns=0, **step.me.run, done_ns=0, sent=0)
    assert refusal(step, "process/nobody.there/done") == ("join", "missing")
    step.stands_at(DELAY_NS + GATE_NS)
    step.leave()


def test_lost_outputs_are_requested_from_their_sender(federation: Federation) -> None:
    """A done counts a command that was lost in transit.

        tester.one ── takeoff ─✗               world
                   ── done 0 (sent 1) ───────▶ world ── get process/tester.one/outputs ──▶ tester.one

    Expected: the world requests the outputs once; the command in the answer takes effect at its own instant.
    """
    step = Lockstep(federation)
    mode = {"source": ME, "mode": "takeoff"}
    key = "drone/drone1/cmd/mode"
    lost = step.client.pack({"t_ns": 0, "seq": 0, **mode})
    asked = step.client.answer(f"process/{ME}/outputs", {"ok": True, "error": "", "result": [[key, lost]]})
    step.me.done(0, sent=1)
    step.stands_at(2 * GATE_NS)
    assert len(asked) == 1
    step.answer(GATE_NS)
    assert step.event("mode", "drone1").message["t_ns"] == DELAY_NS
    step.leave()


def test_outputs_that_nobody_has_are_reported_missing(federation: Federation) -> None:
    """As above, but the program does not answer the request for its lost outputs.

    Expected: an event reports how many are missing, and time goes on.
    """
    step = Lockstep(federation)
    step.me.done(0, sent=2)
    assert step.event("outputs_missing", ME).message["data"]["missing"] == 2
    step.stands_at(2 * GATE_NS)
    step.leave()


def test_an_operator_can_pause_step_and_resume(federation: Federation) -> None:
    """An operator pauses the run, steps two gates and resumes; a program gates throughout.

    Expected: `clock` reports paused and shows exactly two more gates; an event reports every call.
    """
    step = Lockstep(federation)
    step.answer(5 * GATE_NS)
    step.stands_at(7 * GATE_NS)
    assert step.client.request("world/control", "pause")["ok"]
    refused = step.client.request("world/control", "pause")
    assert parts(refused["error"]) == ("the run", "paused")
    for gate in (6, 7):
        step.me.done(gate * GATE_NS)
    paused = step.clock.until(lambda m: m["state"] == "paused")
    assert paused.message["t_ns"] == 7 * GATE_NS
    assert step.client.request("world/control", "step", gates=2)["ok"]
    standing = step.clock.until(lambda m: m["state"] == "paused" and m["t_ns"] == 9 * GATE_NS)
    again = step.clock.until(lambda m: m["state"] == "paused" and m["step"] >= 9)
    assert again.message["t_ns"] == standing.message["t_ns"] == 9 * GATE_NS
    assert step.client.request("world/control", "resume")["ok"]
    step.me.done_ns = 7 * GATE_NS
    step.answer(8 * GATE_NS)
    step.stands_at(10 * GATE_NS)
    step.event("control", "resume")
    ops = [e.message["subject"] for e in step.events.received if e.message["kind"] == "control"]
    assert ops == ["pause", "pause", "step", "resume"]
    step.leave()


def test_an_operator_stops_a_world_that_expects_nobody(federation: Federation) -> None:
    """A world that expects nobody starts by itself; an operator stops it.

    Expected: it ends with the operator's reason, and its clock reports stopped.
    """
    world = federation.world(ONE, "--rate", "1", "--duration", "1000")
    client = federation.client()
    clock, events = client.subscribe("clock"), client.subscribe("world/event")
    clock.until(lambda m: m["t_ns"] > 0)
    assert client.request("world/control", "stop", source="operator.1", reason="lunch")["ok"]
    reason = events.until(lambda m: m["kind"] == "end").message["data"]["reason"]
    assert has_terms(reason, "operator.1", "lunch")
    assert clock.until(lambda m: m["state"] == "stopped")
    world.ends(with_code=0)
    world.line(f"ended: {reason}")


def test_only_its_own_bye_ends_a_program_s_participation(federation: Federation) -> None:
    """Somebody else sends a bye in a participant's name; then it sends one itself, as in the contract before 1.1.

        somebody   ── bye (no incarnation) ── bye (of another) ──
        tester.one ──0──────────────────────────────────────20──▶ bye (no incarnation), token gone

    Expected: both forged byes are refused with the incarnation, and the world keeps waiting for the participant, whose
    own bye counts as soon as its token is gone, and is not a death.
    """
    step = Lockstep(federation)
    step.answer(10 * GATE_NS)
    somebody, key = federation.client(), f"process/{ME}/bye"
    somebody.put(key, t_ns=0, **{**step.me.run, "incarnation": 5}, reason="forged")
    named = step.event("refused", key)
    somebody.put(key, t_ns=0, reason="forged")
    step.answer(20 * GATE_NS)
    unnamed = step.event("refused", key)
    for refusal, found in ((named, "is 5;"), (unnamed, "is missing;")):
        assert has_terms(refusal.message["text"], "incarnation", found, str(step.me.run["incarnation"]))
    step.stands_at(22 * GATE_NS)
    step.client.put(key, t_ns=20 * GATE_NS, reason="enough")
    step.me.die()
    assert step.event("leave", ME).message["data"]["reason"] == "enough"
    assert "death" not in kinds(step.events.now())
    step.world.ends(with_code=0)


def test_a_required_process_that_leaves_early_fails_the_run(federation: Federation) -> None:
    """An estimator leaves in flight; the run goes on without it.

        estimator.drone1 ──0──────▶ bye
        tester.one       ──0──────────────60──▶ bye ──▶ end

    Expected: the terminal reports it at once; the world ends with exit code 1 and gives the reason in its last line.
    """
    step = Lockstep(federation)
    estimator = step.client.join("estimator.drone1", step.info, GATE_NS)
    step.event("join", "estimator.drone1")
    for gate in range(5):
        step.see(gate * GATE_NS)
        estimator.done(gate * GATE_NS)
        step.answer(gate * GATE_NS)
    estimator.bye(4 * GATE_NS, "enough")
    assert step.event("leave", "estimator.drone1").message["data"]["fails"]
    step.world.line("estimator.drone1 left: enough; .*on_death")
    step.answer(60 * GATE_NS)
    step.me.bye(step.now_ns)
    step.world.ends(with_code=1)
    assert has_terms(step.world.text().splitlines()[-1], "estimator.drone1", "enough")
