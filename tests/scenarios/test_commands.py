"""Commands to a drone: commanders, refusals with reasons, instants of effect, and silence."""

import math

import pytest
from federation import ONE, Federation
from lockstep import DELAY_NS, GATE_NS, ME, Lockstep
from refused import has_terms, parts
from wire import Received

VELOCITY = "drone/drone1/cmd/velocity"
MODE = "drone/drone1/cmd/mode"
FORWARD = {"velocity_m_s": [0.5, 0.0, 0.0], "yaw_rate_rad_s": 0.0}
BACK = {"velocity_m_s": [-0.5, 0.0, 0.0], "yaw_rate_rad_s": 0.0}


def refusal(step: Lockstep, key: str) -> tuple[str, str]:
    return parts(step.event("refused", key).message["data"]["reason"])


def velocity(step: Lockstep) -> list[float]:
    """Return the true velocity in W; the drone heads north, so forward is y."""
    return step.client.get("drone/drone1/truth")["drone/drone1/truth"]["velocity_m_s"]


def test_the_first_sender_commands_until_a_higher_priority_acquires(federation: Federation) -> None:
    """One drone, two programs; the second does not gate.

        tester.one ── takeoff ── forward ──────────────────────── forward ✗ ─────────── forward ✓
        tester.two                        back ✗    acquire 10, back ✓        release

    Expected: status names the commander; the second program is refused with the commander's name until it acquires the
    drone with a higher priority, then the first one is refused; once released, the drone is free for anybody.
    """
    step = Lockstep(federation, "--duration", "60")
    step.fly()
    assert step.status()["commander"] is None
    step.put(VELOCITY, **FORWARD)
    step.answer(step.me.done_ns + GATE_NS)
    assert step.event("commander", "drone1").message["source"] == ME
    step.answer(step.me.done_ns + 100 * GATE_NS)
    step.put(VELOCITY, **FORWARD)
    step.answer(step.me.done_ns + 20 * GATE_NS)
    assert step.status()["commander"] == ME

    step.client.put(VELOCITY, t_ns=0, source="tester.two", **BACK)
    step.event("command", "drone1")
    step.answer(step.me.done_ns + 3 * GATE_NS)
    assert refusal(step, VELOCITY) == ("drone1", f"flown by '{ME}' (priority 0)")

    answer = step.client.request("world/control", "acquire", source="tester.two", drone="drone1", priority=10)
    assert answer["ok"]
    step.client.put(VELOCITY, t_ns=0, source="tester.two", **BACK)
    step.event("command", "drone1")
    step.put(VELOCITY, **FORWARD)
    step.answer(step.me.done_ns + 3 * GATE_NS)
    drone, state = refusal(step, VELOCITY)
    assert drone == "drone1"
    assert has_terms(state, "'tester.two'", "10")
    assert step.status()["commander"] == "tester.two"
    no = step.client.request("world/control", "acquire", source=ME, drone="drone1", priority=10)
    assert has_terms(no["error"], "drone1", "'tester.two'", "10")
    no = step.client.request("world/control", "release", source=ME, drone="drone1")
    assert has_terms(no["error"], "drone1", "'tester.two'", "'tester.one'")

    assert step.client.request("world/control", "release", source="tester.two", drone="drone1")["ok"]
    step.answer(step.me.done_ns + 3 * GATE_NS)
    assert step.status()["commander"] is None
    step.put(VELOCITY, **FORWARD)
    step.answer(step.me.done_ns + 3 * GATE_NS)
    assert step.status()["commander"] == ME
    step.leave()


def test_a_command_takes_effect_at_its_instant(federation: Federation) -> None:
    """A lockstep command takes effect at its stamp plus the delay, an outside command when its event says.

        tester.one  ── takeoff stamped 10 ──▶ effect at 10 + delay
        tester.two  ── takeoff ──▶ event `command` with apply_t_ns ──▶ effect at apply_t_ns

    Expected: `mode` events at these instants; a `command` event, with its apply_t_ns, for the outside command alone.
    """
    step = Lockstep(federation)
    step.answer(9 * GATE_NS)
    step.put(MODE, mode="takeoff")
    step.answer(12 * GATE_NS)
    assert step.event("mode", "drone1").message["t_ns"] == 10 * GATE_NS + DELAY_NS
    assert "command" not in [received.message["kind"] for received in step.events.now()]
    step.stands_at(14 * GATE_NS)
    step.client.put(MODE, t_ns=0, source="tester.two", mode="emergency")
    apply_ns = step.event("command", "drone1").message["data"]["apply_t_ns"]
    assert apply_ns == 15 * GATE_NS + DELAY_NS
    step.answer(20 * GATE_NS)
    assert step.event("mode", "drone1").message["t_ns"] == apply_ns
    step.leave()


def test_a_drone_hovers_when_its_commander_dies(federation: Federation) -> None:
    """The commander dies, and nobody else flies the drone.

        tester.one ── gates
        tester.two ── forward ── dies

    Expected: a `release` event; the drone hovers.
    """
    step = Lockstep(federation, "--duration", "60")
    step.fly()
    other = step.client.join("tester.two", step.info, 0)
    step.client.put(VELOCITY, t_ns=0, source="tester.two", **FORWARD)
    step.event("command", "drone1")
    step.answer(step.me.done_ns + 10 * GATE_NS)
    assert step.status()["commander"] == "tester.two"
    other.die()
    step.event("release", "drone1")
    step.answer(step.me.done_ns + 100 * GATE_NS)
    assert step.status()["commander"] is None
    assert step.status()["state"] == "hovering"
    assert math.hypot(*velocity(step)) < 0.5
    step.leave()


