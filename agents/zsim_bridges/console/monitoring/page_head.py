"""The head of the page as plain data: the run's condition in words, alarms, what its buttons are refused. Pure."""

from collections.abc import Sequence
from typing import Any

from zsim.contract.run_messages import Clock
from zsim_bridges.console.monitoring.run_condition import RunCondition, fleet_refusals

WAITING_SHOWN = 4  # processes that are named
SOON_S = 0.5  # wall; a running world waits for so long now and then
STANDS_S = 2.0  # wall; a running world that waits for longer stands, for whoever looks


def page_head(
    name: str,
    run: RunCondition,
    clock: Clock | None,
    t_ns: int,
    alarms: Sequence[dict[str, object]] = (),
    single: Sequence[str] = (),
    world: str = "",
    record_s: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Return the head of the page of a run.

    Args:
        name: of the scenario.
        run: its condition.
        clock: the newest.
        t_ns: simulated time of what is shown.
        alarms: as `AlarmBoard.rows`.
        single: drones of no formation.
        world: where the run is, in words.
        record_s: of a replay, the times of the first and the last gate on record [s].
    """
    level = "waiting" if run.level == "running" and _stands(clock) else run.level
    title, detail = _title_and_detail(run, clock, t_ns, world, record_s)
    lines = [each for each in (name, "a record is played back" if run.replayed else "", detail, *_phases(run)) if each]
    refusals = {"land": fleet_refusals(run, single)["land"], "emergency": run.grounded()}
    head = {"level": level, "title": title, "detail": " · ".join(lines), "t_s": t_ns / 1e9, "replay": run.replayed}
    return {**head, "age_s": run.silent_s, "refusals": refusals, "alarms": list(alarms)}


def no_run_head(world: str, ended: str = "") -> dict[str, Any]:
    """Return the head of a page without a run.

    Args:
        world: where one is looked for.
        ended: why that of its launcher was over before the console had found it.
    """
    reason = f"the run is over: {ended}" if ended else "there is no run yet"
    refusals = {"land": reason, "emergency": reason}
    words = ("ended", "run over", ended) if ended else ("waiting", "waiting for a world", world)
    head = {**dict(zip(("level", "title", "detail"), words, strict=True)), "t_s": 0.0, "replay": False}
    return {**head, "age_s": 0.0, "refusals": refusals, "alarms": []}


def _stands(clock: Clock | None) -> bool:
    """Return whether time stands for so long that nobody would call that running."""
    return clock is not None and any(each.since_wall_s > STANDS_S for each in clock.waiting_for)


def _title_and_detail(
    run: RunCondition, clock: Clock | None, t_ns: int, world: str, record_s: tuple[float, float] | None
) -> tuple[str, str]:
    """Return the title and the detail."""
    t_s = (t_ns or (clock.t_ns if clock else 0)) / 1e9
    if run.level == "ended":
        return f"run over at {t_s:.1f} s", run.ended
    if run.level == "silent":
        return f"no answer from the world for {run.silent_s:.0f} s", f"what is shown is of {t_s:.1f} s, and may be over"
    state = "waiting" if run.clock == "running" and _stands(clock) else run.clock or "no clock yet"
    pace = f" × {clock.rate:.1f}" if clock is not None and state == "running" else ""
    title = f"{state} {t_s:.1f} s{pace}"
    if run.replayed:
        from_s, to_s = record_s or (t_s, t_s)
        share = f" ({100.0 * min(1.0, max(0.0, t_s - from_s) / (to_s - from_s)):.0f} %)" if to_s > from_s else ""
        title = f"REPLAY · {state} {t_s:.1f} of {to_s:.1f} s{share}{pace}"
    return f"EMERGENCY · {title}" if run.level == "emergency" else title, _waiting(clock, world)


def _waiting(clock: Clock | None, world: str) -> str:
    """Return which processes the world waits for, causes alone, and where those are awaited that never came."""
    if clock is None:
        return "waiting for the world's clock"
    late = [each for each in clock.waiting_for if clock.state == "waiting" or each.since_wall_s > SOON_S]
    late = [each for each in late if not each.held_by] or late
    names = [f"{each.name}{each.host and f' on {each.host}'} ({each.since_wall_s:.0f} s)" for each in late]
    rest = [f"{len(names) - WAITING_SHOWN} more"] if len(names) > WAITING_SHOWN else []
    where = f" in {world}" if world and not all(each.host for each in late) else ""
    return f"waiting for {', '.join([*names[:WAITING_SHOWN], *rest])}{where}" if names else ""


def _phases(run: RunCondition) -> list[str]:
    if len(run.phases) > 1 or run.ended or run.silent_s:
        return []
    return [f"{n}: {p.replace('_', ' ')}" + (f" – {reason}" if reason else "") for n, (p, reason) in run.phases.items()]
