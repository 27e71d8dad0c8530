"""What the world has kept of the last seconds, asked for again page by page."""

from collections.abc import Iterator, Sequence

from zsim.contract import keys
from zsim.contract.framing import pairs_of
from zsim.errors import DecodeError, NoWorldError
from zsim.transport.session import Session


def replay(
    link: Session, process: str, from_ns: int, expressions: Sequence[str], timeout_s: float
) -> Iterator[tuple[str, bytes]]:
    """Yield (key, payload), in the order in which they passed the world, of what is stamped after `from_ns`.

    Args:
        link: an open session.
        process: name of who asks.
        from_ns: simulated time [ns]; -1 for everything that the world still has.
        expressions: keys that are wanted.
        timeout_s: how long each page is waited for.

    Raises:
        NoWorldError: the world does not answer, or not with a replay; what was yielded until then is good.
    """
    page: int | None = 0
    while page is not None:
        try:
            args = {"from_ns": from_ns, "keys": list(expressions), "page": page}
            answer = link.request(keys.replay(process), "replay", process, args, timeout_s)
            passed = pairs_of(answer.result) if answer.ok else []
        except DecodeError as error:
            raise NoWorldError(f"{process}: the world's replay is of no use: {error}") from error
        if not answer.ok:
            raise NoWorldError(answer.error)
        yield from passed
        page = answer.more
