"""Reproducibility: the fingerprint of a process's code, stated in its join, and the hash of a flight.

A flight is computed with zsim.math.elementary, randomness and linear, which give the same bits on every processor and
with every version of Python and the numeric packages, so a fingerprint covers only the code and the contract. For
diagnosis, `machine` lists other differences between machines, on which only users' classes and camera pictures may
depend.
"""

import hashlib
import importlib.metadata
import importlib.util
import platform
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import threadpoolctl
from numpy.typing import ArrayLike, NDArray

from zsim import CONTRACT, __version__

PACKAGES = ("numpy", "scipy", "numba", "llvmlite")  # numeric packages
CODE = ("zsim", "zsim_world", "zsim_agents")  # packages whose sources determine a flight
COLUMNS = 13  # position, velocity, orientation, angular velocity of a drone
BUFFER_BYTES = 16_384  # bytes hashed at once, which takes no longer than a few small updates


@cache
def parts() -> dict[str, str]:
    """Return the versions of zsim, which `fingerprint` omits, and of the contract, and a hash of the sources."""
    return {"zsim": __version__, "contract": str(CONTRACT), "code": _code()}


@cache
def fingerprint() -> str:
    """Return 16 hex digits; if equal, the same scenario, seed and events give bit-identical flights."""
    text = ";".join(f"{name}={value}" for name, value in sorted(parts().items()) if name != "zsim")
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@cache
def machine() -> dict[str, str]:
    """Return what may differ between machines that give equal results: processor, libraries, versions."""
    versions = {package: _version(package) for package in PACKAGES}
    return {
        "python": platform.python_version(),
        "system": platform.system(),
        "machine": platform.machine(),
        "cpu": _cpu(),
        "blas": _blas(),
        "libc": "-".join(filter(None, platform.libc_ver())) or platform.system(),
        **{package: version for package, version in versions.items() if version},
    }


def _code() -> str:
    """Return a hash of the sources of the packages in CODE, independent of line endings and folder."""
    digest = hashlib.sha256()
    for package in CODE:
        spec = importlib.util.find_spec(package)
        if spec is None or spec.origin is None:
            continue
        folder = Path(spec.origin).parent
        for name in sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.py")):
            digest.update(f"{package}/{name}\0".encode())
            digest.update((folder / name).read_bytes().replace(b"\r\n", b"\n"))
    return digest.hexdigest()[:16]


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _cpu() -> str:
    """Return the processor's model and a hash of its feature flags, on which libraries and compilers depend."""
    entries: dict[str, str] = {}
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as lines:
            for line in lines:
                name, _, value = line.partition(":")
                entries.setdefault(name.strip(), value.strip())
    except OSError:
        return platform.processor()
    flags = entries.get("flags", entries.get("Features", ""))
    digest = hashlib.sha256(" ".join(sorted(flags.split())).encode()).hexdigest()[:8]
    return " ".join(filter(None, (entries.get("model name", ""), digest)))


def _blas() -> str:
    """Return the BLAS libraries of the system and the numeric packages, with the target processor of each.

    OpenCV has its own BLAS, which is not used here and may select another processor.
    """
    libraries = set()
    for each in threadpoolctl.threadpool_info():
        folder = Path(each["filepath"]).parent
        package = None  # package whose wheel contains the library; None: the system's
        if folder.suffix == ".libs":  # as auditwheel and delvewheel name it
            package = folder.stem
        elif folder.name == ".dylibs":  # as delocate does
            package = folder.parent.name
        if each["user_api"] == "blas" and package in (None, *PACKAGES):
            libraries.add(f"{each['internal_api']}-{each.get('architecture', '')}")
    return " ".join(sorted(libraries)) or "none"


class TruthHash:
    """SHA-256 over all truth messages of a flight (docs/protocol.md, "Bit-identical results").

    A row is t_ns (int64), position, velocity, orientation and angular velocity (float64), little-endian. Rows are in
    order of time and, at equal times, in the scenario's order of drones.

    Args:
        rows: number of rows per `add`: the drones at one time, or all rows of a flight.
    """

    def __init__(self, rows: int) -> None:
        self._copy: Callable[[memoryview], object] | None = None
        row = np.dtype([("t", "<i8"), ("x", "<f8", COLUMNS)])
        self._hash = hashlib.sha256()
        self._rows = np.zeros((max(1, BUFFER_BYTES // max(1, rows * row.itemsize)), rows), dtype=row)
        self._t, self._x = self._rows["t"], self._rows["x"]
        self._buffered = 0

    def resume(self, hashed: Iterable[bytes], copy: Callable[[memoryview], object]) -> None:
        """Restart from the bytes passed to a former `copy`, and pass further bytes to `copy`."""
        self._hash, self._buffered = hashlib.sha256(), 0
        for data in hashed:
            self._hash.update(data)
        self._copy = copy

    def snapshot(self) -> Any:
        """Return the state for `restore`."""
        self.flush()
        return self._hash.copy()

    def restore(self, snapshot: Any) -> None:
        self._hash, self._buffered = snapshot.copy(), 0

    def add(self, t_ns: ArrayLike, state: NDArray[np.float64]) -> None:
        """Add rows.

        Args:
            t_ns: time of all rows, or of each row, (rows,) [ns].
            state: (rows, 13 or more), beginning with position, velocity, orientation, angular velocity.
        """
        self._t[self._buffered] = t_ns
        self._x[self._buffered] = state[:, :COLUMNS]
        self._buffered += 1
        if self._buffered == len(self._rows):
            self.flush()

    def flush(self) -> None:
        if not self._buffered or not self._rows.size:  # no rows if all drones are external
            self._buffered = 0
            return
        self._hash.update(data := self._rows[: self._buffered].data)
        if self._copy:
            self._copy(data.cast("B"))
        self._buffered = 0

    def hexdigest(self) -> str:
        self.flush()
        return self._hash.hexdigest()
