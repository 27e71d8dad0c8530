"""Fixtures of the scenario tests."""

import pytest
from federation import PAIR, Federation, compiled, federation, forked
from near_worker import near

__all__ = ["compiled", "federation", "forked", "near", "pair_sha256"]


@pytest.fixture(scope="session")
def pair_sha256(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> str:
    """Return the hash of PAIR flown in one process, checked against the truth on record."""
    with Federation(tmp_path_factory.mktemp("reference")) as reference:
        reference.run(PAIR, "--in-process").ends(with_code=0)
        record = reference.record()
        assert record.recomputed_sha256(["drone1", "drone2"]) == record.sha256()
        assert record.positions("drone1")[-1][2] > 1.0  # the drone has flown
        return record.sha256()
