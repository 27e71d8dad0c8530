"""The `zsim` command: Ctrl-C ends it in a line from its first moment on, also while it loads what it needs."""

import gc
import os
import signal

from zsim_deploy import INTERRUPTED

GARBAGE_OBJECTS = 10_000  # made before cycles are searched for; at Python's 700 that is a tenth of the start


def main() -> None:
    """Load the command line, and run it."""
    gc.set_threshold(GARBAGE_OBJECTS)
    takes_interrupts = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not where a shell has it ignored
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
        gc.freeze()  # the end of the process frees it all; a last search for cycles would take 0.1 s


def _leave(*_: object) -> None:
    try:
        os.write(2, b"interrupted\n")
    finally:  # standard error may be closed
        os._exit(INTERRUPTED)  # nothing has been started or written yet


if __name__ == "__main__":
    main()
