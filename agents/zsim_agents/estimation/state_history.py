"""The recent past of dead reckoning, for measurements that hold for an earlier instant."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from zsim_agents.estimation.dead_reckoning import plus
from zsim_agents.estimation.madgwick import Quaternion, Vector, normalised, product, rotation_vector_quaternion


class Moment(NamedTuple):
    """State of one instant, and how much the filter had corrected by then in all."""

    t_s: float
    p: Vector
    v: Vector
    q: Quaternion
    w: Vector
    """Body rate [rad/s; B]."""
    p_corrected: Vector
    v_corrected: Vector


class StateHistory:
    """States at past gates.

    Args:
        span_s: how far back [s].
        step_s: interval between entries [s].
    """

    def __init__(self, span_s: float, step_s: float) -> None:
        self._moments: deque[Moment] = deque(maxlen=history_length(span_s, step_s))

    def clear(self) -> None:
        """Forget everything, when corrections have made the past attitude meaningless."""
        self._moments.clear()

    def append(self, moment: Moment) -> None:
        """Keep one more instant, not before any other."""
        self._moments.append(moment)

    def at(self, t_s: float, now: Moment) -> Moment:
        """Return the state at `t_s` as `now` sees it, later corrections included.

        Between the entries and `now` it is interpolated, before all of them it is the oldest, and after `now`
        it is reached with constant velocity and rate.
        """
        if t_s >= now.t_s:
            return now if t_s == now.t_s else _ahead(now, t_s - now.t_s)
        later = now
        for moment in reversed(self._moments):
            if moment.t_s <= t_s:
                earlier = _as_seen(moment, now)
                return earlier if moment.t_s == t_s else _between(earlier, _as_seen(later, now), t_s)
            later = moment
        return _as_seen(later, now)


def history_length(span_s: float, step_s: float) -> int:
    """Return how many entries, `step_s` apart, reach back for `span_s`."""
    return int(span_s / step_s) + 3


def _as_seen(past: Moment, now: Moment) -> Moment:
    """Return a past state with the corrections since then."""
    p = plus(plus(past.p, now.p_corrected, 1.0), past.p_corrected, -1.0)
    v = plus(plus(past.v, now.v_corrected, 1.0), past.v_corrected, -1.0)
    return Moment(past.t_s, p, v, past.q, past.w, now.p_corrected, now.v_corrected)


def _ahead(now: Moment, dt: float) -> Moment:
    turned = rotation_vector_quaternion((dt * now.w[0], dt * now.w[1], dt * now.w[2]))
    return now._replace(t_s=now.t_s + dt, p=plus(now.p, now.v, dt), q=product(now.q, turned))


def _between(a: Moment, b: Moment, t_s: float) -> Moment:
    """Interpolate linearly; quaternions of neighbouring instants are never opposite."""
    part = (t_s - a.t_s) / (b.t_s - a.t_s)
    w, x, y, z = (m + part * (n - m) for m, n in zip(a.q, b.q, strict=True))
    return b._replace(
        t_s=t_s,
        p=_mix(a.p, b.p, part),
        v=_mix(a.v, b.v, part),
        q=normalised((w, x, y, z)),
        w=_mix(a.w, b.w, part),
    )


def _mix(a: Vector, b: Vector, part: float) -> Vector:
    return (
        a[0] + part * (b[0] - a[0]),
        a[1] + part * (b[1] - a[1]),
        a[2] + part * (b[2] - a[2]),
    )
