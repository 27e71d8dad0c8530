"""Tables, MATLAB files and Foxglove files of a run, from its record alone.

    export(DIR, Format.CSV, OUT, MessageSelection())     writes OUT completely or not at all

Imports zsim_analysis.reading. This file needs no extra packages, since the command line imports the formats from it.
"""

from enum import StrEnum


class Format(StrEnum):
    """File formats of other tools."""

    CSV = "csv"
    PARQUET = "parquet"
    MAT = "mat"
    FOXGLOVE = "foxglove"
