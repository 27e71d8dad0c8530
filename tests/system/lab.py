"""Hosts on one machine: network namespaces joined by a bridge, each with an address and an sshd of its own.

    def test_...(lab):
        hosts = lab.inventory({"world": "h1", "estimator.*": ["h1", "h2"], "controller.main": "h3"})
        up = lab.popen("launcher", *ZSIM, "up", SCENARIO, "--hosts", str(hosts))
        lab.cut("h2")                        h2 is cut off from the others until
        lab.heal("h2")
        lab.slow("h3", 50, 10, 0.02)         50 ± 10 ms and 2 % loss each way
        assert not lab.processes("h1")       no zsim process runs there

The hosts share the disk, the hostname, the clock and the user. Each has its own network and sshd, and over ssh an empty
home, so that the tester's ~/.bashrc has no effect. Closing the lab leaves nothing behind: it kills every process in its
namespaces, including those started over ssh.
"""

import itertools
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import namespaces
import pytest
import sshd
import yaml
from namespaces import checked, environment, members
from service import Service

ROOT = Path(__file__).parents[2]
PREFIX = "zlab"
LAUNCHER = "launcher"
NETWORK = "192.0.2."  # TEST-NET-1, RFC 5737
TOOLS = {"ip": "iproute2", "nft": "nftables", "sshd": "openssh-server", "ethtool": "ethtool"}
OFFLOADS = ("tx", "tso", "gso", "gro")
CUTS = """
table bridge lab {
  set cut { type ifname; }
  chain forward {
    type filter hook forward priority 0; policy accept;
    iifname @cut drop
    oifname @cut drop
  }
}
"""
RUN_S = 120.0  # wall time that a command on a host may take
_counter = itertools.count()


