"""Wheels from a package index, by pip as the user has configured it on the launcher's machine."""

import asyncio
import os
import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from zsim_deploy.push.target import Target

RETRIES = "1"  # of pip, for each page of an index; with its own 5 it takes minutes where there is no network
LINE_BYTES = 1 << 20  # of the longest line that pip says
NO_INDEX = re.compile(r"connection broken by '\w+\((.*)\)': ")  # what pip says before it tries again, with the reason

Told = Callable[[str], None]


class PipError(Exception):
    """What pip says is wrong."""


class UnreachableError(PipError):
    """The package index does not answer."""


def _hush(_text: str) -> None:
    """Hear what is being done, and tell nobody."""


async def gather(wanted: Sequence[str], target: Target, into: Path, held: Sequence[str], told: Told = _hush) -> bool:
    """Download wheels for a target; where a project has only sources, build them here.

    The versions are those of this machine where there are such wheels for the target, because equal versions are a
    condition for equal bits.

    Args:
        wanted: requirements, as for pip.
        into: folder, for the wheels only.
        held: constraints, as for pip.
        told: called with what is being done.

    Returns:
        Whether the versions had to differ from the held ones.

    Raises:
        PipError: there are no wheels for the target.
        UnreachableError: nobody knows whether there are.
    """
    fit = ("download", "--only-binary=:all:", *target.options(), "--dest", str(into))
    with tempfile.TemporaryDirectory() as aside:
        limits = Path(aside, "constraints.txt")
        limits.write_text("\n".join(held))
        try:
            await _fetch(fit, (*wanted, "--constraint", str(limits)), f"{aside}/same", told)
            return False
        except UnreachableError:
            raise
        except PipError:
            told("looking for other versions than those here")
            await _fetch(fit, wanted, f"{aside}/other", told)
            return True


async def _fetch(fit: Sequence[str], wanted: Sequence[str], built: str, told: Told) -> None:
    """Download wheels; if that fails, build what has only sources into a folder, and take it from there."""
    try:
        await pip(*fit, *wanted, told=told)
    except UnreachableError:
        raise
    except PipError:
        told("building here what has only sources")
        await pip("wheel", "--wheel-dir", built, *wanted, told=told)
        await pip(*fit, "--find-links", built, *wanted, told=told)


async def pip(*arguments: str, told: Told = _hush) -> None:
    """Run pip of this Python, as the user has configured it but for how often it tries again.

    Args:
        told: hears when an index does not answer.

    Raises:
        PipError: with its last word.
        UnreachableError: with the reason why an index did not answer.
    """
    options = ("--disable-pip-version-check", "--no-input", "-q")
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "pip", *arguments, *options, stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT, limit=LINE_BYTES,
        env={**os.environ, "PIP_RETRIES": RETRIES},
    )  # fmt: skip
    assert process.stdout is not None
    lines: list[str] = []
    unanswered = ""
    try:
        async for line in process.stdout:
            lines.append(line.decode(errors="replace").strip())
            if (found := NO_INDEX.search(lines[-1])) and not unanswered:
                unanswered = _reason(found[1])
                told(f"the package index does not answer ({unanswered}); asking once more")
        await process.wait()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode and unanswered:
        raise UnreachableError(unanswered)
    if process.returncode:
        lines = [line for line in lines if line] or ["it says nothing"]
        raise PipError(next((line for line in lines if line.startswith("ERROR: ")), lines[-1]).removeprefix("ERROR: "))


def _reason(error: str) -> str:
    """Return what the arguments of an error that pip shows say, without what surrounds it."""
    last = re.split(r"[:,] ", error)[-1].strip("\"')")
    return re.sub(r"\[Errno -?\d+\] ", "", last) + (")" if "(" in last else "")
