"""Unusual machines: no locks, shared memory, home or output streams; odd and overlong paths; proxies."""

import csv
import errno
import fcntl
import io
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from federation import ONE, PAIR, Federation, compiled, free_port
from forked_commands import ROOT, USER_FAULT, ZSIM, refusal, run, run_here
from refused import has_terms
from wire import PATIENCE_S

from zsim.errors import RunError
from zsim.math import compiled as kernels
from zsim.record import RecordReader, completeness
from zsim_analysis.bundle import make_bundle
from zsim_api import federation as tested

__all__ = ["compiled"]
needs_root = pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("unshare"), reason="mounts need root")
SHORT = ("--duration", "1", "--no-report")
LOOK_MS = 50
LOCKLESS = """
import errno, fcntl, os
def flock(*_):
    raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))
fcntl.flock = flock
"""  # for child processes; in this process monkeypatch undoes it


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Path:
    """The folder of a shared run of 1 s, next to its scenario."""
    folder = tmp_path_factory.mktemp("flown")
    (folder / "pair.yaml").write_text(PAIR)
    done = run_here("run", str(folder / "pair.yaml"), "--in-process", *SHORT, "--out", str(folder / "run"))
    assert done.code == 0, done
    return folder / "run"


CLOSED, FULL = ">&- 2>&- <&-", ">/dev/full 2>/dev/full"
STREAMED = (  # command, its exit code whatever happens to its output, the streams to try it with
    ("--version", 0, (CLOSED, FULL)),
    ("validate {scenario}", 0, (FULL,)),
    ("validate nowhere.yaml", USER_FAULT, (CLOSED,)),
    ("nonsense", USER_FAULT, (FULL,)),
    ("export {run} --format csv --out {out}/csv", 0, (CLOSED,)),
    ("replay {run} --rate 0 --listen tcp/127.0.0.1:{port}", 0, (CLOSED,)),
    ("run {scenario} --duration 1 --no-report --out {out}/run", 0, (CLOSED,)),
    ("run {scenario} --in-process --duration 1 --no-report --out {out}/run", 0, (FULL,)),
)


