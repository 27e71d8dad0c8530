"""Security on the wire: who gets in, who may do what, what a bad certificate says, and that a run is the same."""

import contextlib
import re
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from federation import ONE, PAIR, PAIR_ROLES, ROOT, ZSIM, Federation, Role
from rights_table import KEYS, ROLES, SCENARIO, keys_of
from secured import HOST, PREFIX, READY, SHORT_S, SITE, Certificates, Heard, Tryer, hub, site, tls_endpoint
from wire import PATIENCE_S

from zsim.scenario import rights, scenario_file
from zsim.scenario.rights import permits
from zsim.transport import session
from zsim.transport.tls import Identity, peer_fault
from zsim_deploy.inventory.enrolment import access_control

WAYS = ("at the world", "through a router")
TOKENS = tuple(key for key in KEYS if key.startswith("process/") and key.count("/") == 1)
USER_FAULT = 2  # exit code


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("certs"))


@contextmanager
def reached(made: Certificates, role: str, way: str) -> Iterator[tuple[Tryer, Any]]:
    """Yield a program with the certificate of a role, and the session of the world that it reaches one way."""
    with ExitStack() as stack:
        direct = way == WAYS[0]
        endpoint, link = stack.enter_context(hub(made, [role] if direct else [], [] if direct else [role]))
        link.answer("clock", lambda query: answer_once(query, "clock"))
        if not direct:
            endpoint = stack.enter_context(site(made, endpoint, [role]))
        tryer = stack.enter_context(Tryer(endpoint, made.of(role)))
        tryer.settle()
        yield tryer, link


def answer_once(query: Any, key: str) -> None:
    query.reply(key, key.encode())
    query.end()


def tell_last(link: Any, key: str) -> None:
    """Publish behind everything that the session has published before, views included: they have a queue of their own."""
    block, last = zenoh.CongestionControl.BLOCK, zenoh.Priority.BACKGROUND
    link._raw.put(f"{PREFIX}{key}", key.encode(), congestion_control=block, priority=last)


# The table of rights, tried out


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", ROLES)
def test_what_a_role_may_publish(made: Certificates, role: str, way: str) -> None:
    fence = f"process/{role}/health"
    with reached(made, role, way) as (tryer, link):
        heard, ready = Heard(), Heard()
        for expression in ("@batch", "**"):
            link.on_message(expression, lambda sample: (ready if sample.payload == READY else heard).take(sample.key))
        tryer.until_heard(fence, ready)
        for act in (tryer.put, tryer.publish):
            for key in KEYS:
                if key != fence:
                    act(key)
            act(fence)
            assert heard.until_fence(fence) == keys_of(role, "p")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", ROLES)
def test_what_a_role_may_read(made: Certificates, role: str, way: str) -> None:
    fence = "world/event"
    with reached(made, role, way) as (tryer, link):
        heard = Heard()
        for key in KEYS:
            tryer.subscribe(key, heard)
        for expression in ("**", "@batch", "drone/*/truth", "drone/**", "*/*/*/*"):
            tryer.subscribe(expression, Heard())
        tryer.settle()
        for key in KEYS:
            if key != fence:
                link.put_raw(key, key.encode())
        tell_last(link, fence)
        assert heard.until_fence(fence) == keys_of(role, "r")


@pytest.mark.parametrize("role", ROLES)
def test_a_wildcard_brings_no_more_than_its_parts(made: Certificates, role: str) -> None:
    with reached(made, role, WAYS[0]) as (tryer, link):
        heard, fence = Heard(), Heard()
        for expression in ("**", "@batch", "drone/**", "drone/*/*", "process/**", "*"):
            tryer.subscribe(expression, heard)
        tryer.subscribe("world/event", fence)
        tryer.settle()
        for key in KEYS:
            if key != "world/event":
                link.put_raw(key, key.encode())
        tell_last(link, "world/event")
        fence.until_fence("world/event")
        heard.take("the end")
        assert heard.until_fence("the end") - {"the end"} <= keys_of(role, "r")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", ROLES)
