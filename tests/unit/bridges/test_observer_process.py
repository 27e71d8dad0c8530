"""A process that shows and never gates: whom it leaves its name to."""

import os

from fake_link import FakeLink

from zsim.contract import keys
from zsim.contract.messages import Info, Origin
from zsim.contract.run_messages import Event
from zsim.runtime.participant import Participant

INFO = Info(0, 0, 1, "r", "zsim", "lockstep", 0.0, 1, 1, 1, 1, Origin(0.0, 0.0, 0.0), (), (), "", "", "", "")
ME = "console.1"


def joined(link: FakeLink) -> Participant:
    observer = Participant(link, INFO, ME)  # type: ignore[arg-type]
    observer.announce()
    tell(link, "join", link.published_on("process/*/join")[0].incarnation, os.getpid())
    return observer


def tell(link: FakeLink, kind: str, incarnation: int, pid: int) -> None:
    data = {"incarnation": incarnation, "host": link.host, "pid": pid}
    link.deliver(keys.EVENT, Event(0, 0, kind, ME, ME, "", data))


def test_another_process_of_its_name_ends_it():
    link = FakeLink()
    observer = joined(link)
    tell(link, "superseded", 7, os.getpid() + 1)
    assert observer.superseded


def test_a_join_of_its_own_process_that_it_did_not_publish_is_answered_by_a_newer_one():
    link = FakeLink()
    observer = joined(link)
    tell(link, "superseded", 7, os.getpid())
    observer.tick()
    first, second = link.published_on("process/*/join")
    assert not observer.superseded
    assert second.incarnation not in {first.incarnation, 7}
