"""What `zsim push` compiles on a host: exactly the code that its roles run."""

from types import SimpleNamespace

import pytest

from zsim_deploy.roles import warm_up


@pytest.mark.parametrize(
    ("extras", "built"),
    [
        ((), []),
        (("record", "report"), []),
        (("agents",), ["agents"]),
        (("record", "world"), ["world", "agents"]),
        (("all",), ["world", "agents"]),
    ],
)
def test_only_the_code_of_the_roles_of_a_host_is_compiled(
    monkeypatch: pytest.MonkeyPatch, extras: tuple[str, ...], built: list[str]
) -> None:
    done: list[str] = []
    monkeypatch.setattr("zsim_world.run.world.World", lambda *_: done.append("world"))
    group = SimpleNamespace(rehearse=lambda: done.append("agents"))
    monkeypatch.setattr("zsim_agents.hosting.hosted", lambda *_: group)
    warm_up.main(extras)
    assert done == built


def test_agents_of_every_kind_rehearse_without_a_world(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("zsim_world.run.world.World")
    warm_up.main(["agents"])
