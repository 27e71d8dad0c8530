"""The console as a process of its own, beside a replay that runs in this one."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from zsim_deploy.launch.run import page_port

END_S = 10.0  # wall; how long it may take to end


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
