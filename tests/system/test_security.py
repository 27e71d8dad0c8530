"""Security on the wire: admission, the rights of each role, reports of bad certificates, and reproducible runs."""

import contextlib
import re
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import forked_commands
import pytest
import zenoh
from federation import ONE, PAIR, PAIR_ROLES, Federation, Role
from forked_commands import USER_FAULT, refusal
from refused import has_terms, parts
from rights_table import KEYS, ROLES, SCENARIO, SIMULATED, keys_of
from secured import HOST, PREFIX, READY, SHORT_S, SITE, Certificates, KeyLog, RawClient, hub, site, tls_endpoint
from wire import PATIENCE_S

from zsim.scenario import roles as rights
from zsim.scenario import scenario_file
from zsim.scenario.roles import permits
from zsim.transport import connection
from zsim.transport.tls import Identity, peer_fault
from zsim_deploy.certificates import access_control

WAYS = ("at the world", "through a router")
TOKENS = tuple(key for key in KEYS if key.startswith("process/") and key.count("/") == 1)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("certs"))


@contextmanager
def reached(made: Certificates, role: str, way: str) -> Iterator[tuple[RawClient, Any]]:
    """Yield a client with the certificate of a role and the world's session, connected as `way` says."""
    with ExitStack() as stack:
        direct = way == WAYS[0]
        endpoint, link = stack.enter_context(hub(made, [role] if direct else [], [] if direct else [role]))
        link.declare_queryable("clock", lambda query: answer_once(query, "clock"))
        if not direct:
            endpoint = stack.enter_context(site(made, endpoint, [role]))
        client = stack.enter_context(RawClient(endpoint, made.of(role)))
        client.settle()
        yield client, link


def answer_once(query: Any, key: str) -> None:
    query.reply(key, key.encode())
    query.end()


def tell_last(link: Any, key: str) -> None:
    """Publish after everything that the session has published so far, including views, which have their own queue."""
    block, last = zenoh.CongestionControl.BLOCK, zenoh.Priority.BACKGROUND
    link._raw.put(f"{PREFIX}{key}", key.encode(), congestion_control=block, priority=last)


# The table of rights in practice


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", ROLES)
def test_a_role_can_publish_exactly_the_permitted_keys(made: Certificates, role: str, way: str) -> None:
    fence = f"process/{role}/health"
    with reached(made, role, way) as (client, link):
        received, ready = KeyLog(), KeyLog()
        for expression in ("@batch", "**"):
            link.declare_subscriber(
                expression, lambda sample: (ready if sample.payload == READY else received).take(sample.key)
            )
        client.publish_until_received(fence, ready)
        for act in (client.put, client.publish):
            for key in KEYS:
                if key != fence:
                    act(key)
            act(fence)
            assert received.until_fence(fence) == keys_of(role, "p")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", ROLES)
def test_a_role_can_read_exactly_the_permitted_keys(made: Certificates, role: str, way: str) -> None:
    fence = "world/event"
    with reached(made, role, way) as (client, link):
        received = KeyLog()
        for key in KEYS:
            client.subscribe(key, received)
        for expression in ("**", "@batch", "drone/*/truth", "drone/**", "*/*/*/*"):
            client.subscribe(expression, KeyLog())
        client.settle()
        for key in KEYS:
            if key != fence:
                link.put_raw(key, key.encode())
        tell_last(link, fence)
        assert received.until_fence(fence) == keys_of(role, "r")


@pytest.mark.parametrize("role", ROLES)
def test_a_wildcard_grants_no_more_than_the_keys_it_matches(made: Certificates, role: str) -> None:
    with reached(made, role, WAYS[0]) as (client, link):
        received, fence = KeyLog(), KeyLog()
        for expression in ("**", "@batch", "drone/**", "drone/*/*", "process/**", "*"):
            client.subscribe(expression, received)
        client.subscribe("world/event", fence)
        client.settle()
        for key in KEYS:
            if key != "world/event":
                link.put_raw(key, key.encode())
        tell_last(link, "world/event")
        fence.until_fence("world/event")
        received.take("the end")
        assert received.until_fence("the end") - {"the end"} <= keys_of(role, "r")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", ROLES)
