"""The journal of a run on disk: all inputs of its world, in order, and checkpoints of the world's state.

A world is a function of its scenario and its inputs, so a restarted world continues bit for bit from a checkpoint and
the inputs since then. An entry is written to the file (not synced to disk) before any message that follows from it is
published, so killing the process loses no entry.

The folder contains, with n counting from 0: `n.entries`, frames of entries; `n.checkpoint`, the state before those
entries, absent for n = 0; `truth`, the input of the truth hash. A frame is the length and CRC-32 of its content
(little-endian, 32 bits each), then the content in MessagePack.
"""

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from zsim.contract.messages import REFUSALS
from zsim.contract.snapshot import State, pack, unpack
from zsim.errors import DecodeError, RunError
from zsim.output_folder import take_lock
from zsim_world.run import inputs
from zsim_world.run.inputs import Entry

VERSION = 4  # format of the files and of the states in them
CHECKPOINT_NS = 5_000_000_000  # simulated time between checkpoints; equals the length of the message history
CHECKPOINT_WALL_NS = 1_000_000_000  # minimum wall time between checkpoints, each of 20 MB for 1000 drones
CHECKPOINTS_KEPT = 3  # the newest may not be on disk yet, and the second newest too recent to refill the history
HASHED_BYTES = 1 << 20  # bytes of the truth hash's input read at a time
_FRAME = struct.Struct("<II")


class _Head(msgspec.Struct, array_like=True):
    """The first frame of each file."""

    version: int
    run_id: str
    scenario_sha256: str

    def __str__(self) -> str:
        return f"version {self.version}, run {self.run_id!r}, scenario {self.scenario_sha256[:8]}"


class Checkpoint(NamedTuple):
    """A checkpoint of the world."""

    state: State | None  # None at the start of the run
    truth_bytes: int  # size of the truth hash's input up to the checkpoint


