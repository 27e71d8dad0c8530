"""Time is stopped by nobody who does not take part, and who stops it is named."""

import signal

from federation import PAIR, Federation
from wire import Client, Subscription

CONTROLLER, ESTIMATOR, VISITOR = "controller.main", "estimator.drone1", "tester.one"
GATE_NS = 20_000_000


class Watched:
    """PAIR under way, and what a stranger sees of it."""

    def __init__(self, federation: Federation, *pace: str) -> None:
        self._federation = federation
        self.run = federation.run(PAIR, *(pace or ("--rate", "4")), "--duration", "100000")
        self.client: Client = federation.client()
        self.clock: Subscription = self.client.subscribe("clock")
        self.events: Subscription = self.client.subscribe("world/event")
        self.info = self.client.info()
        self.clock.until(lambda m: m["t_ns"] >= 1e9)

    def stop(self, name: str) -> None:
        """Stop a process that has shown a sign of life."""
        self.client.subscribe(f"process/{name}/health").until(lambda m: True)
        self._federation.kill(name, signal.SIGSTOP)

    def join_as(self, name: str, **about: object) -> None:
        """Publish a join, and nothing else: no token, no done."""
        role, run_id = name.split(".")[0], self.info["run_id"]
        fields = {"t_ns": 0, "run_id": run_id, "incarnation": 2**40, "role": role, "host": "nowhere", "pid": 1}
        self.client.put(f"process/{name}/join", **{**fields, "period_ns": GATE_NS, **about})

    def flies_on(self) -> None:
        """Wait until simulated time has gone on, and end the run."""
        t_ns = self.clock.until(lambda m: not m["waiting_for"]).message["t_ns"]
        self.clock.until(lambda m: m["t_ns"] > t_ns + 2e9)
        assert self.client.request("world/control", "stop")["ok"]
        self.run.ends(with_code=0)


def test_a_join_of_another_s_process_is_answered_by_a_newer_one(federation: Federation) -> None:
    watched = Watched(federation)
    health = watched.client.subscribe(f"process/{CONTROLLER}/health").until(lambda m: m).message
    watched.join_as(CONTROLLER, host=health["host"], pid=health["pid"])
    watched.events.until(lambda m: m["kind"] == "superseded" and m["data"]["incarnation"] == 2**40)
    watched.events.until(lambda m: m["kind"] == "superseded" and m["data"]["incarnation"] != 2**40)
    watched.flies_on()


def test_a_join_without_a_token_holds_time_up_for_a_moment_only(federation: Federation) -> None:
    watched = Watched(federation)
    watched.join_as(VISITOR)
    standing = watched.clock.until(lambda m: any(w["name"] == VISITOR for w in m["waiting_for"]))
    assert standing.message["waiting_for"][0]["host"] == "nowhere"
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("drop", VISITOR))
    watched.run.line(f"no_show: {VISITOR} on nowhere")
    watched.flies_on()


def test_who_takes_a_place_and_does_nothing_gives_it_back(federation: Federation) -> None:
    watched = Watched(federation)
    token = watched.client.token(CONTROLLER)
    watched.join_as(CONTROLLER)
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("superseded", CONTROLLER))
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("death", CONTROLLER))
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("restart", CONTROLLER))
    watched.flies_on()
    token.undeclare()


# Who is stopped


def test_a_stopped_estimator_is_named_and_not_the_controller_that_waits_for_it(federation: Federation) -> None:
    watched = Watched(federation)
    watched.stop(ESTIMATOR)
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("silent", ESTIMATOR))
    standing = watched.clock.until(lambda m: len(m["waiting_for"]) == 2).message["waiting_for"]
    assert {w["name"]: w["held_by"] for w in standing} == {ESTIMATOR: [], CONTROLLER: [ESTIMATOR]}
    watched.run.line(f"waiting for {ESTIMATOR} on [^,]*$")
    federation.kill(ESTIMATOR, signal.SIGCONT)
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("silent_end", ESTIMATOR))
    watched.flies_on()


def test_a_stopped_recorder_is_named_in_realtime(federation: Federation) -> None:
    watched = Watched(federation, "--realtime")
    watched.stop("recorder")
    watched.clock.until(lambda m: [w["name"] for w in m["waiting_for"]] == ["recorder"])
    watched.run.line("silent: recorder")
    federation.kill("recorder", signal.SIGCONT)
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("silent_end", "recorder"))
    watched.flies_on()


def test_a_stopped_world_is_named(federation: Federation) -> None:
    watched = Watched(federation)
    watched.stop("world")
    watched.run.line(f"world .pid {federation.pid('world')}. shows no sign of life")
    federation.kill("world", signal.SIGCONT)
    watched.run.line("world .* is back")
    watched.flies_on()
