"""The command `zsim push`."""

from pathlib import Path
from typing import Annotated

import typer


def push(
    hosts: Annotated[Path, typer.Option("--hosts", help="Inventory (YAML): which hosts, which role where.")],
    host: Annotated[list[str] | None, typer.Option("--host", help="Only this host. Repeatable.")] = None,
    extra: Annotated[
        list[str] | None, typer.Option("--extra", help="An extra beside those of the host's roles. Repeatable.")
    ] = None,
) -> None:
    """Install zsim on the hosts, each with the extras that its roles need; they need ssh and Python, no internet."""
    import asyncio

    from zsim_deploy.hosts.stages import Stages
    from zsim_deploy.inventory import inventory
    from zsim_deploy.push.push import default_cache
    from zsim_deploy.push.push import push as push_to

    placed = inventory.load(hosts)
    with Stages() as stages:
        done = asyncio.run(push_to(placed, host or [], extra or [], stages.tell, default_cache()))
    changed = sum(done.values())
    print(f"installed on {changed} of {len(done)} hosts" if changed else "nothing to do; all hosts have what they need")
