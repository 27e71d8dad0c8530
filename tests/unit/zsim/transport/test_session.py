"""Sessions: opening, closing, permissions and the check for subscribers."""

import shutil
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from zsim.errors import SessionError
from zsim.transport.session import Session, open_session
from zsim.transport.tls import Identity, Permissions

ALONE = ("unshare", "--map-root-user", "--mount")  # Linux: a private mount namespace
WITH_SHM = "mount -t tmpfs -o {options} tmpfs /dev/shm && exec {python} -c '{code}'"
OPENS = """
import os
from zsim.errors import SessionError
from zsim.transport import zenoh_settings
from zsim.transport.session import open_session
from zsim.transport.tls import Identity

who = Identity("here")
settings = zenoh_settings.common("router", "lockstep") | zenoh_settings.listening(["tcp/127.0.0.1:0"], who)
with open_session(settings, "zsim", who, SessionError):
    print(os.listdir("/dev/shm"))
"""


@pytest.mark.skipif(
    not shutil.which("unshare") or subprocess.run([*ALONE, "true"], capture_output=True).returncode != 0,
    reason="needs mount namespaces (Linux, unshare)",
)
@pytest.mark.parametrize("options", ["size=64k", "ro", "size=1g"])
def test_a_session_needs_no_shared_memory_and_leaves_nothing_in_it(options: str) -> None:
    code = WITH_SHM.format(options=options, python=sys.executable, code=OPENS)
    done = subprocess.run([*ALONE, "sh", "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr


def test_a_stalled_far_end_does_not_make_closing_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh gives up closing after 10 s, which loses nothing that the far end would still have taken."""
    closed: list[None] = []

    def close() -> None:
        closed.append(None)
        raise zenoh.ZError("close operation timed out!")

    monkeypatch.setattr(zenoh, "open", lambda config: SimpleNamespace(close=close))
    with open_session({}, "zsim", Identity("here"), SessionError):
        pass
    assert closed


def test_unreadable_permissions_raise_a_session_error() -> None:
    session = Session(SimpleNamespace(), "zsim", Identity("here"))  # type: ignore[arg-type]
    session.permissions = Permissions("world", "x", {"publish": ("zsim//clock",)})
    with pytest.raises(SessionError, match="clock"):
        session.put_raw("clock", b"")


class LatePublisher:
    """A publisher that gains a subscriber between Zenoh's answer and its use."""

    def declare_matching_listener(self, listener: Any) -> SimpleNamespace:
        self._listener = listener
        return SimpleNamespace(undeclare=lambda: None)

    @property
    def matching_status(self) -> SimpleNamespace:
        self._listener(SimpleNamespace(matching=True))
        return SimpleNamespace(matching=False)

    def undeclare(self) -> None:
        return


def test_a_subscription_during_the_check_for_subscribers_is_noticed() -> None:
    raw: Any = SimpleNamespace(declare_publisher=lambda key, **settings: LatePublisher())
    assert Session(raw, "zsim", Identity("here")).has_subscribers("drone/*/truth")


def test_an_expression_that_zenoh_refuses_is_not_listed_as_read() -> None:
    def refuse(expression: str, *_: Any, **__: Any) -> None:
        raise zenoh.ZError(f"Invalid Key Expr `{expression}`")

    raw: Any = SimpleNamespace(declare_subscriber=refuse)
    session = Session(raw, "zsim", Identity("here"))
    for subscribe in (session.subscribe, lambda key: session.declare_subscriber(key, lambda sample: None)):
        with pytest.raises(SessionError, match="drone//truth"):
            subscribe("drone//truth")
    assert session.reads == []
