"""Extras of this distribution: how what a command lacks is installed."""

from collections.abc import Iterable


def install_command(extras: Iterable[str]) -> str:
    """Return what to type for some extras of pyproject.toml: no index has zsim, a checkout of it has."""
    return f"pip install '.[{','.join(sorted(set(extras)))}]' in the checkout of zsim"
