"""The command line: assembles the commands, runs them, and reports a user's mistake in one line."""

import errno
import importlib
import os
import sys
from functools import cache
from typing import Annotated, Any

import typer
from typer.main import get_command

from zsim import __version__, errors
from zsim.errors import (
    BehindError,
    RequestRefusedError,
    RunFailedError,
    SupersededError,
    UserCodeError,
    ZsimError,
    printable,
)
from zsim_deploy import INTERRUPTED, USER_FAULT
from zsim_deploy.arguments import HOSTS, POKE, TRANSLATE, endpoint_origin, note, say
from zsim_deploy.cli import federation_commands, hosts_commands, role_commands, run_commands
from zsim_deploy.roles.closed_output import STREAMS, is_unread

UsageError: Any = importlib.import_module(typer.BadParameter.__module__).UsageError  # from the click that typer uses
UNREAD = 128 + 13  # exit code of a command whose output is no longer read, as if killed by SIGPIPE
# errors caused by a path that the user gave, or by its disk, wherever the path is first accessed
FILE_FAULTS = {errno.ENAMETOOLONG, errno.EACCES, errno.EPERM, errno.ELOOP, errno.EROFS, errno.EIO, errno.ESTALE}
PATH_SHOWN = 200  # characters of a path in an error; a longer one is shortened in the middle
EXIT_CODES = {  # by class, for errors other than wrong input
    **dict.fromkeys((BehindError, RequestRefusedError, RunFailedError, UserCodeError), 1),
    SupersededError: 3,
}
ABOUT = "Co-simulate drone formations: one world, estimators and controllers as processes on Zenoh, in lockstep."

app = typer.Typer(
    name="zsim",
    help=ABOUT,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
for _family in (
    run_commands.app,
    role_commands.app,
    hosts_commands.app,
    federation_commands.app,
    role_commands.bridges,
):
    app.add_typer(_family)
for _panel, _group in (
    (POKE, federation_commands.faults),
    (TRANSLATE, role_commands.ardrone),
    (TRANSLATE, role_commands.mavlink),
    (HOSTS, hosts_commands.certs),
    (HOSTS, hosts_commands.rendering),
):
    app.add_typer(_group, rich_help_panel=_panel)


def _version(wanted: bool) -> None:
    if wanted:
        say(f"zsim {__version__}")
        raise typer.Exit


@app.callback(help=ABOUT)
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None: ...


@cache
def command() -> Any:
    """Return the command line, built once, so that a forked process inherits it."""
    return get_command(app)


def main() -> None:
    """Run the command line, and exit with its code; a user's mistake is reported in one line, without a traceback."""
    try:
        code = _run()
    except BrokenPipeError:
        if not any(map(is_unread, STREAMS)):
            raise  # the broken pipe was a connection, not an output stream
        code = UNREAD
    except SystemExit as ended:  # click exits with 1 when its output is not read
        code = UNREAD if isinstance(ended.__context__, BrokenPipeError) else ended.code
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        code = code or UNREAD
        null = os.open(os.devnull, os.O_WRONLY)  # takes the output that is no longer read, as with `| head`
        for stream in filter(is_unread, STREAMS):
            os.dup2(null, stream)
    sys.exit(code)


def _run() -> int | str | None:
    try:
        code = command()(standalone_mode=False, prog_name="zsim")
    except ZsimError as error:
        note(endpoint_origin(str(error), sys.argv, os.environ))
        return EXIT_CODES.get(type(error), USER_FAULT)
    except UsageError as error:
        _show_usage(error)
        return USER_FAULT
    except ModuleNotFoundError as error:
        if (lacking := errors.missing(error)) is None:
            raise
        note(f"{' '.join(sys.argv[1:2])}: {lacking}")
        return USER_FAULT
    except OSError as error:
        if isinstance(error, FileNotFoundError) and not _is_in_a_folder():
            note("the current folder has been removed; change to another one")
            return USER_FAULT
        if error.errno not in FILE_FAULTS or error.filename is None:
            raise
        path = os.fsdecode(error.filename)
        path_text = path if len(path) <= PATH_SHOWN else f"{path[: PATH_SHOWN // 2]}…{path[-PATH_SHOWN // 2 :]}"
        note(f"{path_text}: cannot be used ({error.strerror}); give another path")
        return USER_FAULT
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    if code == INTERRUPTED:
        note("interrupted")
    return code


def _is_in_a_folder() -> bool:
    try:
        return bool(os.getcwd())
    except FileNotFoundError:
        return False


def _show_usage(error: Any) -> None:
    """Print a usage error in one line; nothing after a bare `zsim`, which has printed the help."""
    if isinstance(error, typer.BadParameter) and error.param is None:
        text = error.message
    else:
        text = " ".join(error.format_message().split()).replace("Value error, ", "")  # pydantic's, in newer typer
    command = error.ctx.command_path if error.ctx else "zsim"
    if text:
        line = f"{command}: {text[0].lower()}{text[1:].rstrip('.')}; see `{command} --help`"
        print(printable(line), file=sys.stderr)


if __name__ == "__main__":
    main()
