"""What `zsim push` compiles on a host: what its roles run, and no more."""

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
def test_what_the_roles_of_a_host_run_is_compiled(
    monkeypatch: pytest.MonkeyPatch, extras: tuple[str, ...], built: list[str]
) -> None:
    done: list[str] = []
    monkeypatch.setattr(warm_up, "_build_world", lambda: done.append("world"))
    monkeypatch.setattr(warm_up, "_rehearse_agents", lambda: done.append("agents"))
    warm_up.main(extras)
    assert done == built


def test_agents_of_every_kind_rehearse_without_a_world(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("zsim_world.run.world.World")
    warm_up.main(["agents"])
