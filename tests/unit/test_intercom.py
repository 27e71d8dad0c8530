"""The socket on which `zsim ps`, `restart`, `move` and `down` reach the launcher."""

import json
import socket

import pytest

from zsim.errors import RunError
from zsim_deploy import intercom
from zsim_deploy.intercom import Intercom


@pytest.fixture(autouse=True)
def own_place(tmp_path, monkeypatch):
    monkeypatch.setattr(intercom.tempfile, "gettempdir", lambda: str(tmp_path))


@pytest.fixture
def line():
    def refuse() -> None:
        raise RunError("host is 'h9'; must be one of h1")

    found = Intercom("zsim", {"add": lambda a, b: a + b, "refuse": refuse})
    yield found
    found.close()


@pytest.mark.usefixtures("line")
def test_an_answer_comes_back():
    assert intercom.ask("zsim", "add", a=2, b=3) == 5


@pytest.mark.usefixtures("line")
@pytest.mark.parametrize(
    ("op", "args", "says"),
    [
        ("refuse", {}, "host is 'h9'"),
        ("dance", {}, "no request that is understood"),
        ("add", {"a": 1}, "no request that is understood"),
    ],
)
def test_what_is_refused_says_why(op, args, says):
    with pytest.raises(RunError, match=says):
        intercom.ask("zsim", op, **args)


@pytest.mark.usefixtures("line")
def test_garbage_is_answered_and_the_next_one_served():
    with socket.socket(socket.AF_UNIX) as raw:
        raw.connect(str(intercom.place("zsim")))
        raw.sendall(b"\xff\n")
        assert not json.loads(raw.makefile("rb").readline())["ok"]
    assert intercom.ask("zsim", "add", a=1, b=1) == 2


@pytest.mark.usefixtures("line")
def test_a_federation_is_up_only_once():
    with pytest.raises(RunError, match="is up already"):
        Intercom("zsim", {})


def test_nobody_is_up():
    with pytest.raises(RunError, match="no `zsim up` of federation 'zsim' runs"):
        intercom.ask("zsim", "ps")


def test_the_socket_of_a_killed_launcher_is_no_hindrance():
    place = intercom.place("zsim")
    place.parent.mkdir(parents=True)
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(place))
    found = Intercom("zsim", {"add": lambda a, b: a + b})
    assert intercom.ask("zsim", "add", a=1, b=2) == 3
    found.close()
    assert not place.exists()


def test_only_its_user_may_come_in(line):
    assert intercom.place("zsim").parent.stat().st_mode & 0o077 == 0
