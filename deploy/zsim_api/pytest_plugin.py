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

    def __init__(self, folder: Path, failed_folder: Path, modules: tuple[Path, ...]) -> None:
        self.started: list[Federation] = []
        self.failed = False
        self._folder, self._failed_folder, self._modules = folder, failed_folder, modules

    def __call__(self, scenario: Any, duration: float | None = None, **options: Any) -> "Federation":
        """Start a federation; arguments as in `zsim.Federation`."""
        from zsim_api.federation import Federation

        options = {"out": self._folder / f"run{len(self.started) + 1}", "modules": self._modules, **options}
        self.started.append(Federation(scenario, duration, **options))
        return self.started[-1]

    def kept_path(self, run: "Federation") -> Path:
        """Return the path to which a run's folder is copied if the test has failed."""
        return self._failed_folder / run.folder.name

    def close(self) -> None:
        for each in self.started:
            each.close()
        if self.failed:
            shutil.rmtree(self._failed_folder, ignore_errors=True)
            for each in self.started:
                shutil.copytree(each.folder, self.kept_path(each))


FEDERATIONS = pytest.StashKey[Federations]()


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
    failed_folder = request.config.rootpath / request.config.getini(FAILED_RUNS) / test
    federations = request.node.stash[FEDERATIONS] = Federations(tmp_path, failed_folder, (request.path.parent,))
    try:
        yield federations
    finally:
        federations.close()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Any:
    """Add the diagnoses of the federations to the report of a failed test."""
    report: pytest.TestReport = yield
    federations = item.stash.get(FEDERATIONS, None)
    if federations is not None and report.failed and report.when != "teardown":
        federations.failed = True
        for each in federations.started:
            title = f"federation {each.name}, kept in {federations.kept_path(each)}"
            report.sections.append((title, each.diagnosis()))
    return report
