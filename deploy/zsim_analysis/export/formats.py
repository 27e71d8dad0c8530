"""What an export can be written as, and what that needs; imports nothing of it, for hosts that have not got it."""

from enum import StrEnum
from importlib.util import find_spec

from zsim.errors import RunError


class Format(StrEnum):
    """What can be written."""

    CSV = "csv"
    PARQUET = "parquet"
    MAT = "mat"
    FOXGLOVE = "foxglove"


DEFAULTS = {  # names beside the record
    Format.CSV: "csv",
    Format.PARQUET: "parquet",
    Format.MAT: "run.mat",
    Format.FOXGLOVE: "foxglove.mcap",
}
READING = ("mcap", "zstandard", "numpy")  # modules that read a record
NEEDED = {  # modules of the extra `export`
    Format.CSV: (*READING, "pyarrow"),
    Format.PARQUET: (*READING, "pyarrow"),
    Format.MAT: (*READING, "scipy"),
    Format.FOXGLOVE: (*READING, "foxglove"),
}


def check_installed(form: Format) -> None:
    """Refuse what this installation cannot write.

    Raises:
        RunError: the extra is missing.
    """
    missing = [module for module in NEEDED[form] if find_spec(module) is None]
    if missing:
        raise RunError(f"zsim export: {missing[0]} is not installed; install zsim[export]")
