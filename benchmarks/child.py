"""Child processes of the benchmarks, which print one result and exit, or keep answering questions.

Each has its own process group, so that its own children are killed with it, however it ends.
"""

import contextlib
import json
import os
import selectors
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from typing import Any

from benchmarks.peers import ROOT


class RefusedError(Exception):
    """A contender could not be measured; the text says why."""


def result(command: Sequence[str], timeout_s: float) -> dict[str, Any]:
    """Run a command in the project's folder and return the last line of JSON that it prints.

    Raises:
        RefusedError: the command failed, printed no line of JSON, or did not end in time.
    """
    with tempfile.TemporaryFile("w+") as errors:
        process = _started(command, errors, stdin=subprocess.DEVNULL)
        try:
            printed, _ = process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            raise RefusedError(f"not finished after {timeout_s:g} s") from None
        finally:
            _end(process)
        lines = [text for text in printed.splitlines() if text.startswith("{")]
        if process.returncode or not lines:
            raise RefusedError(_last_words(errors, process.returncode))
        return json.loads(lines[-1])


class Server:
    """A contender that keeps running and answers each line of JSON with another."""

    def __init__(self, command: Sequence[str]) -> None:
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 - stays open as long as the process runs
        self._process = _started(command, self._errors, stdin=subprocess.PIPE)

    @property
    def pid(self) -> int:
        return self._process.pid

    def ask(self, question: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        """Return the answer to a question; raise a RefusedError if the process refuses, has ended, or is too slow."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(question) + "\n")
            self._process.stdin.flush()
        with selectors.DefaultSelector() as waiting:
            waiting.register(self._process.stdout, selectors.EVENT_READ)
            if not waiting.select(timeout_s):
                raise RefusedError(f"no answer within {timeout_s:g} s")
        text = self._process.stdout.readline()
        if not text:
            raise RefusedError(_last_words(self._errors, self._process.wait()))
        answer = json.loads(text)
        if "refused" in answer:
            raise RefusedError(answer["refused"])
        return answer

    def close(self) -> None:
        _end(self._process)
        self._errors.close()


def _started(command: Sequence[str], errors: Any, stdin: int) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command, stdin=stdin, stdout=subprocess.PIPE, stderr=errors, text=True, cwd=ROOT, start_new_session=True
    )


def _end(process: subprocess.Popen[str]) -> None:
    """Kill what remains of a process group."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(BrokenPipeError):
                pipe.close()


def _last_words(errors: Any, code: int | None) -> str:
    errors.seek(0)
    lines = [text.strip() for text in errors.read().splitlines() if text.strip()]
    return f"exit code {code}: {lines[-1] if lines else 'no error output'}"[:200]
