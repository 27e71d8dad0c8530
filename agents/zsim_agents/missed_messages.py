"""What a recorder has missed, asked of the world, which keeps it for a while."""

import time
from collections.abc import Callable, Iterator

import msgspec

from zsim.contract import keys, messages
from zsim.contract.run_messages import Clock
from zsim.errors import NoWorldError
from zsim.transport.connection import read_info
from zsim.transport.session import Session
from zsim.transport.traffic import replay

REPLAY_S = 5.0  # a hub answers within milliseconds
Message = tuple[str, bytes]  # key, payload


class MissedMessages:
    """Asks the world of a run for what has passed.

    Args:
        link: to the world.
        name: who asks.
        run_id: of the run.
        pauses: waits a little; False once the asking is to end.
    """

    def __init__(self, link: Session, name: str, run_id: str, pauses: Callable[[], bool]) -> None:
        self._link = link
        self._name = name
        self._run_id = run_id
        self._pauses = pauses
        self._clock = msgspec.msgpack.Decoder(Clock)

    def info(self) -> messages.Info | None:
        """Return what the world says of its run, which may take a while where it was just started again."""
        until_s = time.monotonic() + REPLAY_S
        while (info := read_info(self._link)) is None and time.monotonic() < until_s and self._pauses():
            pass
        return info

    def reaches_run(self) -> bool:
        """Tell whether the world of this run answers."""
        info = self.info()
        return info is not None and info.run_id == self._run_id

    def messages(self, before: Clock | None) -> Iterator[Message]:
        """Yield what the world replays, asking until it has answered; see `_replayed`. Some may come twice then."""
        while True:
            try:
                yield from self._replayed(before)
            except NoWorldError:
                if self._pauses():
                    continue
            return

    def _replayed(self, before: Clock | None) -> Iterator[Message]:
        """Yield what the world replays, up to a clock that has arrived: what came after that is on its way as well."""
        held: list[Message] = []
        for entry in replay(self._link, self._name, -1, ["**"], REPLAY_S):
            held.append(entry)
            clock = self.clock_in(entry[1]) if before is not None and entry[0] == keys.CLOCK else None
            if before is not None and clock is not None and clock.seq >= before.seq:
                yield from held[:-1] if clock.seq == before.seq else ()
                return
            if before is None or clock is not None:
                yield from held
                held.clear()

    def clock_in(self, payload: bytes) -> Clock | None:
        """Return the clock of this run; None for garbage by somebody else on `clock`."""
        try:
            clock = self._clock.decode(payload)
        except messages.REFUSALS:
            return None
        return clock if clock.run_id == self._run_id else None
