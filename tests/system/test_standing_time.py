"""Only participants can stop simulated time, and those that do are reported."""

import itertools
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from statistics import median

import pytest
from federation import PAIR, Federation, free_port
from refused import parts
from wire import Client, Subscription

CONTROLLER, ESTIMATOR, VISITOR = "controller.main", "estimator.drone1", "tester.one"
GATE_NS = 20_000_000


class Watched:
    """A run of PAIR, and an external client that observes it."""

    def __init__(self, federation: Federation, *pace: str) -> None:
        self.federation = federation
        self.tokens: list[object] = []  # kept alive as long as this object
        self.incarnation = 0  # of the last forged join
        self._incarnations = itertools.count(2**40)
        self.run = federation.run(PAIR, *(pace or ("--rate", "1")), "--duration", "100000")
        self.client: Client = federation.client()
        self.clock: Subscription = self.client.subscribe("clock")
        self.events: Subscription = self.client.subscribe("world/event")
        self.info = self.client.info()
        self.clock.until(lambda m: m["t_ns"] >= 1e9)

    def stop(self, name: str) -> None:
        """Stop a process once it has published its health."""
        self.client.subscribe(f"process/{name}/health").until(lambda m: True)
        self.federation.kill(name, signal.SIGSTOP)

    def join_as(self, name: str, **about: object) -> None:
        """Publish a forged join without a token or any `done`."""
        role, run_id, self.incarnation = name.split(".")[0], self.info["run_id"], next(self._incarnations)
        fields = {"t_ns": 0, "run_id": run_id, "incarnation": self.incarnation, "role": role}
        fields |= {"host": "nowhere", "pid": 1}
        self.client.put(f"process/{name}/join", **{**fields, "period_ns": GATE_NS, **about})

    def goes_on(self) -> None:
        """Wait until simulated time continues."""
        self.clock.now()
        t_ns = self.clock.until(lambda m: not m["waiting_for"]).message["t_ns"]
        self.clock.until(lambda m: m["t_ns"] > t_ns + 5e8)

    def flies_on(self) -> None:
        """Wait until simulated time continues, and end the run."""
        self.goes_on()
        assert self.client.request("world/control", "stop")["ok"]
        self.run.ends(with_code=0)


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Iterator[Watched]:
    """A run shared by the tests of this file, each of which lets time continue."""
    with Federation(tmp_path_factory.mktemp("watched")) as federation:
        made = Watched(federation)
        yield made
        made.flies_on()


def test_joins_without_tokens_do_not_stop_time(watched: Watched) -> None:
    watched.join_as(VISITOR)
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("no_show", VISITOR))
    watched.run.line(f"no_show: {VISITOR} on nowhere")
    for number in range(20):
        watched.join_as(f"{VISITOR}.{number}")
    watched.goes_on()
    told = [event.message for event in watched.events.now() if event.message["subject"].startswith(VISITOR)]
    assert {event["kind"] for event in told} == {"no_show"}


def test_a_process_answers_a_forged_join_with_a_newer_one(watched: Watched) -> None:
    health = watched.client.subscribe(f"process/{CONTROLLER}/health").until(lambda m: m).message
    watched.join_as(CONTROLLER, host=health["host"], pid=health["pid"])
    made_up = watched.incarnation
    watched.events.until(lambda m: m["kind"] == "superseded" and m["data"]["incarnation"] == made_up)
    watched.events.until(lambda m: m["kind"] == "superseded" and m["data"]["incarnation"] != made_up)
    watched.goes_on()


def test_a_stopped_estimator_is_reported_rather_than_its_controller(watched: Watched) -> None:
    watched.stop(ESTIMATOR)
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("silent", ESTIMATOR))
    wanted = {ESTIMATOR: [], CONTROLLER: [ESTIMATOR]}
    watched.clock.until(lambda m: {w["name"]: w["held_by"] for w in m["waiting_for"]} == wanted)
    watched.run.line(f"waiting for {ESTIMATOR} on [^,]*$")
    watched.federation.kill(ESTIMATOR, signal.SIGCONT)
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("silent_end", ESTIMATOR))
    watched.goes_on()


def test_a_stopped_world_is_reported(watched: Watched) -> None:
    watched.stop("world")
    watched.run.line(f"world .pid {watched.federation.pid('world')}. has shown no sign of life")
    watched.federation.kill("world", signal.SIGCONT)
    watched.run.line("world .* is back")
    watched.goes_on()


def test_an_idle_impostor_loses_its_place(watched: Watched) -> None:
    """This test comes last: its tokens remain, as their end would count as the death of the new controller."""
    takes_a_place(watched, ("superseded", "death", "restart"))
    watched.goes_on()


