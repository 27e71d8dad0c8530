"""A worker of a sweep: a process that flies one run after the other, so that imports and kernels are paid once."""

import os
import signal
import threading
import warnings
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait

READY = "ready"


def work(link: Connection) -> None:
    """Fly the tasks that come on a link and send back their rows; `None` ends it, as the launcher's death does.

    An exception that is sent back stands for something that no further run would survive.
    """
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches every process of the terminal; the launcher answers it
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_die_with_launcher, name="leash", daemon=True).start()
    warnings.simplefilter("ignore", RuntimeWarning)  # a state that overflows is told in the run's row
    from zsim_analysis.sweep.fly.sweep_run import fly

    link.send(READY)
    try:
        while (task := link.recv()) is not None:
            try:
                answer = fly(task)
            except Exception as error:
                answer = RuntimeError(str(error))
            link.send(answer)
    except (EOFError, BrokenPipeError):
        return


def _die_with_launcher() -> None:
    launcher = parent_process()
    if launcher is not None:
        wait([launcher.sentinel])
        os._exit(1)
