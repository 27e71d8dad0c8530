"""`zsim render`: files for those who launch with what they already have, from the inventory of `zsim up`."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from zsim_deploy.arguments import Duration, RateOption, Realtime, ScenarioPath, Seed, Set

app = typer.Typer(
    name="render", help="Write systemd units, compose files or manifests for an inventory.", no_args_is_help=True
)

Hosts = Annotated[Path, typer.Option("--hosts", help="Inventory (YAML): which hosts, which role where.")]
Out = Annotated[Path, typer.Option("--out", help="Folder to write into; files of the same name are replaced.")]


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

    _write(out, render(*_read(hosts, scenario, set_, seed, duration), _pace(realtime, rate)))


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

    _write(out, render(*_read(hosts, scenario, set_, seed, duration), _pace(realtime, rate)))


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

    _write(out, render(*_read(hosts, scenario, set_, seed, duration), _pace(realtime, rate), image or IMAGE))


def _read(
    hosts: Path, scenario: Path, overrides: list[str] | None, seed: int | None, duration: float | None
) -> tuple[Any, Any]:
    """Return the inventory and the scenario; say what has no command in them."""
    from zsim import scenario_file
    from zsim_deploy import inventory
    from zsim_deploy.render.process import own_programs

    loaded = scenario_file.load(scenario, overrides or (), seed=seed, duration_s=duration)
    placed = inventory.load(hosts)
    for remark in own_programs(placed, loaded):
        print(remark, file=sys.stderr)
    return placed, loaded


def _pace(realtime: bool, rate: float | None) -> list[str]:
    """Return the world's options for that."""
    from zsim_deploy.render.process import REALTIME

    if rate is not None and not 0 < rate <= 1000:
        raise typer.BadParameter(f"--rate is {rate:g}; must be > 0 and <= 1000")
    return [*([REALTIME] if realtime else []), *(["--rate", str(rate)] if rate else [])]


def _write(out: Path, texts: Mapping[str, str]) -> None:
    """Write the texts into a folder; a host named `..` does not lead out of it."""
    from zsim.errors import RunError

    root = out.resolve()
    for name, text in texts.items():
        path = (root / name).resolve()
        if path.parent != root and path.parent.parent != root:
            raise RunError(f"{name}: leads out of {out}; rename that host in the inventory")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise RunError(f"{path}: cannot be written ({error.strerror}); give --out another folder") from error
    print(f"{len(texts)} files in {out}")
