"""A user's program that is started with a run, and supervised like the run's own processes."""

import threading
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from zsim.scenario.scenario import Scenario
from zsim_api.programs import Program, environment_of, filled
from zsim_api.run_folder import Launch
from zsim_deploy.launch.supervisor import end_text, last_line

HERE = "here"  # host of a program that `zsim up` starts itself
LEAVES_S = 2.0  # wall time for a program to notice the end of the run before it is interrupted


class ProgramProcess:
    """A program, its output in the log of its name; see `RunProcess`.

    Args:
        folder: in which it runs; None: the current one.
    """

    is_program = True
    host = HERE

    def __init__(
        self, name: str, words: Sequence[str], logs: Path, environment: Mapping[str, str], folder: Path | None
    ) -> None:
        self.name = name
        self.role = name.partition(".")[0]
        self.restarts = 0
        self._words, self._environment, self._folder = words, environment, folder
        self._log = logs / f"{name}.log"
        self._program: Program | None = None
        self._asked: threading.Timer | None = None

    def start(self) -> None:
        if self._program is not None:
            self._program.close()
        self._program = Program(self._words, self._environment, self._log, self._folder)

    @property
    def state(self) -> str:
        return "ended" if self.code is not None else "running" if self._program else "starting"

    @property
    def pid(self) -> int:
        return self._program.pid if self._program else 0

    @property
    def code(self) -> int | None:
        """Return its exit code, None while it lives; negative for a signal."""
        code = self._program.code if self._program else None
        return code if code is None or code <= 128 else 128 - code

    def outcome(self) -> str:
        return end_text(self.code, self.last_log_line())

    def last_log_line(self) -> str:
        return last_line(self._log)

    def request_stop(self, reason: str) -> None:
        """Interrupt it, as Ctrl-C does, unless it ends by itself within LEAVES_S."""
        if self._program is not None and self._asked is None:
            self._asked = threading.Timer(LEAVES_S, self._program.interrupt)
            self._asked.daemon = True
            self._asked.start()

    def wait(self, timeout_s: float) -> bool:
        return self._program is None or self._program.wait(max(0.0, timeout_s)) is not None

    def kill(self) -> None:
        if self._program is not None:
            self._program.kill()

    def close(self) -> None:
        if self._asked is not None:
            self._asked.cancel()
        if self._program is not None:
            self._program.close()


def programs_of(
    scenario: Scenario, names: Iterable[str], endpoint: str, out: Path, launch: Launch
) -> list[ProgramProcess]:
    """Return some of the users' programs of a scenario; they run in the folder of its modules, beside its file.

    Args:
        endpoint: of the run.
        out: folder of the run.
    """
    folder, environment = next(map(Path, launch.modules), None), environment_of(endpoint, scenario.federation)
    values = {"endpoint": endpoint, "federation": scenario.federation, "folder": str(out.absolute())}
    return [
        ProgramProcess(
            name,
            filled(scenario.own_programs[name].command, {**values, "name": name}),
            out / "logs",
            environment,
            folder,
        )
        for name in names
    ]