class Lab:
    """Hosts, and a launcher without sshd, on a network of their own.

    Args:
        folder: folder for keys, logs and each host's files.
        names: names of the hosts, at most 11 characters each.
    """

    def __init__(self, folder: Path, names: Sequence[str] = ("h1", "h2", "h3")) -> None:
        namespaces.sweep(PREFIX)
        self.folder, self.names = folder, tuple(names)
        self._prefix = f"{PREFIX}-{os.getpid()}-{next(_counter)}"
        self._addresses = {LAUNCHER: f"{NETWORK}1"} | {name: f"{NETWORK}{11 + i}" for i, name in enumerate(names)}
        self._variables: dict[str, dict[str, str]] = {}
        self._sshd: dict[str, Service] = {}
        self._emulators: dict[str, Service] = {}
        self._past: list[Service] = []
        try:
            self._connect()
            self._make_keys()
            for name in self.names:
                self._start_sshd(name)
        except BaseException:
            self.close()
            raise

    def address(self, name: str) -> str:
        return self._addresses[name]

    def host_folder(self, name: str) -> Path:
        """Return the folder in which zsim keeps its files on a host."""
        return self.folder / name / "zsim"

    def inventory(
        self,
        roles: Mapping[str, str | list[str]],
        routers: Mapping[str, Mapping[str, Any]] | None = None,
        through: Mapping[str, str] | None = None,
        insecure: bool = False,
        python: str | None = sys.executable,
    ) -> Path:
        """Write an inventory of all hosts and return its path.

        Args:
            roles: host or hosts by process name or pattern.
            routers: host, port and upstream by name.
            through: router through which a host reaches the world, by host.
            insecure: whether to go without TLS.
            python: interpreter that has zsim; None for the one that `zsim push` installs.
        """
        hosts = {name: self._host(name, (through or {}).get(name), python) for name in self.names}
        document: dict[str, Any] = {"hosts": hosts, "roles": dict(roles)}
        if routers:
            document["routers"] = {name: dict(router) for name, router in routers.items()}
        if insecure:
            document["security"] = {"insecure": True}
        path = self.folder / "hosts.yaml"
        path.write_text(yaml.safe_dump(document, sort_keys=False))
        return path

    def _host(self, name: str, router: str | None, python: str | None) -> dict[str, str]:
        given = {"address": self.address(name), "user": "root", "key": "keys/client", "known_hosts": "keys/known_hosts"}
        given |= {"folder": str(self.host_folder(name))}
        return given | ({"router": router} if router else {}) | ({"python": python} if python else {})

    def run(self, name: str, *command: str, **options: Any) -> subprocess.CompletedProcess[str]:
        """Run a command on a host (or the launcher) to its end; options as for `subprocess.run`."""
        given = {"text": True, "capture_output": True, "timeout": RUN_S, "cwd": ROOT} | options
        return subprocess.run(self._inside(name, command), **{**given, "env": self._env(name, options.get("env"))})

    def popen(self, name: str, *command: str, **options: Any) -> subprocess.Popen[str]:
        """Start a command on a host (or the launcher); options as for `subprocess.Popen`."""
        given = {"text": True, "cwd": ROOT, "start_new_session": True} | options
        return subprocess.Popen(self._inside(name, command), **{**given, "env": self._env(name, options.get("env"))})

    def prefix(self, name: str) -> tuple[str, ...]:
        """Return the words that run a command on a host when put in front of it."""
        return (shutil.which("ip", path=environment()["PATH"]) or "ip", "netns", "exec", self.namespace(name))

    def _inside(self, name: str, command: Sequence[str]) -> list[str]:
        return [*self.prefix(name), *command]

    def _env(self, name: str, given: Mapping[str, str] | None) -> dict[str, str]:
        return {**environment(), **self._variables.get(name, {}), **(given or {})}

    def inside(self, name: str) -> AbstractContextManager[None]:
        """Move the calling thread, and threads that it starts, into the network of a host."""
        return namespaces.entered(self.namespace(name))

    def environment(self, name: str, **variables: str) -> None:
        """Set variables for every process that is started on a host from now on, over ssh too."""
        self._variables[name] = variables
        self._retire(self._sshd.pop(name))
        self._start_sshd(name)

    def cut(self, name: str) -> None:
        """Cut a host off from all others: packets are lost without notice."""
        self._nft(f"add element bridge lab cut {{ {', '.join(self._ports(name))} }}")

    def heal(self, name: str) -> None:
        """Undo `cut`."""
        self._nft(f"delete element bridge lab cut {{ {', '.join(self._ports(name))} }}")

    def slow(self, name: str, delay_ms: float, jitter_ms: float = 0.0, loss: float = 0.0, seed: int = 1) -> None:
        """Give a host's link a delay, a jitter and a loss (0 to 1) in each direction; zeros undo it."""
        self._fast(name)
        if not (delay_ms or jitter_ms or loss):
            return
        near, far = self._ports(name)[1], f"{name}.far"
        lines = [f"link add name {near} type veth peer name {far}", f"link set dev {name} nomaster"]
        lines += [f"link set dev {near} master bridge", f"link set dev {near} up", f"link set dev {far} up"]
        self._ip("net", *lines)
        for place, interface in ((name, "eth0"), ("net", name), ("net", near), ("net", far)):
            switches = itertools.chain.from_iterable((offload, "off") for offload in OFFLOADS)
            checked(self._inside(place, ["ethtool", "-K", interface, *switches]))
        figures = map(str, (delay_ms, jitter_ms, loss, seed))
        emulator = [sys.executable, str(Path(__file__).parent / "link_emulator.py"), name, far, *figures]
        self._emulators[name] = self._service("net", emulator, "carrying", self.folder / name / "link.log")

    def _fast(self, name: str) -> None:
        """Remove the slow link, if there is one."""
        if emulator := self._emulators.pop(name, None):
            self._retire(emulator)
            near = self._ports(name)[1]
            self._ip("net", f"link del dev {near}", f"link set dev {name} master bridge")

    def processes(self, name: str) -> dict[int, str]:
        """Return the id and command of the zsim processes on a host (or the launcher)."""
        return {pid: line for pid, line in members(self.namespace(name)) if "zsim_deploy" in line or "/zsim " in line}

    def close(self) -> None:
        """End every process of the lab and remove its namespaces."""
        for namespace in self.namespaces():
            namespaces.remove(namespace)
        for service in (*self._past, *self._sshd.values(), *self._emulators.values()):
            service.finish()

    def __enter__(self) -> "Lab":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def namespaces(self) -> list[str]:
        """Return the names of the namespaces."""
        return [self.namespace(name) for name in ("net", LAUNCHER, *self.names)]

    def namespace(self, name: str) -> str:
        """Return the name of a host's network namespace."""
        return f"{self._prefix}-{name}"

    @staticmethod
    def _ports(name: str) -> tuple[str, str]:
        """Return a host's ports on the bridge: for its direct link and for its slow link."""
        return name, f"{name}.near"

    def _connect(self) -> None:
        """Create the namespaces, the bridge, and a cable from the bridge to each host."""
        ends = (LAUNCHER, *self.names)
        namespaces.ip(*(f"netns add {self.namespace(name)}" for name in ("net", *ends)))
        self._ip("net", "link add name bridge type bridge forward_delay 0", "link set dev bridge up")
        self._ip("net", *(self._cable(name) for name in ends))
        self._ip(
            "net",
            *(line for name in ends for line in (f"link set dev {name} master bridge", f"link set dev {name} up")),
        )
        for name in ends:
            address = f"addr add {self.address(name)}/24 dev eth0"
            self._ip(name, "link set dev lo up", address, "link set dev eth0 up")
        self._nft(CUTS)

    def _cable(self, name: str) -> str:
        return f"link add name {name} type veth peer name eth0 netns {self.namespace(name)}"

    def _ip(self, name: str, *lines: str) -> None:
        namespaces.ip(*lines, within=self.namespace(name))

    def _nft(self, text: str) -> None:
        checked(self._inside("net", ["nft", "-f", "-"]), text)

    def _make_keys(self) -> None:
        keys = self.folder / "keys"
        keys.mkdir(parents=True, exist_ok=True)
        sshd.make_key(keys / "client")
        known = []
        for name in self.names:
            (self.folder / name).mkdir(exist_ok=True)
            known.append(f"{self.address(name)} {sshd.make_key(self.folder / name / 'host_key')}")
        (keys / "known_hosts").write_text("".join(known))

    def _start_sshd(self, name: str) -> None:
        folder = self.folder / name
        variables = {**_arithmetic(), "ZSIM_LAB_HOST": name, "HOME": str(folder), **self._variables.get(name, {})}
        command = sshd.command(self.address(name), folder, self.folder / "keys/client.pub", variables)
        self._sshd[name] = self._service(name, command, sshd.READY, folder / "sshd.log")

    def _service(self, name: str, command: Sequence[str], ready: str, log: Path) -> Service:
        return Service(self._inside(name, command), ready, log, environment())

    def _retire(self, service: Service) -> None:
        """End a service; processes that it started, such as an sshd's sessions, live on."""
        service.kill()
        self._past.append(service)


def _arithmetic() -> dict[str, str]:
    """Return the variables that configure BLAS in this process, so that the hosts compute the same bits."""
    return {name: value for name, value in os.environ.items() if name.startswith("OPENBLAS_")}


def lacking() -> str | None:
    """Return why a lab is impossible on this machine; None if it is possible."""
    if not sys.platform.startswith("linux"):
        return "a lab of hosts needs Linux"
    if os.geteuid() != 0:
        return "a lab of hosts needs root"
    missing = [package for tool, package in TOOLS.items() if not shutil.which(tool, path=environment()["PATH"])]
    if missing:
        return f"a lab of hosts needs {' '.join(missing)}; apt-get install it"
    try:
        checked(["unshare", "--net", "true"])
    except OSError as error:
        return f"a lab of hosts needs network namespaces ({error})"
    return None


def demand() -> None:
    """Skip the test if a lab is impossible; fail it in CI."""
    if reason := lacking():
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(reason)


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    """Three hosts for one test; if a lab is impossible, the test is skipped, or fails in CI."""
    demand()
    with Lab(tmp_path / "lab") as made:
        yield made
