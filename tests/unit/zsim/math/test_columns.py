"""Columns by name."""

import numpy as np
import pytest

from zsim.math.compiled import Field, columns, portable

ROW = columns("Row", (Field("p_WB", "m", 3), Field("energy", "J"), Field("q_WB", "1", 4)))


def test_fields_stand_one_after_the_other():
    assert (ROW.p_WB, ROW.energy, ROW.q_WB, ROW.size) == (0, 3, 4, 8)


def test_two_fields_of_one_name_are_refused():
    with pytest.raises(ValueError, match="p_WB"):
        columns("Row", (Field("p_WB", "m", 3), Field("p_WB", "m", 3)))


@portable
def total(row):
    return row[ROW.energy] + row[ROW.q_WB]


def test_compiled_code_reads_them():
    assert total(np.arange(8.0)) == 7.0
