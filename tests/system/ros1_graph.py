"""A private ROS 1 graph: Debian's unmodified roscore and command-line tools, and rospy nodes."""

import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from xmlrpc.client import ServerProxy

import pytest
from federation import free_port
from wire import PATIENCE_S

TOOLS = ("roscore", "rosmaster", "rosparam", "rostopic", "rosnode", "rosservice")
MODULES = ("rospy", "std_msgs", "std_srvs", "geometry_msgs", "sensor_msgs", "nav_msgs", "rosgraph_msgs", "genpy")
POLL_S = 0.05  # between two attempts to reach a starting master
PYTHON = "/usr/bin/python3"  # the interpreter that Debian's packages are built for
RELAY = "/usr/lib/topic_tools/relay"
GENERATOR = Path("/usr/lib/genpy/genmsg_py.py")
HEADER = "uint32 seq\ntime stamp\nstring frame_id\n"  # std_msgs/Header


def missing() -> str:
    """Return a text that names the missing parts of ROS 1; empty if there are none."""
    tools = [tool for tool in (*TOOLS, RELAY, str(GENERATOR)) if shutil.which(tool) is None]
    if tools:
        return f"ROS 1 is not installed: no {', '.join(tools)}"
    found = subprocess.run([PYTHON, "-c", f"import {', '.join(MODULES)}"], capture_output=True, text=True)
    return "" if found.returncode == 0 else f"ROS 1 is not whole: {found.stderr.strip().splitlines()[-1]}"


class Tool:
    """A started program, whose output is read continuously."""

    def __init__(self, command: list[str], env: dict[str, str]) -> None:
        self.command = " ".join(command)
        self.lines: list[str] = []
        self._news = threading.Condition()
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=env,
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._news:
                self.lines.append(line.rstrip("\n"))
                self._news.notify_all()

    def until(self, wanted: Callable[[str], object], within_s: float = PATIENCE_S) -> str:
        """Return the next wanted line; fail if none arrives in time."""
        until_s = time.monotonic() + within_s
        with self._news:
            seen = len(self.lines)
            while (left_s := until_s - time.monotonic()) > 0:
                for line in self.lines[seen:]:
                    if wanted(line):
                        return line
                seen = len(self.lines)
                self._news.wait(left_s)
        last = "\n".join(self.lines[-6:])
        return pytest.fail(f"{self.command}: no such line within {within_s:g} s; the last ones were\n{last}")

    def end(self, number: int = signal.SIGINT) -> None:
        """End the program and its children."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, number)
            try:
                self.process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, signal.SIGKILL)
                self.process.wait()
        self._reader.join(PATIENCE_S)
        assert self.process.stdout is not None
        self.process.stdout.close()


class RosGraph:
    """A master on a free port, and the programs that use it."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self._packages = folder / "packages"
        self._tools: list[Tool] = []
        self._master: Tool | None = None
        wanted = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "PYTHON", "VIRTUAL"))}
        self.env = wanted | {
            "ROS_MASTER_URI": self.uri,
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_HOME": str(folder / "ros"),
            "ROS_LOG_DIR": str(folder / "log"),
            "PYTHONPATH": str(self._packages),
            "PYTHONUNBUFFERED": "1",
            "PYTHONDONTWRITEBYTECODE": "1",
        }

    def start_master(self, *master: str) -> None:
        """Start roscore or another master, wait until it answers, and have nodes use simulated time."""
        self._master = self.start(*(master or ("roscore",)), "-p", str(self.port))
        until_s = time.monotonic() + PATIENCE_S
        while not self._set_simulated_time():
            assert time.monotonic() < until_s, self._master.lines
            threading.Event().wait(POLL_S)

    def _set_simulated_time(self) -> bool:
        """Act as `rosparam set /use_sim_time true`; return whether the master answers."""
        try:
            with ServerProxy(self.uri) as master:
                master.setParam("/tests", "/use_sim_time", True)
        except OSError:
            return False
        return True

    def stop_master(self) -> None:
        """Kill the master; not for roscore, which must end its own child processes."""
        assert self._master is not None
        self._master.end(signal.SIGKILL)

    def start(self, *command: str, **env: str) -> Tool:
        """Start a program in this graph."""
        tool = Tool(list(command), self.env | env)
        self._tools.append(tool)
        return tool

    def run(self, *command: str) -> str:
        """Run a program, which must succeed, and return its output."""
        done = self._call(*command)
        assert done.returncode == 0, f"{' '.join(command)}:\n{done.stdout}{done.stderr}"
        return done.stdout

    def refused(self, *command: str) -> str:
        """Run a program, which must fail, and return its output."""
        done = self._call(*command)
        assert done.returncode != 0, f"{' '.join(command)}:\n{done.stdout}"
        return done.stdout + done.stderr

    def watch(self, topic: str) -> Tool:
        """Start `rostopic echo -p`, which prints each message as a line of numbers, its time first."""
        return self.start("rostopic", "echo", "-p", topic)

    @contextmanager
    def published(self, topic: str, *message: str) -> Iterator[None]:
        """Publish a message, latched, while the block runs: `rostopic pub -1` leaves after 3 s, connected or not."""
        tool = self.start("rostopic", "pub", topic, *message)
        yield
        tool.end()

    def generate(self, package: str, name: str, definition: str) -> None:
        """Generate a message type for the tools with ROS's own generator, as a build of its package would."""
        source, headers, out = (self._packages / part for part in ("source", "std", f"{package}/msg"))
        for folder in (source, headers, out):
            folder.mkdir(parents=True)
        (source / f"{name}.msg").write_text(definition)
        (headers / "Header.msg").write_text(HEADER)
        (out.parent / "__init__.py").write_text("")
        found = [f"-I{package}:{source}", f"-Istd_msgs:{headers}"]
        self.run(PYTHON, str(GENERATOR), "-p", package, *found, "-o", str(out), str(source / f"{name}.msg"))
        self.run(PYTHON, str(GENERATOR), "--initpy", "-p", package, "-o", str(out))

    def close(self) -> None:
        """End the remaining programs, the master last."""
        for tool in reversed(self._tools):
            tool.end()

    def _call(self, *command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(command, env=self.env, capture_output=True, text=True, timeout=PATIENCE_S)


def numbers(line: str) -> list[float]:
    """Return the numbers of a line of `rostopic echo -p`, its time [s] first; none for the header or a warning."""
    first, *others = line.split(",")
    return [int(first) * 1e-9, *map(float, others)] if first.isdigit() else []
