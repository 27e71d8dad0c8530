"""pip of this Python, which gathers wheels for other ones: from a folder where they are kept, else from an index."""

import asyncio
import os
import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from zsim_deploy import SAFE_PATH
from zsim_deploy.push.installer import WheelTarget

RETRIES = "1"  # of pip, for each page of an index; with its own 5 it takes minutes where there is no network
LINE_BYTES = 1 << 20  # of the longest line that pip prints
NO_INDEX = re.compile(r"connection broken by '\w+\((.*)\)': ")  # pip, before it tries again, with the reason

Progress = Callable[[str], None]


class PipError(Exception):
    """pip failed; with its error line."""


class UnreachableError(Exception):
    """The package index does not answer."""


async def download_wheels(
    wanted: Sequence[str], target: WheelTarget, into: Path, held: Sequence[str], kept: Path, progress: Progress
) -> bool:
    """Collect wheels for a target; where a project has only sources, build them here.

    The versions are those of this machine where there are such wheels for the target, because equal versions are a
    condition for equal bits. No index is asked where all of them are kept already.

    Args:
        wanted: requirements, as for pip.
        into: folder, for the wheels only.
        held: constraints, as for pip.
        kept: folder with wheels of before.
        progress: called with what is being done.

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
        same = (*wanted, "--constraint", str(limits))
        if await is_kept(kept, (*fit, *same), progress):
            return False
        try:
            await _fetch(fit, same, f"{aside}/same", progress)
            return False
        except PipError:
            progress("looking for other versions than those here")
            await _fetch(fit, wanted, f"{aside}/other", progress)
            return True


async def is_kept(kept: Path, arguments: Sequence[str], progress: Progress) -> bool:
    """Run pip with the wheels of a folder alone, and no index; return whether they were enough."""
    if not any(kept.glob("*.whl")):
        return False
    try:
        await pip(*arguments, "--no-index", "--find-links", str(kept), progress=progress)
    except PipError:
        return False
    return True


async def _fetch(fit: Sequence[str], wanted: Sequence[str], built: str, progress: Progress) -> None:
    """Download wheels; if that fails, build what has only sources into a folder, and take it from there."""
    try:
        await pip(*fit, *wanted, progress=progress)
    except PipError:
        progress("building here what has only sources")
        await pip("wheel", "--wheel-dir", built, *wanted, progress=progress)
        await pip(*fit, "--find-links", built, *wanted, progress=progress)


async def pip(*arguments: str, progress: Progress) -> None:
    """Run pip of this Python, as the user has configured it but for how often it tries again.

    Args:
        progress: takes a line when an index does not answer.

    Raises:
        PipError: with its last line.
        UnreachableError: with the reason why an index did not answer.
    """
    options = ("--disable-pip-version-check", "--no-input", "-q")
    process = await asyncio.create_subprocess_exec(
        sys.executable, SAFE_PATH, "-m", "pip", *arguments, *options, stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT, limit=LINE_BYTES,
        env={**os.environ, "PIP_RETRIES": RETRIES},
    )  # fmt: skip
    assert process.stdout is not None
    lines: list[str] = []
    unanswered = ""
    try:
        async for line in process.stdout:
            lines.append(line.decode(errors="replace").strip())
            if (match := NO_INDEX.search(lines[-1])) and not unanswered:
                unanswered = _reason(match[1])
                progress(f"the package index does not answer ({unanswered}); asking once more")
        await process.wait()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode and unanswered:
        raise UnreachableError(unanswered)
    if process.returncode:
        lines = [line for line in lines if line] or ["it printed nothing"]
        raise PipError(next((line for line in lines if line.startswith("ERROR: ")), lines[-1]).removeprefix("ERROR: "))


def _reason(error: str) -> str:
    """Return what the arguments of an error that pip shows say, without what surrounds it."""
    last = re.split(r"[:,] ", error)[-1].strip("\"')")
    return re.sub(r"\[Errno -?\d+\] ", "", last) + (")" if "(" in last else "")
