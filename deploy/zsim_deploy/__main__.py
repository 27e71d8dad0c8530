"""The `zsim` command; Ctrl-C ends it with a one-line message, even while it is loading modules."""

import gc
import os
import signal

from zsim_deploy import INTERRUPTED

GARBAGE_OBJECTS = 10_000  # threshold of the garbage collector; Python's 700 would cost a tenth of the start-up time


def main() -> None:
    """Load and run the command line."""
    gc.set_threshold(GARBAGE_OBJECTS)
    takes_interrupts = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # else inherited as ignored
    if takes_interrupts:
        signal.signal(signal.SIGINT, _leave)
    from zsim_deploy.roles.closed_output import renew_streams

    renew_streams()
    from zsim_deploy.cli import cli

    if takes_interrupts:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        cli.main()
    finally:
        gc.freeze()  # the process is ending; a last collection would take 0.1 s


def _leave(*_: object) -> None:
    try:
        os.write(2, b"interrupted\n")
    finally:  # standard error may be closed
        os._exit(INTERRUPTED)  # nothing has been started or written yet


if __name__ == "__main__":
    main()