def takes_a_place(watched: Watched, kinds: tuple[str, ...]) -> None:
    """Join as the controller with all its tokens, and wait until the world has replaced the idle impostor."""
    client = watched.client
    watched.tokens = [client.token(CONTROLLER), client.token(f"{CONTROLLER}/session/{client.session.info.zid()}")]
    watched.join_as(CONTROLLER)
    for kind in kinds:
        watched.events.until(lambda m, kind=kind: (m["kind"], m["subject"]) == (kind, CONTROLLER))


@pytest.mark.soak
def test_an_idle_impostor_loses_its_place_in_realtime(federation: Federation) -> None:
    watched = Watched(federation, "--realtime")
    takes_a_place(watched, ("superseded", "no_show", "restart"))
    watched.flies_on()


@pytest.mark.soak
@pytest.mark.parametrize("has_token", [False, True])
def test_a_forged_join_does_not_take_over_a_place(federation: Federation, has_token: bool) -> None:
    watched = Watched(federation)
    if has_token:  # for the name alone, as from a program that knows only the contract
        watched.client.token(CONTROLLER)
    pid = federation.pid(CONTROLLER)
    watched.join_as(CONTROLLER)
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("no_show", CONTROLLER))
    assert federation.pid(CONTROLLER) == pid
    watched.flies_on()
    assert federation.record().events("superseded", "death") == []


@pytest.mark.soak
def test_a_stopped_recorder_is_reported_in_realtime(federation: Federation) -> None:
    watched = Watched(federation, "--realtime")
    watched.stop("recorder")
    watched.clock.until(lambda m: [w["name"] for w in m["waiting_for"]] == ["recorder"])
    watched.run.line("silent: recorder")
    federation.kill("recorder", signal.SIGCONT)
    watched.events.until(lambda m: (m["kind"], m["subject"]) == ("silent_end", "recorder"))
    watched.flies_on()


# Slow readers

KERNEL_BYTES = 400_000  # a link accepts at least this much before a put to it blocks (measured)
READER = """
import json, sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
session = zenoh.open(config)
def take(sample):
    print("reads", flush=True)
    time.sleep(1000)
subscriber = session.declare_subscriber("**", take)
time.sleep(1000)
"""


@contextmanager
def reader(endpoint: str, stopped: bool) -> Iterator[int]:
    """Run a program that subscribes to everything and reads nothing; yield its process id."""
    program = subprocess.Popen([sys.executable, "-c", READER, endpoint], stdout=subprocess.PIPE)
    try:
        assert program.stdout is not None
        program.stdout.readline()
        if stopped:
            program.send_signal(signal.SIGSTOP)
        yield program.pid
    finally:
        program.kill()
        program.communicate()


@pytest.mark.parametrize("pace", [pytest.param(("--rate", "10"), marks=pytest.mark.soak), ("--realtime",)])
def test_readers_that_take_nothing_do_not_slow_the_run(federation: Federation, pace: tuple[str, ...]) -> None:
    watched = Watched(federation, *pace)
    held_bytes: list[int] = []
    with ExitStack() as readers:
        pids = {readers.enter_context(reader(federation.endpoint, stopped=n == 0)) for n in range(5)}
        while pids:
            closed = watched.events.until(lambda m: m["kind"] == "slow_reader").message["data"]
            pids.discard(int(closed["process"].split()[1]))
            held_bytes.append(closed["held_bytes"])
        t_ns = watched.clock.now()[-1].message["t_ns"]
        watched.clock.until(lambda m: m["t_ns"] > t_ns + 5e9)
    watched.flies_on()
    if "--realtime" in pace:  # so no put blocked and no gate was late because of them
        assert median(held_bytes) < KERNEL_BYTES
    assert re.search(r"\bstuck: ", watched.run.text()) is None
    record = federation.record()
    assert record.events("death", "silent", "outputs_missing") == []
    assert [event for event in record.events("refused") if parts(event["data"]["reason"])[0] == "age"] == []


@pytest.mark.parametrize("pace", [pytest.param(("--rate", "10"), marks=pytest.mark.soak), ("--realtime",)])
@pytest.mark.soak
def test_readers_behind_a_router_that_take_nothing_do_not_slow_the_run(
    federation: Federation, pace: tuple[str, ...]
) -> None:
    watched = Watched(federation, *pace)
    there, options = f"tcp/127.0.0.1:{free_port()}", [word for word in pace if word == "--realtime"]
    router = federation.role("router", "site", "--listen", there, *options)
    router.line("leads to")
    with reader(there, stopped=True) as stopped, reader(there, stopped=False) as idle:
        for pid in (stopped, idle):
            router.line(f"router.site: pid {pid} .* read none")
        t_ns = watched.clock.now()[-1].message["t_ns"]
        watched.clock.until(lambda m: m["t_ns"] > t_ns + 5e9)
    watched.flies_on()
    assert re.search(r"\bstuck: ", watched.run.text()) is None
    record = federation.record()
    assert record.events("death", "silent", "outputs_missing") == []
    assert [event for event in record.events("refused") if parts(event["data"]["reason"])[0] == "age"] == []
