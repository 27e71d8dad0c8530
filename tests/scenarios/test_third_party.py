"""Foreign programs in place of zsim's roles, and the world's answers to the requests of any client."""

import math
from itertools import pairwise
from typing import Any

import msgpack
import pytest
from federation import PAIR, PAIR_ROLES, Federation
from lockstep import DELAY_NS, GATE_NS, ME, Lockstep
from refused import parts
from wire import Client, Participant, Subscription

PAIR_DURATION_S = 12


class ForeignEstimator:
    """Takes the place of estimator.drone2 with only zenoh and msgpack; its estimate is the truth."""

    def __init__(self, client: Client, name: str = "estimator.drone2") -> None:
        self._client = client
        info = client.info()
        self._truth: Subscription = client.subscribe("drone/drone2/truth")
        self._status: Subscription = client.subscribe("drone/drone2/sensor/status")
        self.participant = client.join(name, info, info["gate_ns"])
        self.last_ns = round(PAIR_DURATION_S * 1e9)

    def fly(self) -> None:
        """Answer every gate until the end of the run."""
        for t_ns in range(0, self.last_ns + 1, GATE_NS):
            truth = self._truth.until(lambda m, t_ns=t_ns: m["t_ns"] == t_ns).message
            self._status.until(lambda m, t_ns=t_ns: m["t_ns"] == t_ns)  # the gate is complete
            self._client.put("drone/drone2/estimate", **estimate_of(truth), source=self.participant.name)
            self.participant.done(t_ns, sent=1)
        self.participant.bye(self.last_ns)


def estimate_of(truth: dict[str, Any]) -> dict[str, Any]:
    """Return an estimate that equals the truth."""
    w, x, y, z = truth["orientation_wxyz"]
    pose = {name: truth[name] for name in ("t_ns", "position_m", "velocity_m_s", "orientation_wxyz")}
    covariance = [0.01 if i % 7 == 0 else 0.0 for i in range(36)]
    others = {"covariance": covariance, "yaw_sigma_rad": 0.01, "gyro_bias_rad_s": [0, 0, 0], "sensors": {}}
    return {**pose, "yaw_rad": math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), **others}


def test_the_world_waits_for_a_foreign_estimator(federation: Federation) -> None:
    """One of the two estimators is a foreign program.

        world ──sensors──▶ estimator.drone1 ─────────────┐
              ──truth────▶ estimator.drone2 (foreign) ───┴──▶ controller.main

    Scenario: PAIR; zsim's estimator of drone2 is not started.
    Expected: the world waits for the foreign estimator as for zsim's; the formation engages and holds to the end.
    """
    roles = [federation.world(PAIR), federation.role("estimator", "drone1"), federation.role("controller", "main")]
    client = federation.client()
    phases = client.subscribe("cluster/main/state")
    ForeignEstimator(client).fly()
    for role in roles:
        role.ends(with_code=0)
    last = phases.now()[-1].message
    assert last["phase"] == "engaged"
    assert max(abs(a - b) for a, b in zip(last["value"][:3], last["desired"][:3], strict=True)) < 0.5


def test_a_foreign_estimator_takes_over_in_flight(federation: Federation) -> None:
    """A foreign program replaces the estimator of drone2 during the flight.

        estimator.drone2 (zsim's)  ──────┐ superseded: reported in one line; it ends
        estimator.drone2 (foreign)       └ join ──▶ 12 s

    Expected: the launcher does not restart zsim's estimator; the run completes.
    """
    run = federation.run(PAIR, "--rate", "3")
    client = federation.client()
    clock, events = client.subscribe("clock"), client.subscribe("world/event")
    clock.until(lambda m: m["t_ns"] > 6e9)
    assert client.request("world/control", "rate", value=0.2)["ok"]  # slow enough for the takeover
    truth = client.subscribe("drone/drone2/truth")
    former_pid = federation.pid("estimator.drone2")
    own = client.token(f"estimator.drone2/session/{client.session.info.zid()}")  # so that the join takes effect at once
    foreign = client.join("estimator.drone2", client.info(), GATE_NS)
    taken = events.until(lambda m: m["kind"] == "superseded").message["data"]
    assert taken["former_pid"] == former_pid
    assert client.request("world/control", "rate", value=10)["ok"]
    run.line("estimator.drone2: another process of this name joined from elsewhere")
    answer_from(client, foreign, truth, taken["done_ns"] + GATE_NS)
    run.ends(with_code=0)
    record = federation.record()
    assert record.end()["last_ns"] == PAIR_DURATION_S * 10**9
    assert record.events("restart") == []
    assert record.all("cluster/main/state")[-1]["phase"] == "engaged"
    own.undeclare()


def answer_from(client: Client, participant: Participant, truth: Subscription, from_ns: int) -> None:
    """Catch up by a replay, then answer every gate until the end of the run."""
    replayed = client.request("world/control", "replay", from_ns=from_ns - 1, keys=["drone/drone2/truth"])["result"]
    known = {m["t_ns"]: m for m in (msgpack.unpackb(payload) for _, payload in replayed)}
    for t_ns in range(from_ns, PAIR_DURATION_S * 10**9 + 1, GATE_NS):
        while t_ns not in known:
            known.update({h.message["t_ns"]: h.message for h in [truth.until(lambda _: True)]})
        client.put("drone/drone2/estimate", **estimate_of(known[t_ns]), source="estimator.drone2")
        participant.done(t_ns, sent=1)
    participant.bye(PAIR_DURATION_S * 10**9)


