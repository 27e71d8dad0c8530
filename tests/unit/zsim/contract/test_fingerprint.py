"""The numeric fingerprint, the same in every process of a machine; the hash of a flight, written again with `struct`."""

import hashlib
import os
import platform
import re
import struct
import subprocess
import sys

import numpy as np
import pytest
import threadpoolctl

from zsim.contract import fingerprint as module
from zsim.contract.fingerprint import PACKAGES, TruthHash, fingerprint, parts


@pytest.fixture(autouse=True)
def _asked_anew():
    parts.cache_clear()
    fingerprint.cache_clear()
    yield
    parts.cache_clear()
    fingerprint.cache_clear()


def test_another_process_has_the_same():
    command = [sys.executable, "-c", "from zsim.contract.fingerprint import fingerprint; print(fingerprint())"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == fingerprint()
    assert re.fullmatch(r"[0-9a-f]{16}", fingerprint())


def test_it_is_made_of_what_the_last_bit_depends_on():
    found = parts()
    assert {"zsim", "python", "machine", "cpu", "blas", "libc", "numpy"} <= set(found)
    assert all(found.values())


@pytest.mark.parametrize("package", [*PACKAGES, "processor"])
def test_another_version_of_a_package_or_processor_is_another_fingerprint(
    package: str, monkeypatch: pytest.MonkeyPatch
):
    here, known, features = fingerprint(), module._version, module._cpu_features()
    monkeypatch.setattr(module, "_version", lambda name: "0.0.0" if name == package else known(name))
    monkeypatch.setattr(module, "_cpu_features", lambda: "00000000" if package == "processor" else features)
    parts.cache_clear()
    fingerprint.cache_clear()
    assert fingerprint() != here


@pytest.mark.parametrize(
    ("library", "counts"),
    [
        ("opencv_python_headless.libs/libopenblas-r0.so", False),
        ("cv2/.dylibs/libopenblas.0.dylib", False),
        ("numpy.libs/libscipy_openblas64_.so", True),
        ("scipy/.dylibs/libscipy_openblas.dylib", True),
        ("x86_64-linux-gnu/libopenblas.so.0", True),
    ],
)
def test_a_blas_that_another_package_brings_is_none_of_it(library: str, counts: bool, monkeypatch: pytest.MonkeyPatch):
    here, known = fingerprint(), threadpoolctl.threadpool_info()
    other = {"user_api": "blas", "internal_api": "openblas", "architecture": "Other", "filepath": f"/usr/lib/{library}"}
    monkeypatch.setattr(threadpoolctl, "threadpool_info", lambda: [*known, other])
    parts.cache_clear()
    fingerprint.cache_clear()
    assert (fingerprint() != here) == counts


@pytest.mark.skipif(platform.machine() != "x86_64", reason="names of cores of x86")
@pytest.mark.parametrize("core", ["Haswell", "Sandybridge"])
def test_blas_for_another_processor_is_another_fingerprint(core: str):
    command = [sys.executable, "-c", "from zsim.contract.fingerprint import parts; print(parts()['blas'])"]
    chosen = {**os.environ, "OPENBLAS_CORETYPE": core}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=chosen)
    assert done.stdout.strip() == f"openblas-{core}"


def test_what_is_not_there_is_left_out_and_the_system_stands_for_an_unknown_c_library(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module.platform, "libc_ver", lambda: ("", ""))
    monkeypatch.setattr(module.platform, "system", lambda: "Darwin")
    monkeypatch.setattr(module, "PACKAGES", ("numpy", "no-such-package"))
    parts.cache_clear()
    assert parts()["libc"] == "Darwin"
    assert "no-such-package" not in parts()


DRONES = 3
WIDTHS = (3, 3, 4, 3)


def instants(count: int) -> list[tuple[int, list[np.ndarray]]]:
    rng = np.random.default_rng(1)
    return [(i * 20_000_000, [rng.normal(size=(DRONES, width)) for width in WIDTHS]) for i in range(count)]


def digest(states: list[tuple[int, list[np.ndarray]]]) -> str:
    truth = TruthHash(DRONES)
    for t_ns, arrays in states:
        truth.add(t_ns, np.hstack(arrays))
    return truth.hexdigest()


def test_the_bytes_are_the_contract_s():
    """Instants in time order, drones in scenario order: t_ns, position, velocity, orientation, angular velocity."""
    states = instants(100)  # more than are held back
    wanted = hashlib.sha256()
    for t_ns, arrays in states:
        for drone in range(DRONES):
            numbers = [float(x) for array in arrays for x in array[drone]]
            wanted.update(struct.pack("<q13d", t_ns, *numbers))
    assert digest(states) == wanted.hexdigest()
    assert digest([]) == hashlib.sha256(b"").hexdigest()


def test_layout_and_byte_order_of_the_arrays_do_not_matter():
    states = instants(2)
    turned = [(t, [np.asfortranarray(a).astype(">f8") for a in arrays]) for t, arrays in states]
    assert digest(turned) == digest(states)


@pytest.mark.parametrize("array", range(len(WIDTHS)))
@pytest.mark.parametrize("drone", range(DRONES))
def test_the_last_bit_of_every_number_counts(array: int, drone: int):
    states, changed = instants(2), instants(2)
    for column in range(WIDTHS[array]):
        values = changed[1][1][array]
        before = values[drone, column]
        values[drone, column] = np.nextafter(before, np.inf)
        assert digest(changed) != digest(states)
        values[drone, column] = before
    assert digest(changed) == digest(states)


def test_time_and_order_count():
    states = instants(3)
    assert digest(states[::-1]) != digest(states)
    assert digest([(t + 1, arrays) for t, arrays in states]) != digest(states)
    assert digest([(t, [array[::-1] for array in arrays]) for t, arrays in states]) != digest(states)


def test_the_hash_may_be_asked_on_the_way():
    truth = TruthHash(DRONES)
    for t_ns, arrays in instants(4):
        truth.add(t_ns, np.hstack(arrays))
        truth.hexdigest()
    assert truth.hexdigest() == digest(instants(4))