class RunJournal:
    """Reads and writes the journal of one run; without a folder, does nothing.

    Args:
        folder: folder for this run alone; created if missing.
        say: called with a line to show if the journal can no longer be written.
        all_died: whether all participants of a continued run must be restarted.
    """

    def __init__(
        self,
        folder: Path | None,
        run_id: str = "",
        scenario_sha256: str = "",
        say: Callable[[str], None] = print,
        all_died: bool = False,
    ) -> None:
        self.all_died = all_died
        self._folder = folder or Path()
        self._is_kept = folder is not None
        self._head = _Head(VERSION, run_id, scenario_sha256)
        self._say = say
        self._entries: list[Entry] = []
        self._file = self._truth = -1
        self._number = 0
        self._due_ns, self._due_wall_ns = CHECKPOINT_NS, 0
        self._writer = ThreadPoolExecutor(1, "checkpoint")
        self._written: Future[None] | None = None

    # Writing

    def note(self, entry: Entry) -> None:
        """Add an entry, to be written by `commit`."""
        if self._is_kept:
            self._entries.append(entry)

    def commit(self) -> None:
        """Write the added entries to the file; must precede the publication of any message that follows from them."""
        if self._entries:
            entries, self._entries = self._entries, []
            self._guarded(lambda: _write(self._file, _framed(inputs.encode(entries))))

    def keep_truth(self, data: memoryview) -> None:
        if self._is_kept:
            self._guarded(lambda: _write(self._truth, data))

    def is_due(self, now_ns: int, wall_ns: int) -> bool:
        """Return whether a checkpoint is due by simulated and monotonic wall time."""
        due = now_ns >= self._due_ns and wall_ns >= self._due_wall_ns and self._is_kept
        return due and (self._written is None or self._written.done())

    def add_checkpoint(self, state: State, now_ns: int, wall_ns: int) -> None:
        """Begin the next part of the journal with a state, written by a separate thread."""
        self._due_ns, self._due_wall_ns = now_ns + CHECKPOINT_NS, wall_ns + CHECKPOINT_WALL_NS
        self.commit()

        def begin() -> None:
            former, truth_bytes = self._file, os.lseek(self._truth, 0, os.SEEK_CUR)
            self._number += 1
            self._file = self._open_entries(self._number)
            content = pack({"truth_bytes": truth_bytes, "state": state})
            self._written = self._writer.submit(self._write_checkpoint, self._number, content, former)

        self._guarded(begin)

    def _write_checkpoint(self, number: int, content: bytes, former: int) -> None:
        """Write a checkpoint to disk, after the files on which it depends, and remove obsolete files."""
        path = self._folder / f"{number}.checkpoint"
        os.fsync(former)
        os.close(former)
        os.fsync(self._truth)
        file = os.open(path.with_suffix(".new"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        try:
            _write(file, _framed(msgspec.msgpack.encode(self._head)) + _framed(content))
            os.fsync(file)
        finally:
            os.close(file)
        path.with_suffix(".new").replace(path)
        for former_path in self._folder.iterdir():
            if former_path.stem.isdecimal() and int(former_path.stem) <= number - CHECKPOINTS_KEPT:
                former_path.unlink()

    def _open_entries(self, number: int) -> int:
        file = os.open(self._folder / f"{number}.entries", os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        if not os.fstat(file).st_size:
            _write(file, _framed(msgspec.msgpack.encode(self._head)))
        return file

    def _guarded(self, write: Callable[[], None]) -> None:
        """Call `write`; if it fails, continue the run without a journal."""
        try:
            write()
        except OSError as error:
            self._is_kept = False
            fault = f"{self._folder}: the journal cannot be written ({error.strerror})"
            self._say(f"{fault}; if the world dies now, the run ends")
            self._entries.clear()
            self.close()

    def close(self) -> None:
        with suppress(OSError):
            self.commit()
        self._writer.shutdown()
        for file in (self._file, self._truth):
            if file >= 0:
                os.close(file)
        self._file = self._truth = -1

    def remove(self) -> None:
        """Remove the closed journal of a completed run."""
        if self._is_kept:
            with suppress(OSError):
                for path in self._folder.iterdir():
                    path.unlink()
                self._folder.rmdir()

    # Reading

    def open(self) -> Checkpoint | None:
        """Create or open the journal; return the checkpoint to continue from, or None for a new run.

        The checkpoint is the second newest, if there are two, so that the inputs since then (`entries`) refill the
        message history.

        Raises:
            RunError: the journal belongs to another run, is in use, is incomplete, or cannot be read or written.
        """
        checkpoint = None
        if not self._is_kept:
            return checkpoint
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._truth = os.open(self._folder / "truth", os.O_RDWR | os.O_CREAT, 0o644)
            if not take_lock(self._truth):
                raise RunError(f"{self._folder}: another world keeps its journal there; end that one")
            numbers = sorted(int(path.stem) for path in self._folder.glob("*.entries"))
            if numbers:
                self._number = numbers[-1]
                complete = [number for number in numbers if number == 0 or self._checkpoint(number)]
                if not complete:
                    raise RunError(f"{self._folder}: no checkpoint is complete; the run cannot be continued")
                self._first = complete[-2] if len(complete) > 1 else complete[0]
                checkpoint = self._checkpoint(self._first) if self._first else Checkpoint(None, 0)
            self._file = self._open_entries(self._number)
        except OSError as error:
            raise RunError(f"{self._folder}: no journal can be kept there ({error.strerror})") from error
        return checkpoint

    def _checkpoint(self, number: int) -> Checkpoint | None:
        """Return a checkpoint; None if it is incomplete."""
        with suppress(OSError, DecodeError):
            frames = list(self._frames(self._folder / f"{number}.checkpoint"))
            if frames:
                content: dict[str, Any] = unpack(frames[0])
                return Checkpoint(content["state"], content["truth_bytes"])
        return None

    def entries(self) -> Iterator[Entry]:
        """Yield the inputs since the checkpoint returned by `open`.

        An incomplete entry at the end is dropped: no message that follows from it was published.
        """
        for number in range(self._first, self._number + 1):
            for frame in self._frames(self._folder / f"{number}.entries"):
                yield from inputs.decode(frame)

    def truth(self, size: int) -> Iterator[bytes]:
        """Yield the first `size` bytes of the truth hash's input; drop the rest, which the world will append again."""
        os.ftruncate(self._truth, size)
        os.lseek(self._truth, 0, os.SEEK_SET)
        while data := os.read(self._truth, HASHED_BYTES):
            yield data

    def _frames(self, path: Path) -> Iterator[bytes]:
        """Yield the complete frames after the head of a file, and truncate the file after them.

        Raises:
            RunError: the file belongs to another run.
        """
        data, complete_end = path.read_bytes(), 0
        for content, end in _complete_frames(data):
            if complete_end:
                yield content
            else:
                try:
                    head = msgspec.msgpack.decode(content, type=_Head)
                except REFUSALS as error:
                    raise RunError(f"{path}: is not the journal of a run ({error}); name another folder") from error
                if head != self._head:
                    raise RunError(f"{path}: belongs to {head}; must belong to {self._head}; name another folder")
            complete_end = end
        if complete_end < len(data):
            os.truncate(path, complete_end)


def _complete_frames(data: bytes) -> Iterator[tuple[bytes, int]]:
    """Yield the content and end offset of each frame of a file's data, up to the first incomplete one."""
    at = 0
    while len(data) - at >= _FRAME.size:
        size, check = _FRAME.unpack_from(data, at)
        content, at = data[at + _FRAME.size : at + _FRAME.size + size], at + _FRAME.size + size
        if len(content) < size or zlib.crc32(content) != check:
            return
        yield content, at


def journaled_run(folder: Path) -> str | None:
    """Return the id of the run whose journal is in a folder; None if the folder has no journal."""
    for path in sorted(folder.glob("*.entries")):
        with suppress(OSError, *REFUSALS):
            return msgspec.msgpack.decode(next(_complete_frames(path.read_bytes()))[0], type=_Head).run_id
    return None


def _framed(content: bytes) -> bytes:
    return _FRAME.pack(len(content), zlib.crc32(content)) + content


def _write(file: int, data: bytes | memoryview) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(file, view) :]
