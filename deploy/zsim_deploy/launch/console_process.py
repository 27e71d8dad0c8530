"""The console as a process of its own: beside a replay that runs in this one, and after a run."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from zsim.errors import printable
from zsim_deploy import SAFE_PATH
from zsim_deploy.launch.supervisor import Outcome, RunProcess
from zsim_deploy.roles.stop_channel import interruptible

ZSIM = (sys.executable, SAFE_PATH, "-m", "zsim_deploy")
END_S = 10.0  # wall; how long it may take to end
COPIED_S = 22.0  # wall; how long one may take to end after a run: its pages may copy for 20 s
INTERRUPTED_S = 1.0  # wall; how long after Ctrl-C: the run itself may take 2 s, the whole is promised within 3 s
SLOW_S = 2.0  # wall; after which it is shown what is waited for


class RunConsole:
    """Owns the console of a run, which goes on until the report is there and pages have copies.

    To be entered before the run, so that the console never outlives it. Ctrl-C ends the wait for its pages.
    """

    def __init__(self) -> None:
        self.process: RunProcess | None = None
        self.outcome = Outcome("interrupted", interrupted=True)  # of the run, to be set

    def own(self, process: RunProcess) -> None:
        """Take a process that is not started yet; a former one ends."""
        if self.process is not None:
            self.process.close()
        self.process = process

    def __enter__(self) -> "RunConsole":
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        if self.process is None:
            return
        hurries = self.outcome.interrupted or isinstance(error, (KeyboardInterrupt, SystemExit))
        limit_s = INTERRUPTED_S if hurries else COPIED_S
        try:
            with interruptible():
                self.process.request_stop(self.outcome.reason)
                if not self.process.wait(min(SLOW_S, limit_s)) and limit_s > SLOW_S:
                    text = f"{self.process.name}: its pages may copy the report and the record; Ctrl-C ends that"
                    print(printable(text), file=sys.stderr)
                    self.process.wait(limit_s - SLOW_S)
        except KeyboardInterrupt:
            pass  # the run is over, and ended as it did
        finally:
            self.process.close()


@contextmanager
def console_beside(endpoint: str, record: Path, federation: str | None, tls: Path | None) -> Iterator[None]:
    """Run a console meanwhile, which waits for the world and prints its links.

    It reaches the world at its endpoint, on this machine where that is all addresses, in the name of a federation, by
    default that of the record.
    """
    if federation is None:
        from zsim_analysis.reading.recorded_run import open_run

        with open_run(record) as (_, _, scenario):
            federation = scenario.federation
    reach = ["--connect", endpoint.replace("0.0.0.0", "127.0.0.1"), "--federation", federation]
    process = subprocess.Popen([*ZSIM, "console", *reach, *(["--tls", str(tls)] if tls else [])])
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
