"""Cuts a record at a message, so that the run that it is of can be gone on with."""

from collections.abc import Callable
from pathlib import Path

from zsim.contract import messages
from zsim.errors import RecordError
from zsim.record.record_reader import RecordReader
from zsim.record.record_writer import RecordWriter


def cut_at_last(path: Path, key: str, is_it: Callable[[bytes], bool]) -> bool:
    """Take the last message of a key off a record, and all that was written after it; return whether there was one.

    Args:
        key: of the message.
        is_it: returns, by the payload, whether it is the one that is meant.

    Raises:
        RecordError: no record, it cannot be written, or another process writes it.
    """
    with RecordReader(path) as reader:
        cut = reader.last_chunk(key, is_it)
    if cut is None:
        return False
    start, before = cut
    try:
        with open(path, "r+b") as file:
            file.truncate(start)
    except OSError as error:
        raise RecordError(f"{path}: cannot be cut ({error.strerror})") from error
    with RecordWriter(path, goes_on=True) as writer:
        for each in before:
            writer.add(each.key, each.payload, messages.encoding(each.key), each.t_ns, each.wall_ns)
    return True