def test_a_role_can_get_exactly_the_permitted_keys(made: Certificates, role: str, way: str) -> None:
    fence = f"process/{role}/replay"
    with reached(made, role, way) as (client, link):
        asked, answered = KeyLog(), KeyLog()

        def answer(query: Any) -> None:
            asked.take(query.expression)
            answer_once(query, query.expression)

        for expression in ("@batch", "**"):
            link.declare_queryable(expression, answer)
        client.until_answered(fence)
        asked = KeyLog()
        for key in KEYS:
            if key != fence:
                client.ask(key, answered)
        client.ask(fence, answered)
        assert asked.until_fence(fence) == keys_of(role, "g")
        assert answered.until(lambda came: came >= keys_of(role, "g")) == keys_of(role, "g")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", ROLES)
def test_a_role_can_answer_exactly_the_permitted_keys(made: Certificates, role: str, way: str) -> None:
    with reached(made, role, way) as (client, link):
        others = [key for key in KEYS if key != "clock"]
        for key in others:
            client.answer(key)
        client.settle()
        until_s, answered = time.monotonic() + PATIENCE_S, set[str]()
        while not answered >= keys_of(role, "a"):  # through a router a new queryable is not always known at once
            assert time.monotonic() < until_s, answered
            answered = {sample.key for key in others for sample in link.get(key)}
        assert answered == keys_of(role, "a")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", ROLES)
def test_a_role_can_declare_exactly_the_permitted_tokens(made: Certificates, role: str, way: str) -> None:
    with reached(made, role, way) as (client, link):
        received = KeyLog()
        link.on_token("process/*", lambda key, alive: received.take(key))
        for key in sorted(TOKENS, key=lambda key: key in keys_of(role, "t")):
            client.token(key)
        assert received.until(lambda came: came >= keys_of(role, "t")) == keys_of(role, "t")


@pytest.mark.parametrize("role", ROLES)
def test_a_role_can_see_exactly_the_permitted_tokens(made: Certificates, role: str) -> None:
    with reached(made, role, WAYS[0]) as (client, link):
        received, fence = KeyLog(), KeyLog()
        client.subscribe_tokens("process/*", received)
        client.subscribe("world/event", fence)
        client.settle()
        for key in TOKENS:
            link.declare_token(key)
        link.put_raw("world/event", b"event")
        fence.until_fence("world/event")
        if keys_of(role, "w"):
            assert received.until(lambda came: came >= keys_of(role, "w")) == keys_of(role, "w")
        received.take("the end")
        assert received.until_fence("the end") == {"the end"}


def test_a_routers_certificate_grants_no_more_than_its_clients_rights(made: Certificates) -> None:
    fence = "process/estimator.drone1/health"
    with hub(made, [], ["estimator.drone1"]) as (endpoint, link), RawClient(endpoint, made.of(SITE)) as client:
        received = KeyLog()
        link.declare_subscriber("**", lambda sample: received.take(sample.key))
        for key in KEYS:
            if key != fence:
                client.put(key)
        client.put(fence)
        assert received.until_fence(fence) == keys_of("estimator.drone1", "p")


# Admission

OUTSIDERS = ("no certificate", "another authority", "plaintext", "plaintext with credentials", "an expired certificate")


@pytest.mark.parametrize("who", OUTSIDERS)
def test_an_outsider_is_refused(made: Certificates, tmp_path: Path, who: str) -> None:
    with hub(made) as (endpoint, link):
        received = KeyLog()
        link.declare_subscriber("**", lambda sample: received.take(sample.key))
        place, folder = outsider(who, made, tmp_path, endpoint)
        with pytest.raises(zenoh.ZError), RawClient(place, folder, SHORT_S) as client:
            client.put("drone/drone1/cmd/mode")
        with RawClient(endpoint, made.of("operator.main")) as client:
            client.put("process/operator.main/health")
            assert received.until_fence("process/operator.main/health") == {"process/operator.main/health"}


