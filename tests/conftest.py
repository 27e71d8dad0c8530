"""Distribution of tests among workers: the last of three or more is quiet; tests that share a run share a worker.

The quiet worker runs pure tests, and only in the time that is left over by the others, whose tests start processes and
wait for them. When the others have no such tests left, they run pure tests, too.
"""

import gc
import os
import signal
import sys
from typing import Any

import hypothesis
import pytest
from xdist.scheduler import LoadGroupScheduling

from zsim.math.compiled import Part
from zsim_deploy.roles.stop_channel import lower_priority

PURE = ("tests/authority/", "tests/contract/", "tests/unit/")
LEAST = 3  # number of workers from which on one is quiet

# By default an example fails after 200 ms, which the first one takes on a slow machine for its imports alone.
hypothesis.settings.register_profile("zsim", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow])
hypothesis.settings.load_profile("zsim")

# A shell makes background jobs ignore SIGINT, which every program that a test starts would inherit.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def quiet_one(workers: int) -> str | None:
    """Return the name of the quiet worker, or None if there are too few workers."""
    return f"gw{workers - 1}" if workers >= LEAST else None


class QuietScheduling(LoadGroupScheduling):
    """Distributes tests as `--dist loadgroup` does, but gives each worker its own kind first."""

    def _assign_work_unit(self, node: Any) -> None:
        is_quiet = node.gateway.id == quiet_one(self.numnodes)
        own = (scope for scope, tests in self.workqueue.items() if next(iter(tests)).startswith(PURE) == is_quiet)
        scope = next(own, None)
        if scope is not None:
            self.workqueue.move_to_end(scope, last=False)
        elif is_quiet:
            node.shutdown()
            return
        super()._assign_work_unit(node)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> QuietScheduling | None:
    return QuietScheduling(config, log) if config.getoption("dist") == "loadgroup" else None


@pytest.hookimpl(tryfirst=True)  # before xdist puts the groups into the names of tests
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give one worker all tests of a file that share a fixture of that file, such as a run."""
    for item in items:
        file = item.nodeid.partition("::")[0]
        fixtures = item._fixtureinfo.name2fixturedefs.values() if isinstance(item, pytest.Function) else ()
        if any(found[-1].baseid == file and found[-1].scope in ("module", "session") for found in fixtures):
            item.add_marker(pytest.mark.xdist_group(file))


def pytest_collection_finish() -> None:
    """Keep the present state for good: the modules that tests have imported, and the variables that these have set."""
    gc.collect()
    gc.freeze()  # otherwise each collection scans all tests, for a third of a second
    gc.unfreeze = lambda: None  # a run in this process would call it at its end
    commands: Any = sys.modules.get("forked_commands")
    if commands is not None:
        commands.FIRST = commands.inherited()


@pytest.fixture
def interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run kernel parts that a test calls as Python, to the same bits, because compiling one takes seconds."""
    monkeypatch.setattr(Part, "__call__", lambda part, *arguments: part.py_func(*arguments))


def pytest_configure(config: pytest.Config) -> None:
    os.environ.pop("COLUMNS", None)  # set by the terminal that starts the tests; no test depends on its width
    worker = getattr(config, "workerinput", None)
    if worker and sys.platform == "linux" and worker["workerid"] == quiet_one(worker["workercount"]):
        os.setsid()
        lower_priority()
