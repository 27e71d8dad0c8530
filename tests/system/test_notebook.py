"""Runs in a notebook: classes defined in cells, one line of progress, tracebacks and interrupts."""

import queue
import re
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest
from federation import PAIR
from wire import PATIENCE_S

jupyter_client = pytest.importorskip("jupyter_client", reason="jupyter_client is not installed")
pytest.importorskip("ipykernel", reason="ipykernel is not installed")


class Notebook:
    """A kernel that runs cells one at a time."""

    def __init__(self, folder: Path) -> None:
        self.manager = jupyter_client.KernelManager(kernel_name="python3")
        self.manager.start_kernel(cwd=str(folder))
        self.client = self.manager.blocking_client()
        self.client.start_channels()
        self.client.wait_for_ready(timeout=PATIENCE_S)

    def messages(self, code: str) -> Iterator[dict[str, Any]]:
        """Run a cell; yield the kernel's messages until the cell has finished."""
        asked = self.client.execute(dedent(code), stop_on_error=False)  # or an error would abort later cells
        while True:
            try:
                said = self.client.get_iopub_msg(timeout=PATIENCE_S)
            except queue.Empty:
                pytest.fail(f"the kernel says nothing: {code}")
            if said["parent_header"].get("msg_id") != asked:
                continue
            if said["msg_type"] == "status" and said["content"]["execution_state"] == "idle":
                return
            yield said

    def run(self, code: str) -> str:
        """Run a cell and return what it prints; fail if it raises."""
        text = ""
        for said in self.messages(code):
            if said["msg_type"] == "error":
                pytest.fail("\n".join(said["content"]["traceback"]))
            if said["msg_type"] == "stream":
                text += said["content"]["text"]
        return text

    def close(self) -> None:
        self.client.stop_channels()
        self.manager.shutdown_kernel(now=True)


@pytest.fixture(scope="module")
def notebook(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Iterator[Notebook]:
    """A kernel shared by all tests, each of which runs the cells that it needs and uses its own folders."""
    folder = tmp_path_factory.mktemp("notebook")
    (folder / "pair.yaml").write_text(PAIR)
    made = Notebook(folder)
    made.run("import warnings; warnings.simplefilter('ignore')\nimport zsim")
    yield made
    made.close()


CELL = """
class Lander(zsim.Agent):
    reads = ("drone/*/sensor/status",)
    def receive(self, key, message):
        pass
    def step(self, t_ns):
        if t_ns == 6_000_000_000 and FAILS:
            undefined_name
        return []
FAILS = False
"""


def test_an_agent_class_of_a_cell_flies_in_the_kernel_and_as_processes(notebook: Notebook) -> None:
    notebook.run(CELL)
    said = [*notebook.messages("run = zsim.run('pair.yaml', agents=[Lander], out='here')\nrun")]
    shown = [each["content"]["data"] for each in said if "data" in each["content"]]
    assert "<table>" in shown[-1]["text/html"]
    assert sum(each["msg_type"] == "display_data" for each in said) == 1
    assert not [each for each in said if each["msg_type"] == "error"]
    assert " 12.0 / 12 s " in shown[-2]["text/plain"]  # the last state of the line
    said = [*notebook.messages("many = zsim.run('pair.yaml', agents=[Lander], out='many', processes=True)")]
    assert not [each for each in said if each["msg_type"] == "error"]
    printed = "".join(each["content"]["text"] for each in said if each["msg_type"] == "stream")
    assert "2 drones" in printed
    assert "\x1b" not in printed
    assert sum(each["msg_type"] == "display_data" for each in said) == 1
    line = [each["content"]["data"]["text/plain"] for each in said if "data" in each["content"]][-1]
    assert " 12.0 / 12 s " in line
    notebook.run("from pathlib import Path; from zsim_api.programs import Program")
    notebook.run("Program(['sh', '-c', 'echo ${FORCE_COLOR-none}'], output=Path('colours.log')).wait()")
    assert notebook.run("print(Path('colours.log').read_text(), end='')") == "none\n"
    assert notebook.run("print(many.truth_sha256 == run.truth_sha256)") == "True\n"


def test_an_error_in_an_agent_of_a_cell_is_shown_with_its_line(notebook: Notebook) -> None:
    notebook.run(CELL.replace("FAILS = False", "FAILS = True"))
    said = [*notebook.messages("zsim.run('pair.yaml', agents=[Lander], out='wrong', progress=False)")]
    before, error = said[-2:]
    assert "agent.lander at 6.00 s" in before["content"]["text"]
    assert error["content"]["ename"] == "NameError"
    assert "undefined_name" in "".join(error["content"]["traceback"])
    assert notebook.run("print(zsim.load('wrong').duration_s >= 6)") == "True\n"


def test_a_traceback_shows_only_the_users_own_lines(notebook: Notebook) -> None:
    mistaken = """
        def flown():
            return zsim.Scenario.load('pair.yaml').with_(seed=-1).resolved

        flown()
    """
    for code, line in ((mistaken, "seed"), ("zsim.sweep('none.yaml')", "none.yaml"), ("zsim.load('none')", "none")):
        (error,) = [said["content"] for said in notebook.messages(code) if said["msg_type"] == "error"]
        frames = re.sub(r"\x1b\[[\d;]*m", "", "\n".join(error["traceback"]))
        assert re.findall(r"^(?:Cell|File) .*$", frames, re.MULTILINE)[0].startswith("Cell In[")
        assert ".py" not in frames
        assert line in frames.splitlines()[-1]
        assert frames.count("----> ") == (2 if code == mistaken else 1)


@pytest.mark.parametrize("processes", [False, pytest.param(True, marks=pytest.mark.soak)])
def test_an_interrupt_ends_a_flight_with_a_complete_record(notebook: Notebook, processes: bool) -> None:
    names, out, shown = [], f"interrupted-{processes}", 0
    for said in notebook.messages(f"zsim.run('pair.yaml', duration_s=1e5, out={out!r}, processes={processes})"):
        shown += said["msg_type"] == "update_display_data"
        if shown == 1:  # only once: a second interrupt would not wait for the record
            notebook.manager.interrupt_kernel()
            shown += 1
        if said["msg_type"] == "error":
            names.append(said["content"]["ename"])
    assert names == ["KeyboardInterrupt"]
    assert notebook.run(f"print(zsim.load({out!r}).summary.record.complete)") == "True\n"