def outsider(who: str, made: Certificates, tmp_path: Path, endpoint: str) -> tuple[str, Path | None]:
    """Return an outsider's endpoint and its folder of certificates."""
    plain = endpoint.replace("tls/", "tcp/")
    if who.startswith("plaintext"):
        return plain, None if who == "plaintext" else made.of("operator.main")
    if who == "another authority":
        folder = Certificates(tmp_path).of("operator.main")
        (folder / "ca.pem").write_bytes((made.folder / "ca.pem").read_bytes())
        return endpoint, folder
    if who == "an expired certificate":
        return endpoint, made.of("operator.main", days=-0.5, host="past")
    folder = tmp_path / "none"
    folder.mkdir()
    (folder / "ca.pem").write_bytes((made.folder / "ca.pem").read_bytes())
    return endpoint, folder


def test_a_certificate_without_rights_gets_nothing(made: Certificates) -> None:
    with hub(made, ["operator.main"]) as (endpoint, link):
        received, got, links = KeyLog(), KeyLog(b"world"), KeyLog()
        link.declare_subscriber("**", lambda sample: sample.payload != b"world" and received.take(sample.key))
        link.on_link(lambda up: links.take("up" if up else "down"))
        with RawClient(endpoint, made.of("estimator.drone1")) as stranger:
            links.until_fence("up")
            for expression in (*KEYS, "**"):
                stranger.subscribe(expression, got)
            for key in KEYS:
                stranger.put(key)
                link.put_raw(key, b"world")
        links.until_fence("down")  # the world has read everything that arrived on the link
        received.take("the end")
        got.take("the end")
        assert received.until_fence("the end") == {"the end"}
        assert got.until_fence("the end") == {"the end"}


# Reports of bad certificates


def test_an_expired_certificate_is_reported(made: Certificates) -> None:
    folder = made.of("estimator.drone1", days=-0.5, host="past")
    with hub(made) as (endpoint, _):
        line = refusal("estimator", "drone1", "--connect", endpoint, "--tls", str(folder))
    assert has_terms(line, endpoint, "estimator.drone1", "certs init --renew")
    assert re.search(r"\d{4}-\d\d-\d\d", line)


def test_an_expired_certificate_of_the_world_is_reported(made: Certificates, tmp_path: Path) -> None:
    (tmp_path / "scenario.yaml").write_text(SIMULATED)
    folder = made.of("world", days=-0.5, host="past")
    line = refusal("world", str(tmp_path / "scenario.yaml"), "--listen", tls_endpoint(), "--tls", str(folder))
    assert has_terms(line, "world", "certs init --renew")


@pytest.mark.parametrize(
    ("role", "name"),
    [
        (("estimator", "drone2"), "estimator.drone2"),
        (("estimator", "drone[2]"), "estimator.drone2"),
        (("controller",), "controller.main"),
        (("record",), "recorder"),
        (("router", "site", "--listen", "{free}"), "router.site"),
        (("ros1", "--name", "operator.ros"), "operator.ros"),
    ],
)
def test_a_certificate_for_another_name_is_reported_at_once(
    federation: Federation, made: Certificates, role: tuple[str, ...], name: str
) -> None:
    """This includes names that only the world can resolve, such as those that match a pattern."""
    world = made.identity("world", access_control(scenario_file.from_text(SCENARIO), ROLES, {}))
    endpoint = tls_endpoint()
    if "[" in role[-1]:
        secured = ("--listen", endpoint, "--tls", str(world.tls), "--access", str(world.access))
        federation.start("world", federation.write(SIMULATED), *secured)
    folder = made.of("estimator.drone1")
    line = refusal(*(part.format(free=tls_endpoint()) for part in role), "--connect", endpoint, "--tls", str(folder))
    assert has_terms(line, str(folder), "estimator.drone1", name, "--tls")


