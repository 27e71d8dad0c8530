"""The fingerprint of code and contract, equal on every machine, and the hash of a flight, recomputed with `struct`."""

import hashlib
import importlib.util
import os
import platform
import re
import struct
import subprocess
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest
import threadpoolctl

from zsim.contract import fingerprint as module
from zsim.contract.fingerprint import CODE, TruthHash, fingerprint, machine, parts


@pytest.fixture(autouse=True)
def _asked_anew():
    for asked in (parts, fingerprint, machine):
        asked.cache_clear()
    yield
    for asked in (parts, fingerprint, machine):
        asked.cache_clear()


def test_the_fingerprint_is_the_same_in_a_process_on_another_processor():
    command = [sys.executable, "-c", "from zsim.contract.fingerprint import fingerprint; print(fingerprint())"]
    other = {**os.environ, "OPENBLAS_CORETYPE": "Nehalem", "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA"}
    found = subprocess.run(command, capture_output=True, text=True, check=True, env=other).stdout.strip()
    assert found == fingerprint()
    assert re.fullmatch(r"[0-9a-f]{16}", found)


def test_the_fingerprint_depends_on_text_but_not_line_endings_or_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def code(folder: str, text: bytes) -> str:
        place = tmp_path / folder
        place.mkdir(exist_ok=True)
        (place / "__init__.py").write_bytes(b"")
        (place / "drag.py").write_bytes(text)
        spec = ModuleSpec("any", None, origin=str(place / "__init__.py"))
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: spec if name == CODE[0] else None)
        parts.cache_clear()
        return parts()["code"]

    here = code("a", b"DRAG = 0.3\n")
    assert code("b", b"DRAG = 0.3\r\n") == here
    assert code("b", b"DRAG = 0.4\n") != here


@pytest.mark.parametrize("part", ["code", "contract"])
def test_a_change_in_any_part_changes_the_fingerprint(part: str, monkeypatch: pytest.MonkeyPatch):
    here, known = fingerprint(), parts()
    monkeypatch.setattr(module, "parts", lambda: {**known, part: "other"})
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
def test_only_the_blas_of_numpy_scipy_or_the_system_counts(library: str, counts: bool, monkeypatch: pytest.MonkeyPatch):
    here, known = machine()["blas"], threadpoolctl.threadpool_info()
    other = {"user_api": "blas", "internal_api": "openblas", "architecture": "Other", "filepath": f"/usr/lib/{library}"}
    monkeypatch.setattr(threadpoolctl, "threadpool_info", lambda: [*known, other])
    machine.cache_clear()
    assert (machine()["blas"] != here) == counts


@pytest.mark.skipif(platform.machine() != "x86_64", reason="names of cores of x86")
@pytest.mark.parametrize("core", ["Haswell", "Sandybridge"])
def test_the_machine_names_the_core_for_which_blas_computes(core: str):
    command = [sys.executable, "-c", "from zsim.contract.fingerprint import machine; print(machine()['blas'])"]
    chosen = {**os.environ, "OPENBLAS_CORETYPE": core}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=chosen)
    assert done.stdout.strip() == f"openblas-{core}"


def test_missing_packages_are_omitted_and_the_system_replaces_unknown_libc(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module.platform, "libc_ver", lambda: ("", ""))
    monkeypatch.setattr(module.platform, "system", lambda: "Darwin")
    monkeypatch.setattr(module, "PACKAGES", ("numpy", "no-such-package"))
    assert machine()["libc"] == "Darwin"
    assert "no-such-package" not in machine()


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


def test_the_hashed_bytes_are_those_of_the_contract():
    """Instants in time order, drones in scenario order: t_ns, position, velocity, orientation, angular velocity."""
    states = instants(100)  # more than are buffered
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


def test_time_and_order_change_the_hash():
    states = instants(3)
    assert digest(states[::-1]) != digest(states)
    assert digest([(t + 1, arrays) for t, arrays in states]) != digest(states)
    assert digest([(t, [array[::-1] for array in arrays]) for t, arrays in states]) != digest(states)


def test_the_hash_may_be_read_before_the_end():
    truth = TruthHash(DRONES)
    for t_ns, arrays in instants(4):
        truth.add(t_ns, np.hstack(arrays))
        truth.hexdigest()
    assert truth.hexdigest() == digest(instants(4))