def test_what_a_role_may_get(made: Certificates, role: str, way: str) -> None:
    fence = f"process/{role}/replay"
    with reached(made, role, way) as (tryer, link):
        asked, answered = Heard(), Heard()

        def answer(query: Any) -> None:
            asked.take(query.expression)
            answer_once(query, query.expression)

        for expression in ("@batch", "**"):
            link.answer(expression, answer)
        tryer.until_answered(fence)
        asked = Heard()
        for key in KEYS:
            if key != fence:
                tryer.ask(key, answered)
        tryer.ask(fence, answered)
        assert asked.until_fence(fence) == keys_of(role, "g")
        assert answered.until(lambda came: came >= keys_of(role, "g")) == keys_of(role, "g")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", ROLES)
def test_what_a_role_may_answer(made: Certificates, role: str, way: str) -> None:
    with reached(made, role, way) as (tryer, link):
        for key in KEYS:
            if key != "clock":
                tryer.answer(key)
        tryer.settle()
        assert {sample.key for key in KEYS if key != "clock" for sample in link.get(key)} == keys_of(role, "a")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", ROLES)
def test_whose_life_a_role_may_show(made: Certificates, role: str, way: str) -> None:
    with reached(made, role, way) as (tryer, link):
        heard = Heard()
        link.on_token("process/*", lambda key, alive: heard.take(key))
        for key in sorted(TOKENS, key=lambda key: key in keys_of(role, "t")):
            tryer.token(key)
        assert heard.until(lambda came: came >= keys_of(role, "t")) == keys_of(role, "t")


@pytest.mark.parametrize("role", ROLES)
def test_whose_life_a_role_may_see(made: Certificates, role: str) -> None:
    with reached(made, role, WAYS[0]) as (tryer, link):
        heard, fence = Heard(), Heard()
        tryer.watch("process/*", heard)
        tryer.subscribe("world/event", fence)
        tryer.settle()
        for key in TOKENS:
            link.declare_token(key)
        link.put_raw("world/event", b"event")
        fence.until_fence("world/event")
        if keys_of(role, "w"):
            assert heard.until(lambda came: came >= keys_of(role, "w")) == keys_of(role, "w")
        heard.take("the end")
        assert heard.until_fence("the end") == {"the end"}


def test_a_router_s_own_certificate_opens_no_more_than_its_clients_have(made: Certificates) -> None:
    fence = "process/estimator.drone1/health"
    with hub(made, [], ["estimator.drone1"]) as (endpoint, link), Tryer(endpoint, made.of(SITE)) as tryer:
        heard = Heard()
        link.on_message("**", lambda sample: heard.take(sample.key))
        for key in KEYS:
            if key != fence:
                tryer.put(key)
        tryer.put(fence)
        assert heard.until_fence(fence) == keys_of("estimator.drone1", "p")


# Who is let in at all

OUTSIDERS = ("no certificate", "another authority", "plaintext", "plaintext with credentials", "an expired certificate")


@pytest.mark.parametrize("who", OUTSIDERS)
def test_an_outsider_gets_nothing(made: Certificates, tmp_path: Path, who: str) -> None:
    with hub(made) as (endpoint, link):
        heard = Heard()
        link.on_message("**", lambda sample: heard.take(sample.key))
        place, folder = outsider(who, made, tmp_path, endpoint)
        with pytest.raises(zenoh.ZError), Tryer(place, folder, SHORT_S) as tryer:
            tryer.put("drone/drone1/cmd/mode")
        with Tryer(endpoint, made.of("operator.main")) as tryer:
            tryer.put("process/operator.main/health")
            assert heard.until_fence("process/operator.main/health") == {"process/operator.main/health"}


def outsider(who: str, made: Certificates, tmp_path: Path, endpoint: str) -> tuple[str, Path | None]:
    """Return where an outsider connects, and with which folder."""
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
        heard, got, links = Heard(), Heard(b"world"), Heard()
        link.on_message("**", lambda sample: sample.payload != b"world" and heard.take(sample.key))
        link.on_link(lambda up: links.take("up" if up else "down"))
        with Tryer(endpoint, made.of("estimator.drone1")) as stranger:
            links.until_fence("up")
            for expression in (*KEYS, "**"):
                stranger.subscribe(expression, got)
            for key in KEYS:
                stranger.put(key)
                link.put_raw(key, b"world")
        links.until_fence("down")  # the world has taken all that came on the link
        heard.take("the end")
        got.take("the end")
        assert heard.until_fence("the end") == {"the end"}
        assert got.until_fence("the end") == {"the end"}