def test_a_world_with_anothers_certificate_is_refused_before_it_compiles(made: Certificates, tmp_path: Path) -> None:
    (tmp_path / "scenario.yaml").write_text(SIMULATED)
    folder = made.of("recorder")
    line = refusal("world", str(tmp_path / "scenario.yaml"), "--listen", tls_endpoint(), "--tls", str(folder))
    assert has_terms(line, str(folder), "recorder", "world", "--tls")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", [("estimator", "drone1"), ("keys",), ("echo", "clock")])
def test_a_process_that_is_not_admitted_ends_at_once_with_the_reason(
    made: Certificates, role: tuple[str, ...], way: str
) -> None:
    folder = made.of("estimator.drone1")
    with ExitStack() as stack:
        endpoint, _ = stack.enter_context(hub(made, ["recorder"], ["recorder"]))
        if way != WAYS[0]:
            endpoint = stack.enter_context(site(made, endpoint, ["recorder"]))
        line = refusal(*role, "--connect", endpoint, "--tls", str(folder))
    assert has_terms(line, "estimator.drone1", "world" if way == WAYS[0] else SITE, "recorder", "zsim certs init")


# (command, terms that its refusal must contain) with the certificate of estimator.drone1
LACKING: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
    (("keys",), ("read", "**", "world/info")),
    (("echo", "drone/drone1/truth"), ("read", "drone/drone1/truth", "drone/drone1/sensor/*")),
    (("hz", "drone/*/estimate"), ("read", "drone/*/estimate", "drone/drone1/estimate")),
    (
        ("pub", "drone/drone2/cmd/mode", '{"mode": "land"}'),
        ("publish", "drone/drone2/cmd/mode", "drone/drone1/estimate"),
    ),
    (("ask", "world/control", "pause"), ("ask", "world/control", "world/info")),
    (("ask", "cluster/main/control", "hold"), ("ask", "cluster/main/control", "world/info")),
    (("fault", "add", "drone1", "gps_dropout"), ("ask", "world/control", "world/info")),
    (("fault", "clear"), ("ask", "world/control", "world/info")),
)


@pytest.mark.soak
def test_a_missing_right_is_reported(federation: Federation, made: Certificates) -> None:
    rules = access_control(scenario_file.from_text(SCENARIO), ["estimator.drone1", "operator.main"], {})
    endpoint, world = tls_endpoint(), made.identity("world", rules)
    secured = ("--listen", endpoint, "--tls", str(world.tls), "--access", str(world.access))
    federation.start("world", federation.write(SIMULATED), *secured)
    own, operator = ("--connect", endpoint, "--tls", str(made.of("estimator.drone1"))), str(made.of("operator.main"))
    for command, terms in LACKING:
        assert has_terms(refusal(*command, *own), "estimator.drone1", *terms, "zsim certs init"), command
    allowed = forked_commands.run("echo", "clock", "-n", "1", *own)
    assert allowed.code == 0, allowed
    stopped = forked_commands.run("ask", "world/control", "stop", "--connect", endpoint, "--tls", operator)
    assert stopped.code == 0, stopped


@pytest.mark.parametrize(
    ("role", "name"),
    [
        (("estimator", "drone1"), "estimator.drone1"),
        (("controller",), "controller.main"),
        (("record",), "recorder"),
        (("keys",), "operator.main"),
    ],
)
def test_a_certificate_of_another_authority_is_reported_at_once(
    made: Certificates, tmp_path: Path, role: tuple[str, ...], name: str
) -> None:
    folder = Certificates(tmp_path).of(name)
    with hub(made) as (endpoint, _):
        line = refusal(*role, "--connect", endpoint, "--tls", str(folder))
    assert has_terms(line, endpoint, "authority", "certs init")


def test_a_router_that_is_refused_upstream_ends(made: Certificates, tmp_path: Path) -> None:
    folder = Certificates(tmp_path).of(SITE)
    with hub(made) as (endpoint, _):
        arguments = ("router", "site", "--listen", tls_endpoint(), "--connect", endpoint, "--tls", str(folder))
        done = forked_commands.run(*arguments)
    assert done.code == USER_FAULT
    assert has_terms(done.stderr.splitlines()[-1], endpoint, "authority")


