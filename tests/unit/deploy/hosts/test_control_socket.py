"""The socket on which `zsim ps`, `restart`, `move` and `down` reach the launcher."""

import json
import os
import socket

import pytest
from refused import refused

from zsim.errors import HostsError, RunError
from zsim_deploy.hosts import control_socket
from zsim_deploy.hosts.control_socket import ControlSocket


@pytest.fixture(autouse=True)
def own_place(tmp_path, monkeypatch):
    monkeypatch.setattr(control_socket.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)


@pytest.fixture
def line():
    def refuse() -> None:
        raise RunError("host is 'h9'; must be one of h1")

    def lack() -> None:
        raise HostsError("certs/h3/x/key.pem: cannot be read")

    def hang() -> None:
        raise TimeoutError

    acts = {"add": lambda a, b: a + b, "refuse": refuse, "lack": lack, "hang": hang, "fail": lambda: [].index(1)}
    found = ControlSocket("zsim", acts)
    yield found
    found.close()


@pytest.mark.usefixtures("line")
def test_a_request_is_answered_and_a_federation_is_up_only_once():
    assert control_socket.ask("zsim", "add", a=2, b=3) == 5
    assert control_socket.place("zsim").parent.stat().st_mode & 0o077 == 0
    with refused(RunError, "already up", "zsim down --federation zsim", "--set federation=NAME"):
        ControlSocket("zsim", {})


@pytest.mark.usefixtures("line")
@pytest.mark.parametrize(
    ("op", "args", "terms"),
    [
        ("refuse", {}, ("host", "'h9'")),
        ("lack", {}, ("certs/h3/x/key.pem", "read")),
        ("hang", {}, ("too long",)),
        ("fail", {}, ("internal error", "ValueError('1…")),
        ("dance", {}, ("not a request",)),
        ("add", {"a": 1}, ("not a request",)),
    ],
)
def test_a_refusal_gives_the_reason(op, args, terms):
    with refused(RunError, *terms):
        control_socket.ask("zsim", op, **args)


@pytest.mark.usefixtures("line")
def test_garbage_is_answered_and_the_next_request_served():
    with socket.socket(socket.AF_UNIX) as raw:
        raw.connect(str(control_socket.place("zsim")))
        raw.sendall(b"\xff\n")
        assert not json.loads(raw.makefile("rb").readline())["ok"]
    assert control_socket.ask("zsim", "add", a=1, b=1) == 2


def test_the_socket_of_a_killed_launcher_is_replaced():
    place = control_socket.place("zsim")
    place.parent.mkdir(mode=0o700)
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(place))
    found = ControlSocket("zsim", {"add": lambda a, b: a + b})
    assert control_socket.ask("zsim", "add", a=1, b=2) == 3
    found.close()
    assert not place.exists()


def test_a_launcher_that_does_not_answer_is_not_reported_as_absent(monkeypatch):
    monkeypatch.setattr(control_socket, "ANSWER_S", 0.05)
    place = control_socket.place("zsim")
    place.parent.mkdir(mode=0o700)
    with socket.socket(socket.AF_UNIX) as busy:
        busy.bind(str(place))
        busy.listen()
        with refused(RunError, "zsim up", "not answered", "ps"):
            control_socket.ask("zsim", "ps")


@pytest.mark.parametrize("mode", [0o777, 0o750, None])
def test_a_folder_open_to_others_or_a_symbolic_link_is_refused(tmp_path, mode):
    folder = control_socket.place("zsim").parent
    if mode is None:
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        folder.mkdir()
        folder.chmod(mode)
    with refused(RunError, "private folder", *([f"mode {mode:o}"] if mode else [])):
        ControlSocket("zsim", {})


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder away")
def test_a_folder_of_another_user_is_refused():
    folder = control_socket.place("zsim").parent
    folder.mkdir(mode=0o700)
    os.chown(folder, 12345, 12345)
    with pytest.raises(RunError, match="owner 12345"):
        ControlSocket("zsim", {})


def test_a_path_that_is_too_long_is_refused(tmp_path, monkeypatch):
    long = tmp_path / ("x" * 120)
    long.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(long))
    assert control_socket.place("zsim") == long / "zsim" / "zsim.sock"
    with refused(RunError, "107 bytes", "XDG_RUNTIME_DIR", "TMPDIR"):
        ControlSocket("zsim", {})
    with refused(RunError, "no", "zsim up", "'zsim'"):
        control_socket.ask("zsim", "ps")
