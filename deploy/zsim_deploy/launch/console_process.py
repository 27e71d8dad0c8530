"""The console as a process of its own: beside a replay that runs in this one, and after a run."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from zsim_deploy.launch.free_ports import page_port
from zsim_deploy.launch.supervisor import INTERRUPT_S, Outcome

END_S = 10.0  # wall; how long it may take to end
COPIED_S = 22.0  # wall; how long after a run, as its pages may copy for 20 s
SLOW_S = 2.0  # wall; after which it is shown what is waited for


@contextmanager
def console_beside(endpoint: str, record: Path, federation: str | None, tls: Path | None) -> Iterator[None]:
    """Run a console meanwhile, which waits for the world and prints its links.

    Args:
        endpoint: on which the world listens; where that is all addresses, it is reached on this machine.
        record: what is played.
        federation: in whose name; None for that of the record.
        tls: folder of a certificate, None without.

    Raises:
        RunError, RecordError: there is no record.
    """
    command = [sys.executable, "-m", "zsim_deploy", *_arguments(endpoint, federation or _federation_of(record), tls)]
    process = subprocess.Popen(command)
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _arguments(endpoint: str, federation: str, tls: Path | None) -> list[str]:
    where = ["--connect", endpoint.replace("0.0.0.0", "127.0.0.1"), "--federation", federation]
    return ["console", *where, "--port", str(page_port()), *(["--tls", str(tls)] if tls else [])]


def _federation_of(record: Path) -> str:
    from zsim_analysis.reading.recorded_run import open_run

    with open_run(record) as (_, _, scenario):
        return scenario.federation


@contextmanager
def ending_after(outcome: Outcome, say: Callable[[str], None]) -> Iterator[None]:
    """End what remains of a run after what is done meanwhile; a console may let its pages copy what is there then.

    Args:
        outcome: of the run.
        say: takes a line on what takes long.
    """
    patience_s = INTERRUPT_S if outcome.interrupted else COPIED_S
    try:
        yield
    except (KeyboardInterrupt, SystemExit):  # Ctrl-C
        patience_s = INTERRUPT_S
        raise
    finally:
        try:
            for child in outcome.remaining:
                child.request_stop(outcome.reason)
                if not child.wait(min(SLOW_S, patience_s)):
                    say(f"{child.name}: its pages copy the report and the record")
                    child.wait(patience_s - SLOW_S)
        finally:
            for child in outcome.remaining:
                child.close()