def test_the_world_answers_gets_and_replays(federation: Federation) -> None:
    """The world serves last values and replays to any client, including those of dead publishers.

        tester.one ── estimate, state ── dies          somebody ── get ──▶ world

    Expected: gets of `world/info`, `clock`, status, truth, estimate and state are answered, also with wildcards; a
    replay returns the messages stamped after a time, in the order of their publication.
    """
    step = Lockstep(federation, "--set", "processes.on_death={tester: wait}")
    step.answer(10 * GATE_NS)
    truth = step.client.get("drone/drone1/truth")["drone/drone1/truth"]
    step.put("drone/drone1/estimate", **{**estimate_of(truth), "t_ns": 11 * GATE_NS})
    state = {"names": [], "value": [], "desired": [], "desired_rate": [], "trajectory_t_s": None}
    step.put("cluster/main/state", phase="idle", drones=[], margin=0.0, reason="", **state)
    step.answer(11 * GATE_NS)
    step.stands_at(13 * GATE_NS)
    step.me.die()
    step.event("death", ME)

    with Client(federation.endpoint) as other:
        for expression in ("world/info", "clock", "drone/*/sensor/status", "drone/*/truth", "cluster/*/state"):
            assert other.get(expression), expression
        assert other.get("drone/drone1/estimate")["drone/drone1/estimate"]["position_m"] == truth["position_m"]
        replay = other.request("world/control", "replay", from_ns=3 * GATE_NS, keys=["drone/*/truth", "clock"])
    stamps = [(key, msgpack.unpackb(payload)["t_ns"]) for key, payload in replay["result"]]
    assert [t for key, t in stamps if key == "drone/drone1/truth"][:3] == [4 * GATE_NS, 5 * GATE_NS, 6 * GATE_NS]
    assert stamps[:2] == [("drone/drone1/truth", 4 * GATE_NS), ("clock", 4 * GATE_NS)]
    step.client.request("world/control", "stop")
    step.world.ends(with_code=0)


BAD_REQUESTS = [  # op, arguments, refused field and value if there is one
    ("replay", {}, None),
    ("replay", {"from_ns": "x", "keys": []}, None),
    ("step", {"gates": 0}, ("gates", "0")),
    ("step", {"gates": math.nan}, None),
    ("rate", {"value": -1}, ("value", "-1")),
    ("rate", {}, ("value", "None")),
    ("acquire", {"drone": "drone9"}, ("drone", "'drone9'")),
    ("acquire", {"drone": "drone1", "priority": 1000}, ("priority", "1000")),
    ("release", {"drone": "drone1"}, ("drone1", "flown by nobody, not by 'tester'")),
    ("jump", {}, ("op", "'jump'")),
]


def test_invalid_requests_are_refused_with_the_reason(federation: Federation) -> None:
    """Faulty requests are sent to the world, one of each kind, and payloads that are no request.

    Expected: each is answered with the reason; simulated time advances afterwards.
    """
    step = Lockstep(federation)
    step.answer(2 * GATE_NS)
    for op, args, refused in BAD_REQUESTS:
        answer = step.client.request("world/control", op, **args)
        assert answer["ok"] is False
        assert refused is None or parts(answer["error"]) == refused, (op, args, answer)
    for payload in (b"", b"\xc1garbage", msgpack.packb(["list"]), msgpack.packb({"op": 7})):
        answer = step.client.get("world/control", payload=payload)["world/control"]
        assert answer["ok"] is False
        assert "world/control" in answer["error"]
    step.answer(5 * GATE_NS)
    step.leave()


def test_roles_keep_the_outputs_of_their_last_two_gates(federation: Federation) -> None:
    """Every gating role of zsim keeps the outputs of its last two gates, to answer a get.

    Expected: the commands, estimates and state of the gates that it has last reported done.
    """
    run = federation.run(PAIR, "--rate", "10", "--duration", "600")
    client = federation.client()
    client.subscribe("clock").until(lambda m: m["t_ns"] > 6e9)
    assert client.request("world/control", "pause")["ok"]
    for name in PAIR_ROLES:
        answer = client.request(f"process/{name}/outputs", "outputs")
        assert answer["ok"]
        outputs = [(key, msgpack.unpackb(payload)["t_ns"]) for key, payload in answer["result"]]
        stamps = sorted({t_ns for _, t_ns in outputs})
        assert len(stamps) >= 2
        assert {b - a for a, b in pairwise(stamps)} == {GATE_NS}
        assert ("cluster/main/state" if name == "controller.main" else "estimate") in " ".join(k for k, _ in outputs)
    client.request("world/control", "stop")
    run.ends(with_code=0)


@pytest.fixture
def twice(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> list[dict[str, Any]]:
    """Return the data of the event `end` of two runs, both flown by the same foreign program."""
    hashes = []
    for number in range(2):
        with Federation(tmp_path_factory.mktemp(f"run{number}")) as federation:
            step = Lockstep(federation, "--duration", "60")
            step.fly()
            for gate in range(40):
                step.put("drone/drone1/cmd/velocity", velocity_m_s=[math.sin(gate), 0.3, 0.1], yaw_rate_rad_s=0.2)
                step.answer(step.me.done_ns + GATE_NS)
            step.stands_at(step.me.done_ns + DELAY_NS + GATE_NS)
            step.client.request("world/control", "stop")
            hashes.append(step.event("end", "world").message["data"])
            step.me.bye(step.now_ns)
            step.world.ends(with_code=0)
    return hashes


def test_runs_of_a_foreign_program_give_the_same_bits(twice: list[dict[str, Any]]) -> None:
    """A program with only zenoh and msgpack flies a drone in lockstep, twice.

    Expected: the same last gate and the same hash, although everything else differs between the runs.
    """
    first, second = twice
    assert first["last_ns"] == second["last_ns"]
    assert first["truth_sha256"] == second["truth_sha256"]
