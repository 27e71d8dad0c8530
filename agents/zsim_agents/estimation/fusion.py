"""How the measurements of a gate are compared with dead reckoning, judged, and put into it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from zsim_agents.estimation.aiding import SQUARE_MAX, Aid, Measurement
from zsim_agents.estimation.aiding_models import write_baro, write_flow, write_gps, write_mag, write_sonar
from zsim_agents.estimation.dead_reckoning import ATTITUDE, POSITION, VELOCITY
from zsim_agents.estimation.estimator_prior import HEADING_SIGMA_RAD
from zsim_agents.estimation.madgwick import Vector, rotation
from zsim_agents.estimation.navigation_filter import NavigationFilter, Stack
from zsim_agents.estimation.state_history import Moment, StateHistory
from zsim_agents.estimation.strapdown import Strapdown


class Fusion:
    """Puts aiding measurements into dead reckoning by way of the filter.

    Args:
        navigation: the filter.
        strapdown: the nominal state that it corrects.
        history: the nominal state's past, kept here.
        field_ut: the Earth's magnetic field in the world.
    """

    def __init__(
        self, navigation: NavigationFilter, strapdown: Strapdown, history: StateHistory, field_ut: Vector
    ) -> None:
        self._filter, self._strapdown, self._history, self._field = navigation, strapdown, history, field_ut
        self._stack = Stack(navigation.dim_x)
        self._stacked: list[Aid] = []
        self._bias = [0.0] * navigation.dim_x  # by index in the error state, for the aiding sensors

    def use(self, measurements: Iterable[Measurement], heading_known: bool) -> None:
        """Judge and use a gate's measurements, in one stacked update unless they are very many.

        Args:
            measurements: none later than the gate.
            heading_known: without it a velocity in the heading frame says nothing and is refused.
        """
        now = past = self._strapdown.moment()
        for aid, t_sample_s, values, variance in measurements:
            if aid.name == "flow" and not heading_known:
                aid.refused += 1
                continue
            if not self._stack.has_room(len(values)):
                self._correct()
                now = past = self._strapdown.moment()
            if past.t_s != t_sample_s:
                past = self._history.at(t_sample_s, now)
            self._add(aid, past, now.t_s - past.t_s, values, variance)
        if self._stacked:
            self._correct()
            now = self._strapdown.moment()
        self._history.append(now)

    def forget_past(self) -> None:
        """Drop the history, when a turn of the attitude has made it meaningless."""
        self._history.clear()

    def _correct(self) -> None:
        """Use the stack."""
        passed = self._filter.correct(self._stack)
        for aid, good in zip(self._stacked, passed, strict=True):
            aid.judge(good, self._strapdown.t_s)
        if any(passed):
            error = self._filter.take_error()
            self._strapdown.correct(error)
            if self._filter.aiding_biases:
                self._bias = [bias + more for bias, more in zip(self._bias, error.tolist(), strict=True)]
        self._stacked.clear()
        self._stack.clear()

    def _add(self, aid: Aid, past: Moment, lag: float, values: Sequence[float], variance: Sequence[float]) -> None:
        """Add a measurement to the stack, compared with the state of its own instant."""
        predicted = self._predicted(aid, past, lag)
        if aid.bias_rows:
            predicted = self._with_biases(aid, predicted)
        if aid.out_of_patience(self._strapdown.t_s):
            self._believe_again(aid, [z - h for z, h in zip(values, predicted, strict=True)])
        self._stack.add(values, predicted, variance)
        self._stacked.append(aid)

    def _predicted(self, aid: Aid, past: Moment, lag: float) -> Sequence[float]:
        """Return what the sensor should read and write its rows of H."""
        H, i, R = self._stack.H, self._stack.rows, rotation(past.q)
        if aid.name == "mag":
            return write_mag(H, i, R, aid.R_BS, self._field)
        if aid.name == "baro":
            return (write_baro(H, i, past.p, R, aid.arm, lag),)
        if aid.name == "flow":
            return write_flow(H, i, past.v, R, past.w, aid.arm)
        if aid.name == "gps":
            return write_gps(H, i, past.p, past.v, R, past.w, aid.arm, lag)
        return (write_sonar(H, i, past.p, R, aid.arm, aid.down_B, lag),)

    def _with_biases(self, aid: Aid, predicted: Sequence[float]) -> list[float]:
        """Return the prediction with the sensor's biases on it, their columns of H written."""
        values = list(predicted)
        for name, row in aid.bias_rows:
            first = self._filter.bias_index[name]
            for k in range(aid.biases[name].size):
                self._stack.H[self._stack.rows + row + k, first + k] = 1.0
                values[row + k] += self._bias[first + k]
        return values

    def _believe_again(self, aid: Aid, innovation: Sequence[float]) -> None:
        """Make the states that a long refused sensor sees as uncertain as its innovation."""
        squares = [min(y * y, SQUARE_MAX) for y in innovation]
        if aid.name == "gps":
            self._filter.add_variance(slice(POSITION, VELOCITY + 3), squares)
        elif aid.name == "flow":
            self._filter.add_variance(slice(VELOCITY, VELOCITY + 3), sum(squares))
        elif aid.name == "baro":
            self._filter.add_variance(slice(POSITION + 2, POSITION + 3), squares[0])
        elif aid.name == "mag":
            self._filter.add_variance(slice(ATTITUDE + 2, ATTITUDE + 3), HEADING_SIGMA_RAD**2)
        aid.refused_since_s = self._strapdown.t_s