# name: (change to the folder, terms that the report must contain)
FILES: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "no folder": (lambda folder: [path.unlink() for path in folder.iterdir()], ("recorder/ca.pem", "No such file")),
    "no key": (lambda folder: (folder / "key.pem").unlink(), ("recorder/key.pem", "No such file")),
    "a key that is a folder": (
        lambda folder: ((folder / "key.pem").unlink(), (folder / "key.pem").mkdir()),
        ("recorder/key.pem", "Is a directory"),
    ),
    "another key": (
        lambda folder: (folder / "key.pem").write_bytes((folder.parent / "world" / "key.pem").read_bytes()),
        ("key values mismatch",),
    ),
    "no certificate": (
        lambda folder: (folder / "certificate.pem").write_text("nothing"),
        ("certificate.pem",),
    ),
    "another authority's": (
        lambda folder: (folder / "ca.pem").write_bytes((folder.parent / "stranger.pem").read_bytes()),
        ("certificate verify failed",),
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_unusable_certificate_files_are_reported(tmp_path: Path, name: str) -> None:
    made = Certificates(tmp_path)
    made.of("world")
    folder = made.of("recorder")
    Certificates(tmp_path / "strange")
    (folder.parent / "stranger.pem").write_bytes((tmp_path / "strange" / "ca.pem").read_bytes())
    change, tokens = FILES[name]
    change(folder)
    endpoint = tls_endpoint()
    line = refusal("keys", "--connect", endpoint, "--tls", str(folder))
    assert str(folder) in line
    assert has_terms(line, endpoint, *tokens), line


def test_incompatible_options_are_reported(made: Certificates, tmp_path: Path) -> None:
    folder, access = made.of("operator.main"), tmp_path / "access.json"
    (tmp_path / "scenario.yaml").write_text(SIMULATED)
    world = ("world", str(tmp_path / "scenario.yaml"), "--listen", tls_endpoint(), "--access", str(access))
    tls = ("--tls", str(made.of("world")))
    assert has_terms(refusal("keys", "--tls", str(folder)), "--tls", "tls/ADDRESS:PORT")
    assert has_terms(refusal("keys", "--connect", tls_endpoint()), "--tls")
    assert has_terms(refusal(*world[:2], "--access", str(access)), "--tls")
    assert has_terms(refusal(*world, *tls), "access.json: ", "No such file")
    for text, token in (("{", "JSON"), ('{"rules": 3}', "Zenoh")):
        access.write_text(text)
        assert has_terms(refusal(*world, *tls), "access.json: ", token)


def test_a_listener_at_another_address_than_in_its_certificate_is_reported(made: Certificates) -> None:
    endpoint = tls_endpoint("127.0.0.2")
    with connection.listen([endpoint], "zsim", "lockstep", made.identity("world")):
        line = refusal("keys", "--connect", endpoint, "--tls", str(made.of("operator.main")))
    assert has_terms(line, endpoint, "127.0.0.1", "127.0.0.2")


def test_a_listener_without_tls_is_reported(made: Certificates) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tls/127.0.0.1:{server.getsockname()[1]}"
        threading.Thread(target=answer_plainly, args=(server,), daemon=True).start()
        line = refusal("keys", "--connect", endpoint, "--tls", str(made.of("operator.main")))
    assert has_terms(line, endpoint, "TLS")


def answer_plainly(server: socket.socket) -> None:
    """Answer every connection as a web server without TLS does, until the server is closed."""
    with contextlib.suppress(OSError):
        while True:
            connection, _ = server.accept()
            with connection:
                connection.sendall(b"HTTP/1.0 400 Bad Request\r\n\r\n")


def test_peer_fault_finds_the_listeners_objection_to_a_certificate(made: Certificates, tmp_path: Path) -> None:
    past = Identity(HOST, made.of("recorder", days=-0.5, host="past"))
    foreign = Certificates(tmp_path).of("recorder")
    (foreign / "ca.pem").write_bytes((made.folder / "ca.pem").read_bytes())
    with hub(made) as (endpoint, _):
        assert peer_fault(Identity(HOST, made.of("recorder")), endpoint) is None
        assert "expired" in str(peer_fault(past, endpoint))
        assert "authority" in str(peer_fault(Identity(HOST, foreign), endpoint))
    assert peer_fault(Identity(HOST, made.of("recorder")), endpoint) is None  # no listener yet: one may still start


# Whole runs


def test_a_replay_contains_only_what_its_requester_may_read(federation: Federation, made: Certificates) -> None:
    rules = access_control(scenario_file.from_text(ONE), ["estimator.drone1", "operator.main"], {})
    endpoint, world = tls_endpoint(), made.identity("world", rules)
    secured = ("--listen", endpoint, "--tls", str(world.tls), "--access", str(world.access))
    federation.start("world", federation.write(ONE), "--rate", "1", "--duration", "600", *secured)
    with (
        RawClient(endpoint, made.of("estimator.drone1")) as estimator,
        RawClient(endpoint, made.of("operator.main")) as operator,
    ):
        status = KeyLog()
        estimator.subscribe("drone/drone1/sensor/status", status)
        status.until_fence("drone/drone1/sensor/status")
        mine = estimator.request("process/estimator.drone1/replay", "replay", from_ns=-1, keys=["**"])
        everything = operator.request("world/control", "replay", from_ns=-1, keys=["**"])
        keys_of_mine = {key for key, _ in mine["result"]}
        assert "drone/drone1/truth" in {key for key, _ in everything["result"]}
        assert keys_of_mine >= {"clock", "drone/drone1/sensor/imu", "drone/drone1/sensor/status"}
        assert all(
            permits(rights.rights_for("estimator.drone1", scenario_file.from_text(ONE)).reads, key)
            for key in keys_of_mine
        )
        refusal = estimator.request("process/estimator.drone1/replay", "stop")
        assert (refusal["ok"], parts(refusal["error"])) == (False, ("op", "'stop'"))
        assert operator.request("world/control", "stop")["ok"]


def test_a_secured_run_is_bit_identical_to_an_unsecured_one(federation: Federation, made: Certificates) -> None:
    endpoint = tls_endpoint()
    rules = access_control(scenario_file.from_text(PAIR), ["recorder", *PAIR_ROLES], {SITE: ["controller.main"]})
    world = made.identity("world", rules)
    at_site = made.identity(SITE, access_control(scenario_file.from_text(PAIR), ["controller.main"], {}, ["world"]))
    behind = tls_endpoint()

    def start(role: str, *arguments: str, name: str, at: str = endpoint) -> Role:
        where = ["--connect", at, "--tls", str(made.of(name)), "--host", f"host-of-{name}"]
        return federation.start(role, *arguments, *where)

    roles = [start("estimator", drone, name=f"estimator.{drone}") for drone in ("drone1", "drone2")]
    roles[0].line(r"waiting for a world of 'zsim' on tls/")
    roles.append(start("controller", "main", name="controller.main", at=behind))
    roles.append(start("record", "--out", str(federation.out), name="recorder"))
    router = federation.start(
        "router",
        "site",
        "--listen",
        behind,
        "--connect",
        endpoint,
        "--tls",
        str(at_site.tls),
        "--access",
        str(at_site.access),
    )
    secured = ["--listen", endpoint, "--tls", str(world.tls), "--access", str(world.access), "--expect", "recorder"]
    started = federation.start("world", federation.write(PAIR), *secured)
    for role in (started, *roles):
        role.ends(with_code=0)
    router.signal(signal.SIGTERM)
    router.ends(with_code=0)
    record = federation.record()
    hosts = {
        join["role"]: join["host"] for join in record.all("process/estimator.drone1/join", "process/recorder/join")
    }
    assert hosts == {"estimator": "host-of-estimator.drone1", "recorder": "host-of-recorder"}
    with Federation(federation.folder / "calm") as calm:
        calm.folder.mkdir()
        alone = ("run", calm.write(PAIR), "--in-process", "--no-report", "--out", str(calm.out))
        calm.start(*alone).ends(with_code=0)
        assert record.sha256() == calm.record().sha256()
