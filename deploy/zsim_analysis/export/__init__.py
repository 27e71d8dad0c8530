"""Tables, MATLAB files and Foxglove files of a run, made from its record alone.

    export(DIR, Format.CSV, OUT, MessageSelection())     writes OUT, all of it or nothing

`selection` chooses messages, `message_columns` lays them out as tables, which `tables` and `matlab` write; the modules
of Foxglove draw. `make_export` puts files in their place. Imports zsim_analysis.reading. This file needs no extra: the
command line has the formats from it.
"""

from enum import StrEnum


class Format(StrEnum):
    """Formats of other tools."""

    CSV = "csv"
    PARQUET = "parquet"
    MAT = "mat"
    FOXGLOVE = "foxglove"