def test_a_drone_hovers_and_then_lands_when_its_commander_is_silent(federation: Federation) -> None:
    """The commander sends one setpoint and then nothing.

        t          0.0 s      0.5 s      2.5 s
        drone   flying ──▶ hovering ──▶ landing ──▶ landed

    Expected: it hovers after 0.5 s of simulated time and lands 2 s later, whatever the wall clock does.
    """
    step = Lockstep(federation, "--duration", "60")
    states = step.client.subscribe("drone/drone1/sensor/status")
    step.fly()
    step.put(VELOCITY, **FORWARD)
    sent_ns = step.me.done_ns + GATE_NS
    step.answer(sent_ns + 400 * GATE_NS)
    step.leave()
    states.until(lambda m: m["t_ns"] >= sent_ns + 400 * GATE_NS)
    changes = changes_of(states.received)
    flying_ns, hovering_ns, landing_ns = changes["flying"], changes["hovering"], changes["landing"]
    assert flying_ns == sent_ns + DELAY_NS + GATE_NS
    assert hovering_ns - flying_ns == pytest.approx(500_000_000, abs=GATE_NS)
    assert landing_ns - hovering_ns == pytest.approx(2_000_000_000, abs=GATE_NS)
    assert "landed" in changes


def changes_of(received: list[Received]) -> dict[str, int]:
    """Return the instant at which each state was last entered [ns]."""
    changes, former = {}, ""
    for _, _, status in received:
        if status["state"] != former:
            former = status["state"]
            changes[former] = status["t_ns"]
    return changes


REFUSED = {
    "landed": (VELOCITY, {**FORWARD}, ("drone1", "landed")),
    "no such drone": ("drone/drone9/cmd/mode", {"mode": "takeoff"}, ("drone", "'drone9'")),
    "nan": (VELOCITY, {**FORWARD, "yaw_rate_rad_s": math.nan}, ("yaw_rate_rad_s", "nan")),
    "infinite": (VELOCITY, {**FORWARD, "velocity_m_s": [0, math.inf, 0]}, ("velocity_m_s[1]", "inf")),
    "two numbers": (VELOCITY, {**FORWARD, "velocity_m_s": [0, 0]}, ("velocity_m_s", "[0, 0]")),
    "no source": (VELOCITY, {**FORWARD, "source": None}, ("source", "null")),
    "no field": (VELOCITY, {"velocity_m_s": [0, 0, 0]}, ("yaw_rate_rad_s", "missing")),
    "no mode": (MODE, {"mode": "jump"}, ("mode", "'jump'")),
    "no frame": (VELOCITY, {**FORWARD, "frame": "moon"}, ("frame", "'moon'")),
    "stamp below 0": (VELOCITY, {**FORWARD, "t_ns": -1}, ("t_ns", "-1")),
    "stamp of 70 bits": (VELOCITY, {**FORWARD, "t_ns": 2**63}, ("t_ns", str(2**63))),
    "stamp in the future": (VELOCITY, {**FORWARD, "t_ns": 10**15}, ("t_ns", str(10**15))),
    "zero quaternion": (
        "drone/drone1/cmd/attitude",
        {"orientation_wxyz": [0, 0, 0, 0], "thrust_n": 4, "yaw_rate_rad_s": 0},
        ("orientation_wxyz", "[0, 0, 0, 0]"),
    ),
}


def test_invalid_commands_are_refused(federation: Federation) -> None:
    """A program in the lockstep sends commands with every kind of fault.

    Expected: an event gives the reason for each; time and the drone go on as if no command had arrived.
    """
    step = Lockstep(federation)
    step.answer(3 * GATE_NS)
    step.see(4 * GATE_NS)
    for key, fields, _ in (case for name, case in REFUSED.items() if name != "zero quaternion"):
        step.client.put(key, **{"t_ns": 4 * GATE_NS, "source": ME, **fields})
        step.me.done(step.me.done_ns + GATE_NS, sent=0)
        step.see(step.me.done_ns + DELAY_NS)
    step.answer(40 * GATE_NS)
    step.stands_at(42 * GATE_NS)
    reasons = [e.message["data"]["reason"] for e in step.events.now() if e.message["kind"] == "refused"]
    refused = [parts(reason) for reason in reasons]
    for name, (_, _, expected) in REFUSED.items():
        assert name == "zero quaternion" or expected in refused, (name, reasons)
    assert step.status()["state"] == "landed"
    step.leave()
    assert step.event("end", "world").message["data"]["refused"] >= len(REFUSED) - 1


def test_absurd_setpoints_are_flown_within_limits(federation: Federation) -> None:
    """The setpoints are finite but absurd: 1e300 m/s, 1e12 rad/s, 1e308 N.

    Expected: the firmware flies what its limits allow, and refuses a zero quaternion.
    """
    step = Lockstep(federation, "--duration", "60", scenario=ONE)
    step.fly()
    step.put(VELOCITY, velocity_m_s=[1e300, -1e300, 0], yaw_rate_rad_s=1e12)
    step.answer(step.me.done_ns + 20 * GATE_NS)
    assert math.hypot(*velocity(step)) < 10
    key, fields, _ = REFUSED["zero quaternion"]
    step.put(key, **fields)
    step.answer(step.me.done_ns + 5 * GATE_NS)
    assert "quaternion" in step.event("refused", key).message["data"]["reason"]
    step.put("drone/drone1/cmd/attitude", orientation_wxyz=[1, 0, 0, 0], thrust_n=1e308, yaw_rate_rad_s=0)
    step.put("drone/drone1/cmd/rotors", speed_rad_s=[1e308] * 4)
    step.answer(step.me.done_ns + 10 * GATE_NS)
    step.leave()
