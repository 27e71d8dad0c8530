"""Foreign programs in the lockstep, by zenoh and msgpack alone: who is waited for, from when, and until when."""

from federation import ONE, Federation
from lockstep import DELAY_NS, GATE_NS, ME, Lockstep
from refused import has_terms, parts
from wire import kinds


def refusal(step: Lockstep, key: str) -> tuple[str, str]:
    return parts(step.event("refused", key).message["data"]["reason"])


def test_no_gate_without_its_done(federation: Federation) -> None:
    """The only wait there is.

        done 0 │ gates up to 0 + command delay + one gate │ stands

    Scenario: one drone, one program that gates, command delay one gate.
    Expected: time stands exactly two gates after what the program is through with, each time.
    """
    step = Lockstep(federation)
    step.stands_at(DELAY_NS)
    for done_ns in (0, 3 * GATE_NS, 50 * GATE_NS):
        step.answer(done_ns)
        entry = step.stands_at(done_ns + DELAY_NS + GATE_NS).message["waiting_for"][0]
        assert entry["host"] == "elsewhere"
    step.leave()


def test_a_longer_command_delay(federation: Federation) -> None:
    """A link of three gates' delay allows the world to be three gates ahead.

    Expected: after done t, time stands at t + 3 gates + one gate.
    """
    step = Lockstep(federation, "--set", "time.command_delay_gates=3")
    step.stands_at(3 * GATE_NS)
    step.answer(10 * GATE_NS)
    step.stands_at(14 * GATE_NS)
    step.leave()


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
        step.answer(done_ns)
        step.stands_at(done_ns + period_ns + DELAY_NS)
    step.leave()


def test_a_program_that_does_not_gate(federation: Federation) -> None:
    """period_ns 0: it takes part, nobody waits for it.

    Expected: its join is an event, and the run ends by itself.
    """
    step = Lockstep(federation, "--duration", "1", period_ns=0)
    assert step.event("join", ME).message["data"]["from_ns"] == 0
    assert step.event("end", "world").message["data"]["last_ns"] == 1_000_000_000
    step.leave()


def test_a_late_joiner(federation: Federation) -> None:
    """A second program joins while time runs, is waited for, then dies without a word.

        tester.one   ──50──┬─────────53────────────────60──▶ bye ──▶ end
        tester.late        └ join (from 53) ──53── dies
        newest gate       52         54        55      62

    Expected: it is waited for from the gate after its join on, and no longer once it is dead (on_death: drop).
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
    """A program of the same name joins; the older one is still there and goes on talking.

        tester.one #1  ──5──┐ superseded   done 6 (refused)
        tester.one #2       └─ join (done 5) ── done 6 ──▶

    Expected: the newer one goes on where the older was; what the older says is refused with the reason.
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


def test_a_restart_after_death(federation: Federation) -> None:
    """A program dies, time stands (on_death: wait), and it comes back by a new incarnation.

        tester.one #1  ──5── dies          #2 join ──6──▶

    Expected: `clock` names it while it is away; an event `restart` says from where it goes on.
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


def test_another_takes_the_place_of_the_dead(federation: Federation) -> None:
    """A program dies, time stands (on_death: wait), and one of another name comes that does its work.

        tester.one  ──5── dies
        tester.two         └─ join (serves tester.one) ──6──▶

    Expected: the newcomer goes on where the dead one was, and nobody waits for that one any more.
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


def test_two_that_do_the_same_work(federation: Federation) -> None:
    """A program joins that does another's work as well, and that one dies.

        tester.one  ──5──┬──────── dies
        tester.two       └ join (serves tester.one) ──8──▶

    Expected: an event says that both do it; who is left does it alone, and nobody waits for the dead.
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


def test_joins_and_dones_that_are_refused(federation: Federation) -> None:
    """What does not fit the run is refused with the reason, and moves nothing.

    Expected: an event each; time stands where it stood.
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


def test_outputs_that_were_lost(federation: Federation) -> None:
    """A done counts two commands of which one was lost on the way.

        tester.one ── takeoff ─✗   takeoff ──▶ world
                   ── done 0 (sent 2) ────────▶ world ── get process/tester.one/outputs ──▶ tester.one

    Expected: the world asks for the outputs once; what it gets takes effect at its instant.
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


def test_outputs_that_nobody_has(federation: Federation) -> None:
    """As before, but the program does not answer for what it lost.

    Expected: an event says how many are missing, and time goes on.
    """
    step = Lockstep(federation)
    step.me.done(0, sent=2)
    assert step.event("outputs_missing", ME).message["data"]["missing"] == 2
    step.stands_at(2 * GATE_NS)
    step.leave()


def test_pause_step_resume(federation: Federation) -> None:
    """An operator stops time, takes three steps, and lets it run; a program gates all the while.

    Expected: `clock` says paused and shows exactly three more gates; every call is an event.
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


def test_nobody_expected_and_a_stop(federation: Federation) -> None:
    """A world that expects nobody starts by itself; an operator stops it.

    Expected: it ends with the operator's reason, its clock says stopped.
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


def test_only_its_own_bye_ends_a_participation(federation: Federation) -> None:
    """Somebody else says bye in a participant's name; then the participant itself, by the contract of before 1.1.

        somebody   ── bye (no incarnation) ── bye (of another) ──
        tester.one ──0──────────────────────────────────────20──▶ bye (no incarnation), token gone

    Expected: both byes of somebody are refused with the incarnation, and time goes on waiting for the participant; its
    own counts as soon as its token is gone, and is no death.
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


def test_who_was_needed_and_leaves_early_fails_the_run(federation: Federation) -> None:
    """An estimator leaves in flight; the run goes on without it.

        estimator.drone1 ──0──────▶ bye
        tester.one       ──0──────────────60──▶ bye ──▶ end

    Expected: the terminal names it at once; the world ends with exit code 1 and says why in its last line.
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
