"""Roles that tests start by hand, forked from one process that has everything imported, as `zsim run` forks its own.

It saves a second of processor time for each. What a test has changed of its own process, a role would have inherited:
then it is started as a user would, and so are all other commands.
"""

import atexit
import os
import resource
from functools import cache
from typing import IO, Any

from zsim.schema.plugin import FOLDERS
from zsim_deploy.launch.role_launcher import RoleLauncher, RoleProcess

ROLES = ("world", "estimator", "controller", "record", "gateway", "console")
LIMITS = (resource.RLIMIT_NOFILE, resource.RLIMIT_FSIZE, resource.RLIMIT_AS)


def start(arguments: list[str], root: str, environment: dict[str, str]) -> tuple[RoleProcess, IO[str]] | None:
    """Start a role in a folder; return it and what it prints, None where it has to be started cold."""
    if arguments[0] not in ROLES or _inherited() != FIRST or os.getcwd() != root:
        return None
    read, write = os.pipe()
    with os.fdopen(write, "w") as log:
        process = _launcher(tuple(environment.items())).start(arguments, log, listened=False)
    assert process.stdin is not None
    process.stdin.close()
    return process, os.fdopen(read)


def _inherited() -> Any:
    """Return what a process hands on to those that it starts."""
    variables = {name: value for name, value in os.environ.items() if name not in ("PYTEST_CURRENT_TEST", FOLDERS)}
    return variables, [resource.getrlimit(limit) for limit in LIMITS], os.sched_getaffinity(0)


FIRST = _inherited()


@cache
def _launcher(environment: tuple[tuple[str, str], ...]) -> RoleLauncher:
    former = dict(os.environ)
    os.environ.update(environment)
    try:
        made = RoleLauncher(print, "of tests").__enter__()
    finally:
        os.environ.clear()
        os.environ.update(former)
    atexit.register(made.__exit__, None, None, None)
    return made