# What a bad certificate says


def refused(*arguments: str) -> str:
    """Run a command that must be refused at once; return its one line."""
    done = subprocess.run(
        [*ZSIM, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == USER_FAULT, done.stderr
    assert done.stdout == ""
    lines = [line for line in done.stderr.splitlines() if not line.startswith("waiting for a world of")]
    assert len(lines) == 1, done.stderr
    return lines[0]


def test_a_certificate_whose_time_is_over_says_so(made: Certificates) -> None:
    folder = made.of("estimator.drone1", days=-0.5, host="past")
    with hub(made) as (endpoint, _):
        said = refused("estimator", "drone1", "--connect", endpoint, "--tls", str(folder))
    assert re.fullmatch(
        rf"cannot connect to {endpoint}: the certificate of estimator.drone1 expired on \d{{4}}-\d\d-\d\d; "
        "make new ones with zsim certs init --renew",
        said,
    )


def test_a_world_whose_time_is_over_says_so(made: Certificates, tmp_path: Path) -> None:
    (tmp_path / "scenario.yaml").write_text(SCENARIO)
    folder = made.of("world", days=-0.5, host="past")
    said = refused("world", str(tmp_path / "scenario.yaml"), "--listen", tls_endpoint(), "--tls", str(folder))
    assert "the certificate of world expired on " in said


@pytest.mark.parametrize("role", [("estimator", "drone1"), ("controller",), ("record",), ("keys",)])
def test_a_foreign_certificate_is_a_line_at_once(made: Certificates, tmp_path: Path, role: tuple[str, ...]) -> None:
    folder = Certificates(tmp_path).of("estimator.drone1")
    with hub(made) as (endpoint, _):
        said = refused(*role, "--connect", endpoint, "--tls", str(folder))
    assert said == (
        f"cannot connect to {endpoint}: the certificate of who listens there is of another authority than ours; "
        "make new ones with zsim certs init and use one set"
    )


def test_a_router_that_is_refused_upstream_ends(made: Certificates, tmp_path: Path) -> None:
    folder = Certificates(tmp_path).of(SITE)
    with hub(made) as (endpoint, _):
        arguments = ("router", "site", "--listen", tls_endpoint(), "--connect", endpoint, "--tls", str(folder))
        done = subprocess.run(
            [*ZSIM, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
    assert done.returncode == USER_FAULT
    assert done.stderr.splitlines()[-1].startswith(f"cannot connect to {endpoint}: the certificate of who listens")


# name: (folder's content changed how, what the line must say)
FILES = {
    "no folder": (lambda folder: [path.unlink() for path in folder.iterdir()], "ca.pem: cannot be read (No such file"),
    "no key": (lambda folder: (folder / "key.pem").unlink(), "key.pem: cannot be read (No such file or directory)"),
    "a key that is a folder": (
        lambda folder: ((folder / "key.pem").unlink(), (folder / "key.pem").mkdir()),
        "key.pem: cannot be read (Is a directory)",
    ),
    "another key": (
        lambda folder: (folder / "key.pem").write_bytes((folder.parent / "world" / "key.pem").read_bytes()),
        "do not go together (key values mismatch)",
    ),
    "no certificate": (lambda folder: (folder / "certificate.pem").write_text("nothing"), "do not go together"),
    "another authority's": (
        lambda folder: (folder / "ca.pem").write_bytes((folder.parent / "stranger.pem").read_bytes()),
        "do not go together (certificate verify failed)",
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_files_of_no_use_are_a_line(tmp_path: Path, name: str) -> None:
    made = Certificates(tmp_path)
    made.of("world")
    folder = made.of("recorder")
    Certificates(tmp_path / "strange")
    (folder.parent / "stranger.pem").write_bytes((tmp_path / "strange" / "ca.pem").read_bytes())
    change, says = FILES[name]
    change(folder)
    endpoint = tls_endpoint()
    said = refused("keys", "--connect", endpoint, "--tls", str(folder))
    assert said.startswith(f"cannot connect to {endpoint}: {folder}")
    assert says in said


def test_options_that_do_not_go_together_are_a_line(made: Certificates, tmp_path: Path) -> None:
    folder, access = made.of("operator.main"), tmp_path / "access.json"
    (tmp_path / "scenario.yaml").write_text(SCENARIO)
    world = ("world", str(tmp_path / "scenario.yaml"), "--listen", tls_endpoint(), "--access", str(access))
    tls = ("--tls", str(made.of("world")))
    assert "is not encrypted; with --tls it must be tls/" in refused("keys", "--tls", str(folder))
    assert "needs a certificate; give --tls" in refused("keys", "--connect", tls_endpoint())
    assert "access control goes by certificate; give --tls too" in refused(*world[:2], "--access", str(access))
    assert "access.json: cannot be read (No such file" in refused(*world, *tls)
    access.write_text("{")
    assert "access.json: is not JSON" in refused(*world, *tls)
    access.write_text('{"rules": 3}')
    assert "access.json: is no access control of Zenoh's" in refused(*world, *tls)


def test_who_listens_elsewhere_than_its_certificate_says(made: Certificates) -> None:
    endpoint = tls_endpoint("127.0.0.2")
    with session.listen([endpoint], "zsim", "lockstep", made.identity("world")):
        said = refused("keys", "--connect", endpoint, "--tls", str(made.of("operator.main")))
    assert "the certificate of who listens there is not for 127.0.0.2; name it in the hosts file" in said


def test_who_listens_without_tls(made: Certificates) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tls/127.0.0.1:{server.getsockname()[1]}"
        threading.Thread(target=answer_plainly, args=(server,), daemon=True).start()
        said = refused("keys", "--connect", endpoint, "--tls", str(made.of("operator.main")))
    assert "who listens there speaks no TLS" in said


def answer_plainly(server: socket.socket) -> None:
    """Answer every connection as a web server without TLS does, until the server is closed."""
    with contextlib.suppress(OSError):
        while True:
            connection, _ = server.accept()
            with connection:
                connection.sendall(b"HTTP/1.0 400 Bad Request\r\n\r\n")


def test_what_the_listener_thinks_of_our_certificate(made: Certificates, tmp_path: Path) -> None:
    past = Identity(HOST, made.of("recorder", days=-0.5, host="past"))
    foreign = Certificates(tmp_path).of("recorder")
    (foreign / "ca.pem").write_bytes((made.folder / "ca.pem").read_bytes())
    with hub(made) as (endpoint, _):
        assert peer_fault(Identity(HOST, made.of("recorder")), endpoint) is None
        assert "our certificate has expired by the clock of who listens" in str(peer_fault(past, endpoint))
        assert "our certificate is of another authority" in str(peer_fault(Identity(HOST, foreign), endpoint))
    assert peer_fault(Identity(HOST, made.of("recorder")), endpoint) is None  # nobody listens: it may come


# A run


def test_a_replay_brings_what_its_asker_may_read(federation: Federation, made: Certificates) -> None:
    rules = access_control(scenario_file.from_text(ONE), ["estimator.drone1", "operator.main"], {})
    endpoint, world = tls_endpoint(), made.identity("world", rules)
    secured = ("--listen", endpoint, "--tls", str(world.tls), "--access", str(world.access))
    federation.start("world", federation.write(ONE), "--rate", "1", "--duration", "600", *secured)
    with (
        Tryer(endpoint, made.of("estimator.drone1")) as estimator,
        Tryer(endpoint, made.of("operator.main")) as operator,
    ):
        status = Heard()
        estimator.subscribe("drone/drone1/sensor/status", status)
        status.until_fence("drone/drone1/sensor/status")
        mine = estimator.request("process/estimator.drone1/replay", "replay", from_ns=-1, keys=["**"])
        everything = operator.request("world/control", "replay", from_ns=-1, keys=["**"])
        keys_of_mine = {key for key, _ in mine["result"]}
        assert "drone/drone1/truth" in {key for key, _ in everything["result"]}
        assert keys_of_mine >= {"clock", "drone/drone1/sensor/imu", "drone/drone1/sensor/status"}
        assert all(
            permits(rights.of("estimator.drone1", scenario_file.from_text(ONE)).reads, key) for key in keys_of_mine
        )
        refusal = estimator.request("process/estimator.drone1/replay", "stop")
        assert (refusal["ok"], refusal["error"]) == (False, "op is 'stop'; must be replay")
        assert operator.request("world/control", "stop")["ok"]


def test_a_secured_run_is_the_same_run(federation: Federation, made: Certificates) -> None:
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
