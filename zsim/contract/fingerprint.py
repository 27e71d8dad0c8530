"""What the last bit of a number depends on, and the `join` in which a process states it.

CPU feature level, libm, versions of the numeric packages; BLAS comes with numpy and scipy, so their versions stand for
it.
"""

import hashlib
import importlib.metadata
import os
import platform
from functools import cache

from zsim import __version__
from zsim.contract.run_messages import Join

PACKAGES = ("numpy", "scipy", "numba", "llvmlite", "filterpy")


@cache
def parts() -> dict[str, str]:
    """Return what the fingerprint is made of, in words."""
    versions = {package: _version(package) for package in PACKAGES}
    return {
        "zsim": __version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cpu": _cpu_features(),
        "libc": "-".join(filter(None, platform.libc_ver())) or platform.system(),
        **{package: version for package, version in versions.items() if version},
    }


@cache
def fingerprint() -> str:
    """Return 16 hex digits: equal fingerprints promise equal bits."""
    text = ";".join(f"{name}={value}" for name, value in sorted(parts().items()))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def join_of(
    name: str,
    host: str,
    run_id: str,
    incarnation: int,
    seq: int,
    t_ns: int = 0,
    period_ns: int = 0,
    serves: tuple[str, ...] = (),
    calculates: bool = True,
) -> Join:
    """Return the message with which this process takes part in a run.

    Args:
        name: of the process, role.thing.
        period_ns: how often it says done; 0 for never.
        serves: names of processes whose work it does.
        calculates: whether its results depend on its arithmetic; else it states no fingerprint.
    """
    return Join(
        t_ns=t_ns,
        seq=seq,
        run_id=run_id,
        incarnation=incarnation,
        role=name.partition(".")[0],
        host=host,
        pid=os.getpid(),
        period_ns=period_ns,
        version=__version__,
        fingerprint=fingerprint() if calculates else "",
        serves=serves,
    )


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _cpu_features() -> str:
    """Return a hash of the CPU's feature flags, which decide what libm, BLAS and the compiled kernel use."""
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as lines:
            flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:
        flags = platform.processor()
    return hashlib.sha256(" ".join(sorted(flags.split())).encode()).hexdigest()[:8]
