"""The console as a separate process: beside a replay in this process, and after a run."""

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
END_S = 10.0  # wall time for it to end
COPIED_S = 22.0  # wall time for it to end after a run: its pages may copy for 20 s
INTERRUPTED_S = 1.0  # wall time for it to end after Ctrl-C: the run may take 2 s, and in all 3 s are promised
SLOW_S = 2.0  # wall time after which a notice is shown


class RunConsole:
    """Owns the console of a run, which continues until the report is made and its pages have copied it.

    Must be entered before the run, so that the console always ends. Ctrl-C ends the wait for its pages.
    """

    def __init__(self) -> None:
        self.process: RunProcess | None = None
        self.outcome = Outcome("interrupted", interrupted=True)  # of the run; set by the caller

    def own(self, process: RunProcess) -> None:
        """Take a process that has not been started; end a former one."""
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
            pass  # the run is over already
        finally:
            self.process.close()


@contextmanager
def console_beside(endpoint: str, record: Path, federation: str | None, tls: Path | None) -> Iterator[None]:
    """Run a console for the duration of the block, which waits for the world and prints its links.

    It connects to the world's endpoint, on this machine if that is all addresses; the default federation is the
    record's.
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
