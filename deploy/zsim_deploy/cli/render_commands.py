"""`zsim render`: files for those who launch with what they already have, from the inventory of `zsim up`."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from zsim_deploy.options.arguments import (
    Duration,
    RateOption,
    Realtime,
    ScenarioPath,
    Seed,
    Set,
    load_scenario,
    mode_and_rate,
    pace_options,
)

app = typer.Typer(
    name="render", help="Write systemd units, compose files or manifests for an inventory.", no_args_is_help=True
)

Hosts = Annotated[Path, typer.Option("--hosts", help="Inventory (YAML): which hosts, which role where.")]
Out = Annotated[Path, typer.Option("--out", help="Folder to write into; what was rendered there before is replaced.")]


@app.command()
def systemd(
    scenario: ScenarioPath,
    hosts: Hosts,
    out: Out,
    seed: Seed = None,
    duration: Duration = None,
    realtime: Realtime = False,
    rate: RateOption = None,
    set_: Set = None,
) -> None:
    """Write HOST/zsim-PROCESS.service and HOST/zsim.target for every host."""
    from zsim_deploy.render.systemd import render

    _write(out, "systemd", render(*_read(hosts, scenario, set_, seed, duration), _pace(realtime, rate)))


@app.command()
def compose(
    scenario: ScenarioPath,
    hosts: Hosts,
    out: Out,
    seed: Seed = None,
    duration: Duration = None,
    realtime: Realtime = False,
    rate: RateOption = None,
    set_: Set = None,
) -> None:
    """Write HOST/compose.yaml and HOST/Dockerfile for every host."""
    from zsim_deploy.render.compose import render

    _write(out, "compose", render(*_read(hosts, scenario, set_, seed, duration), _pace(realtime, rate)))


@app.command()
def kubernetes(
    scenario: ScenarioPath,
    hosts: Hosts,
    out: Out,
    image: Annotated[str | None, typer.Option(help="Image as the nodes find it (default zsim:VERSION).")] = None,
    seed: Seed = None,
    duration: Duration = None,
    realtime: Realtime = False,
    rate: RateOption = None,
    set_: Set = None,
) -> None:
    """Write the manifests of a run, a Dockerfile, and a script that makes the Secrets from the certificates."""
    from zsim_deploy.render.kubernetes import IMAGE, render

    _write(
        out, "kubernetes", render(*_read(hosts, scenario, set_, seed, duration), _pace(realtime, rate), image or IMAGE)
    )


def _read(
    hosts: Path, scenario: Path, overrides: list[str] | None, seed: int | None, duration: float | None
) -> tuple[Any, Any]:
    """Return the inventory and the scenario; say what has no command in them."""
    from zsim_deploy.inventory import inventory
    from zsim_deploy.render.rendered_process import own_programs

    loaded = load_scenario(scenario, overrides, seed, duration)
    placed = inventory.load(hosts)
    for remark in own_programs(placed, loaded):
        print(remark, file=sys.stderr)
    return placed, loaded


def _pace(realtime: bool, rate: float | None) -> list[str]:
    """Return the world's options for that."""
    return pace_options(*mode_and_rate(realtime, rate))


def _write(out: Path, target: str, texts: Mapping[str, str]) -> None:
    from zsim_deploy.render.render_folder import write

    removed = write(out, target, texts)
    print(
        f"{len(texts)} files in {out}" + (f"; removed of an earlier rendering: {', '.join(removed)}" if removed else "")
    )
