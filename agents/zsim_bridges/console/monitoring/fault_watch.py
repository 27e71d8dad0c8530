"""What injected faults strike, with which magnitudes, and what has changed since they began. Pure."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from zsim.contract.run_messages import Fault
from zsim_bridges.console.monitoring.alarms import DroneCondition, parameters_text

KEPT = 8  # faults that are over and still shown
SIGMA_GROWN = 1.2  # times: an estimate's sigma changes by as much without a fault
LAG_GROWN_MS = 40.0  # two gates
LIFE = ("alive", "dead")  # states of a process
DEATH_AND_RETURN = 3  # alive, dead, alive
WIND_GROWN_M_S = 0.3  # chosen: above the rounding of what is shown


@dataclass(frozen=True)
class Figures:
    """What a fault may change of what it strikes: worst sigma and lag of its drones, wind, states and phases.

    Attributes:
        states: of drones, formations and processes, by name.
    """

    sigma_m: float = 0.0
    lag_ms: float = 0.0
    wind_m_s: float = 0.0
    states: Mapping[str, str] = field(default_factory=dict)


@dataclass
class _Watched:
    fault: Fault
    before: Figures
    worst: Figures
    changes: dict[str, list[str]]
    over: bool = False


class FaultWatch:
    """Watches the faults of a run."""

    def __init__(self) -> None:
        self._watched: dict[int, _Watched] = {}

    def clear(self) -> None:
        """Forget all, as a replay does that goes back."""
        self._watched.clear()

    def update(
        self,
        begun: Iterable[Fault],
        active: Iterable[Fault],
        drones: Mapping[str, DroneCondition],
        phases: Mapping[str, str],
        lost: Iterable[str],
        wind_m_s: float,
    ) -> None:
        """Take over what is seen now.

        Args:
            begun: faults that have begun, those of an instant among them.
            active: those that act.
            drones: the condition of each.
            phases: of each formation.
            lost: processes that are dead or silent.
            wind_m_s: over the drones.
        """
        acting = {fault.id: fault for fault in active}
        known = {fault.id: fault for fault in begun} | acting
        gone = frozenset(lost)
        for number, fault in known.items():
            now = _figures(fault, drones, phases, gone, wind_m_s)
            watched = self._watched.get(number)
            if watched is None:
                self._watched[number] = watched = _Watched(fault, now, now, {n: [s] for n, s in now.states.items()})
            watched.fault, watched.over = acting.get(number, watched.fault), number not in acting
            _note(watched, now)
        for number in set(self._watched) - set(known):
            self._watched[number].over = True
        over = [number for number, each in self._watched.items() if each.over]
        for number in over[:-KEPT]:
            del self._watched[number]

    def lines(self, is_over: bool = False) -> list[str]:
        """Return a line for each fault that acts, or that is over."""
        return [_line(each) for each in self._watched.values() if each.over == is_over]


def _figures(
    fault: Fault, drones: Mapping[str, DroneCondition], phases: Mapping[str, str], lost: frozenset[str], wind_m_s: float
) -> Figures:
    """Return the figures of what a fault strikes: a target names drones, or processes that are named after them."""
    parts = fault.target.split("/")
    things = {part.rpartition(".")[2] for part in parts}
    everybody = not things & (set(drones) | set(phases))  # the world
    struck = [drone for name, drone in drones.items() if everybody or name in things]
    states = {drone.name: drone.state for drone in struck}
    states |= phases if everybody or len(phases) == 1 else {name: phases[name] for name in things & set(phases)}
    states |= {part: LIFE[part in lost] for part in parts if "." in part}
    sigma_m = max((drone.sigma_m or 0.0 for drone in struck), default=0.0)
    lag_ms = max((drone.lag_ms or 0.0 for drone in struck), default=0.0)
    return Figures(sigma_m, lag_ms, wind_m_s if fault.kind == "gust" else 0.0, states)


def _note(watched: _Watched, now: Figures) -> None:
    """Keep the worst and every new state while the fault acts; a killed process dies, and comes back, after it."""
    if not watched.over:
        watched.worst = replace(
            watched.worst,
            sigma_m=max(watched.worst.sigma_m, now.sigma_m),
            lag_ms=max(watched.worst.lag_ms, now.lag_ms),
            wind_m_s=max(watched.worst.wind_m_s, now.wind_m_s),
        )
    for name, state in now.states.items():
        seen = watched.changes.setdefault(name, [state])
        is_killed = state in LIFE and len(seen) < DEATH_AND_RETURN
        if seen[-1] != state and (not watched.over or is_killed):
            seen.append(state)


def _line(watched: _Watched) -> str:
    fault, before, worst = watched.fault, watched.before, watched.worst
    until = "" if fault.until_ns is None else f" to {fault.until_ns / 1e9:.1f} s"
    what = " ".join(filter(None, (f"#{fault.id} {fault.kind} of {fault.target}", parameters_text(fault))))
    effects = []
    if worst.sigma_m > SIGMA_GROWN * before.sigma_m > 0.0:
        effects.append(f"σ {before.sigma_m:.2f} → {worst.sigma_m:.2f} m")
    if worst.lag_ms > before.lag_ms + LAG_GROWN_MS:
        effects.append(f"lag {before.lag_ms:.0f} → {worst.lag_ms:.0f} ms")
    if worst.wind_m_s > before.wind_m_s + WIND_GROWN_M_S:
        effects.append(f"wind {before.wind_m_s:.1f} → {worst.wind_m_s:.1f} m/s")
    for name, seen in watched.changes.items():
        if len(seen) > 1 or seen == ["dead"]:
            effects.append(f"{name} {' → '.join(each.replace('_', ' ') for each in seen[-4:])}")
    return f"{what}, {fault.from_ns / 1e9:.1f} s{until}: {', '.join(effects) or 'no effect seen'}"
