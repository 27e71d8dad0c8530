"""The pace of a run whose drones are served on the wire of a real aircraft: their programs go by the wall clock."""

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.errors import NoWorldError, RunError
from zsim.transport.session import Session, Unanswered


def set_pace(link: Session, info: Info, name: str, rate: float | None) -> None:
    """Ask the world for a pace, where one is given; refuse a run that has none.

    Args:
        link: an open session.
        info: of the run.
        name: of this process.
        rate: simulated per wall seconds; None leaves the run's.

    Raises:
        RunError: the run goes as fast as possible, or the world refuses the pace.
        NoWorldError: the world went meanwhile.
    """
    if rate is None:
        if info.mode == "lockstep" and not info.rate:
            raise RunError(
                f"{name}: run {info.run_id} goes as fast as possible, and programs for real aircraft go by the wall "
                "clock; give --rate 1 here, or start the run with --rate 1 or --realtime"
            )
        return
    answer = link.request(keys.CONTROL, "rate", name, {"value": rate})
    if isinstance(answer, Unanswered):
        raise NoWorldError(f"{name}: the world of run {info.run_id} does not answer ({answer.error})")
    if not answer.ok:
        raise RunError(f"{name}: the world does not set the pace to --rate {rate:g}: {answer.error}")