@pytest.mark.parametrize("streams", [CLOSED, FULL])
def test_closed_or_full_streams_lose_only_their_output(tmp_path: Path, flown: Path, streams: str) -> None:
    """The next file that is opened, such as the record, takes the descriptor of a closed stream."""
    names = {"scenario": flown.parent / "pair.yaml", "run": flown, "out": tmp_path, "port": free_port()}
    for command, code in [(command, code) for command, code, tried in STREAMED if streams in tried]:
        line = f"{shlex.join(ZSIM)} {command.format(**names)} {streams}"
        done = subprocess.run(
            ["sh", "-c", line], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
        assert done.returncode == code, (command, done)
        assert "Traceback" not in done.stdout + done.stderr
    with RecordReader(tmp_path / "run" / "run.mcap") as record:
        assert completeness(record).complete


def test_a_full_standard_output_is_reported_on_standard_error() -> None:
    done = subprocess.run(
        f"{shlex.join(ZSIM)} --help >/dev/full", shell=True, capture_output=True, text=True, check=True
    )
    assert done.stderr == f"cannot write to standard output ({os.strerror(errno.ENOSPC)}); output is lost\n"


ODD = os.fsdecode(b"lab:3 'a' \"b\" $HOME `x` [red]%s;&| \xc3\xbc\xe9\xa3\x9b \xff")  # the last byte is not valid UTF-8


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Glyph")  # the font lacks some glyphs
@pytest.mark.parametrize("several", [False, pytest.param(True, marks=pytest.mark.soak)], ids=["a run", "several"])
def test_commands_accept_paths_with_any_characters(
    tmp_path: Path, flown: Path, several: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(make_bundle, "figures", lambda *_: iter(()))  # skipped, as `report` writes figures
    folder = tmp_path / (ODD + "n" * 150)
    folder.mkdir()
    scenario, out = folder / f"{ODD}.yaml", folder / "run"
    shutil.copy(flown.parent / "pair.yaml", scenario)
    varied = ("--vary", "seed=1,2", "--workers", "1", "--keep-records")
    outside = ("sweep", scenario, *SHORT, *varied, "--out", folder / "sweep")
    here = [("report", out, flown, "--out", folder / f"{ODD}.html"), ("report", folder / "sweep")]
    if not several:
        outside = ("run", scenario, *SHORT, "--out", out)
        here = [("export", out, "--format", form) for form in ("csv", "parquet", "mat", "foxglove")]
        here += [("report", out, "--format", "svg"), ("rerun", out)]
        here += [("bundle", out, "-o", folder / f"{ODD}.zsim"), ("rerun", folder / f"{ODD}.zsim")]
    done = run(*map(str, outside))  # as its child processes are given these paths
    assert done.code == 0, done
    assert "Traceback" not in done.stderr
    if several:
        shutil.copytree(flown, out)
    for arguments in here:
        ended = run_here(*map(str, arguments))
        assert ended.code == 0, (arguments, ended)
    files = ("csv/truth.csv", "parquet/truth.parquet", "run.mat", "foxglove.mcap", "foxglove.rbl", "report.html")
    for path in [folder / f"{ODD}.html", folder / "sweep/report.html"] if several else [out / name for name in files]:
        assert path.stat().st_size > 1000, path


@pytest.mark.parametrize("path", ["n" * 300, "/tmp/" + "nnnnnnnnn/" * 450])
def test_an_overlong_path_is_reported(flown: Path, path: str) -> None:
    for arguments in (
        ("validate", path),
        ("run", path),
        ("run", str(flown.parent / "pair.yaml"), "--out", path),
        ("report", path),
        ("export", path, "--format", "csv"),
        ("export", str(flown), "--format", "mat", "--out", path),
        ("rerun", path),
        ("replay", path),
        ("sweep", str(flown.parent / "pair.yaml"), "--out", path),
        ("world", str(flown.parent / "pair.yaml"), "--journal", path),
        ("certs", "init", path, "--scenario", str(flown.parent / "pair.yaml")),
    ):
        assert os.strerror(errno.ENAMETOOLONG) in refusal(*arguments)


def test_csv_tables_by_name_have_increasing_time(tmp_path: Path, flown: Path) -> None:
    """PlotJuggler reads a table as a single time series."""
    done = run_here("export", str(flown), "--format", "csv", "--by-name", "--out", str(tmp_path / "csv"))
    assert done.code == 0, done
    assert {"truth.drone1.csv", "truth.drone2.csv", "clock.world.csv"} <= {
        each.name for each in (tmp_path / "csv").iterdir()
    }
    for drone in ("drone1", "drone2"):
        rows = list(csv.DictReader(io.StringIO((tmp_path / "csv" / f"truth.{drone}.csv").read_text())))
        assert {row["name"] for row in rows} == {drone}
        times = [int(row["t_ns"]) for row in rows]
        assert times == list(range(0, 1_000_000_001, 20_000_000))
    assert "--format csv" in refusal("export", str(flown), "--format", "mat", "--by-name")


READ_ONLY_TMPFS = "mount -t tmpfs -o ro tmpfs"
LACKING = {  # what is missing: shell commands before the run in a mount namespace, the run's exit code
    "variables, folders that can be written and shared memory": (  # as in a container
        f"{READ_ONLY_TMPFS} /dev/shm && mkdir $OUT/here && {READ_ONLY_TMPFS} $OUT/here && cd $OUT/here && "
        "env -i TMPDIR=/nowhere",
        0,
    ),
    "room for temporary files and in shared memory": (
        "mount -t tmpfs -o size=64k tmpfs /dev/shm && mkdir $OUT/small && mount -t tmpfs -o size=4k tmpfs $OUT/small && "
        "! head -c 9000 /dev/zero >$OUT/small/x && TMPDIR=$OUT/small",
        0,
    ),
    "a folder": ("mkdir $OUT/gone && cd $OUT/gone && rmdir $OUT/gone &&", USER_FAULT),
}


@needs_root
@pytest.mark.parametrize("lacking", LACKING)
def test_a_run_without_resources_succeeds_or_is_refused_cleanly(tmp_path: Path, flown: Path, lacking: str) -> None:
    before, code = LACKING[lacking]
    words = [*ZSIM, "run", str(flown.parent / "pair.yaml"), *SHORT, "--out", str(tmp_path / "run")]
    line = f"OUT={shlex.quote(str(tmp_path))}; {before} {shlex.join(words)}"
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", line], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    if code == 0:
        with RecordReader(tmp_path / "run" / "run.mcap") as record:
            assert completeness(record).complete


@pytest.mark.parametrize("words", ["ps", "logs world", "restart world", "move world h1", "down"])
def test_launchers_are_out_of_reach_without_unix_sockets(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows has no Unix sockets."""
    monkeypatch.delattr(os, "getuid")
    monkeypatch.delattr(socket, "AF_UNIX")
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    assert has_terms(refusal(*words.split()), "Unix sockets", "WSL")


def test_a_flight_under_test_needs_posix_signals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "killpg")
    with pytest.raises(RunError):
        tested.Federation(PAIR)


KERNEL = """
import os, sys
from zsim.math.compiled import kernel
@kernel()
def doubled(x):
    return 2.0 * x
doubled(1.0)
print(sum(doubled.stats.cache_hits.values()), doubled.stats.cache_path, os.listdir("."))
"""
READ_ONLY = f"mount --bind {shlex.quote(str(ROOT))} {shlex.quote(str(ROOT))} && mount -o remount,ro,bind {shlex.quote(str(ROOT))}"


@needs_root
def test_kernels_are_compiled_once_per_machine_without_a_home(tmp_path: Path) -> None:
    """As in some containers, neither the package nor a home is writable."""
    (tmp_path / "kernel.py").write_text(KERNEL)
    (tmp_path / "empty").mkdir()
    python = f"cd {tmp_path}/empty && env -u XDG_CACHE_HOME HOME=/proc/none {sys.executable} ../kernel.py"
    mounts = f"mount -t tmpfs tmpfs /var/tmp && {READ_ONLY}"
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", f"{mounts} && ({python}) && ({python}) && stat -c %a /var/tmp/zsim-0-compiled"],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, second, mode = done.stdout.splitlines()
    assert re.fullmatch(r"0 /var/tmp/zsim-0-compiled/\S+ \[\]", first)
    assert second == first.replace("0 ", "1 ", 1)
    assert mode == "700"


def test_a_cache_folder_that_others_can_write_is_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The cache holds code, so a folder that others can write is ignored, as is a link to one.

    The user has no known home, so Python leaves `~` unexpanded.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(kernels.os.path, "expanduser", lambda path: path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    own = re.compile(f"{re.escape(str(tmp_path))}|~")
    usable = kernels._is_writable
    monkeypatch.setattr(kernels, "_is_writable", lambda folder: bool(own.match(str(folder))) and usable(folder))
    monkeypatch.setattr(kernels.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(
        kernels, "Path", lambda *parts: Path(*(tmp_path / "var" if part == "/var/tmp" else part for part in parts))
    )
    folder = tmp_path / f"zsim-{os.getuid()}-compiled"
    assert kernels.cache_folder() == str(folder)
    folder.chmod(0o777)
    assert kernels.cache_folder() == ""
    folder.rmdir()
    folder.symlink_to("/tmp")
    assert kernels.cache_folder() == ""
    assert not Path("~").exists()


@pytest.fixture
def lockless(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a file system without locks, as NFS and Lustre can be, in this process and its Python children."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(LOCKLESS)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"))
    monkeypatch.setattr(fcntl, "flock", fcntl.flock)
    exec(LOCKLESS)


@pytest.mark.usefixtures("compiled", "lockless")
def test_runs_and_sweeps_work_without_file_locks(tmp_path: Path) -> None:
    scenario = tmp_path / "pair.yaml"
    scenario.write_text(PAIR)
    reason = os.strerror(errno.EOPNOTSUPP)
    alone = ("run", "--in-process", *SHORT)
    for command, *options in (alone, (*alone, "--force"), ("sweep", "--runs", "1", *SHORT)):
        out = tmp_path / f"{command}s"
        done = run_here(command, str(scenario), *options, "--out", str(out))
        assert done.code == 0, done.stderr
        assert [line for line in done.stderr.splitlines() if reason in line] == [
            f"{out}: cannot be locked ({reason}); do not let two commands write there at the same time"
        ]
    record = (tmp_path / "runs" / "run.mcap").read_bytes()
    assert record


NGINX = """
daemon off; pid {folder}/nginx.pid; error_log {folder}/error.log; worker_processes 1;
events {{}}
http {{
  access_log off; client_body_temp_path {folder}/b; proxy_temp_path {folder}/p; fastcgi_temp_path {folder}/f;
  uwsgi_temp_path {folder}/u; scgi_temp_path {folder}/s;
  map $http_upgrade $connection_upgrade {{ default upgrade; '' close; }}
  server {{
    listen 127.0.0.1:{port};
    location /zsim/ {{ {passed} proxy_pass http://127.0.0.1:{console}/; }}
    location = /zsim {{ {passed} if ($http_upgrade) {{ rewrite ^ / break; proxy_pass http://127.0.0.1:{console}; }} return 301 /zsim/; }}
    location /gateway/ {{ {passed} proxy_pass http://127.0.0.1:{gateway}/; }}
  }}
}}
"""
PASSED = (
    "proxy_http_version 1.1; proxy_set_header Host $http_host; proxy_set_header Upgrade $http_upgrade; "
    "proxy_set_header Connection $connection_upgrade;"
)


def wait_for_port(port: int) -> None:
    """Wait until something listens on a port."""
    until_s = time.monotonic() + PATIENCE_S
    while True:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        assert time.monotonic() < until_s
        threading.Event().wait(LOOK_MS / 1000)


@pytest.mark.skipif(not shutil.which("nginx"), reason="nginx is missing; on Debian: apt-get install nginx-light")
def test_the_console_and_the_gateway_work_behind_a_proxy_path(federation: Federation, browser: Any) -> None:
    ports = {name: free_port() for name in ("port", "console", "gateway")}
    folder = federation.folder
    (folder / "nginx.conf").write_text(NGINX.format(folder=folder, passed=PASSED, **ports))
    federation.world(ONE, "--rate", "1", "--duration", "600")
    console = federation.role("console", "--port", str(ports["console"]), "--token", "secret")
    gateway = federation.role("gateway", "--http", str(ports["gateway"]), "--lines", str(free_port()))
    console.line("steer at")
    gateway.line(f":{ports['gateway']}")
    nginx = subprocess.Popen(["nginx", "-c", str(folder / "nginx.conf"), "-p", str(folder)])
    try:
        base = f"http://127.0.0.1:{ports['port']}"
        wait_for_port(ports["port"])
        page = browser.new_page()
        requested: list[str] = []
        page.on("request", lambda request: requested.append(request.url))
        page.on("websocket", lambda socket: requested.append(socket.url))
        for path in ("/zsim/", "/zsim/view"):
            page.goto(f"{base}{path}?token=secret")
            assert page.url.partition("?")[0] == f"{base}{path}"
            assert "token" not in page.url
            page.get_by_text("drone1").first.wait_for(timeout=1000 * PATIENCE_S)  # received over viser's socket
            page.wait_for_function("() => document.querySelector('#zsim-head')?.innerText.match(/\\d/)")

        def places() -> set[str]:
            here = f"127.0.0.1:{ports['port']}"
            return {url.partition(here)[2] for url in requested if url.startswith(("http", "ws"))}

        until_s = time.monotonic() + PATIENCE_S
        while not {"/zsim/head", "/zsim/actions", "/zsim/view/head", "/zsim/view/actions"} <= places():
            assert time.monotonic() < until_s, places()
            page.wait_for_timeout(LOOK_MS)
        assert all(place.startswith("/zsim") for place in places()), places()
        answer = page.request.get(f"{base}/gateway/zsim/world/info")
        assert answer.ok
        description = page.request.get(f"{base}/gateway/openapi.json").json()
        assert description["servers"] == [{"url": "."}]
    finally:
        nginx.terminate()
        nginx.wait(PATIENCE_S)
