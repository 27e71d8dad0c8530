"""The pytest plugin of zsim: the fixture `federation`, and reports of failed tests that show the awaited processes.

Every pytest run in an environment with zsim loads this module, so it imports nothing else of zsim before a test flies.
"""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from zsim_api.federation import Federation

FAILED_RUNS = "zsim_failed_runs"  # option of pytest's configuration


class Federations:
    """Starts the federations of one test, each with its own folder."""

    def __init__(self, folder: Path, kept: Path, modules: tuple[Path, ...]) -> None:
        self.made: list[Federation] = []
        self.failed = False
        self._folder, self._kept, self._modules = folder, kept, modules

    def __call__(self, scenario: Any, duration: float | None = None, **options: Any) -> "Federation":
        """Start a federation; arguments as in `zsim.Federation`."""
        from zsim_api.federation import Federation

        options = {"out": self._folder / f"run{len(self.made) + 1}", "modules": self._modules, **options}
        self.made.append(Federation(scenario, duration, **options))
        return self.made[-1]

    def kept(self, made: "Federation") -> Path:
        """Return the path to which a run's folder is copied if the test has failed."""
        return self._kept / made.folder.name

    def close(self) -> None:
        for each in self.made:
            each.close()
        if self.failed:
            shutil.rmtree(self._kept, ignore_errors=True)
            for each in self.made:
                shutil.copytree(each.folder, self.kept(each))


MADE = pytest.StashKey[Federations]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addini(FAILED_RUNS, "folder for records and logs of failed tests (zsim)", default="runs/failed")


@pytest.fixture
def federation(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Federations]:
    """Start flights as real processes, with programs of your own: `federation("step.yaml", duration=40)`.

    It takes the arguments of `zsim.Federation`, and returns one, with `wait_until`, `inject`, `kill`, `ask`, `run`,
    `assert_errors`, `assert_no_collision`, `assert_same_bits`. Each federation has its own free port and name, so tests
    can run in parallel (pytest-xdist). No process outlives the test. If the test fails, the report shows which
    processes were awaited, and the last lines of the logs, beginning with failed and awaited processes; records and
    logs are kept in `runs/failed` (`zsim_failed_runs`).
    """
    test = re.sub(r"[^\w.-]+", "-", request.node.nodeid.rpartition("/")[2]).strip("-")
    kept = request.config.rootpath / request.config.getini(FAILED_RUNS) / test
    made = request.node.stash[MADE] = Federations(tmp_path, kept, (request.path.parent,))
    try:
        yield made
    finally:
        made.close()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Any:
    """Add the diagnoses of the federations to the report of a failed test."""
    report: pytest.TestReport = yield
    started = item.stash.get(MADE, None)
    if started is not None and report.failed and report.when != "teardown":
        started.failed = True
        for each in started.made:
            title = f"federation {each.name}, kept in {started.kept(each)}"
            report.sections.append((title, each.diagnosis()))
    return report
