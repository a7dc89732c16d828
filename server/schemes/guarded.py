"""Wrapper that catches the errors of a plug-in's scheme, so that no error ends the flight.

If the scheme fails for a vehicle, no plan is sent to it at that step. The vehicle flies its present
plan to the end, and then its failsafe acts.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.server.planning.plugin_errors import NO_PLAN, PluginErrors
from skytether.server.planning.scheme import (
    Batch,
    Figures,
    Fleet,
    Foresight,
    Header,
    Scheme,
    SentPlans,
    Splines,
)
from skytether.server.schemes.horizons import uplink_max_ns
from skytether.shared.law.model import Flags, Indices
from skytether.shared.law.terms import COMMITTING
from skytether.shared.wire.protocol import (
    FLOAT_MAX,
    INPUT_TOLERANCE,
    KNOTS_MAX,
    Observation,
    ahead_max,
)


class GuardedScheme(Scheme):
    """A plug-in's scheme, called for a whole block or, if that fails, for each vehicle alone."""

    def __init__(self, name: str, inner: Scheme, fleet: Fleet) -> None:
        super().__init__(fleet)
        self._inner = inner
        self._errors = PluginErrors(f"the scheme {name}", NO_PLAN, "scheme_errors", fleet.tell)
        self.observed_step = inner.observed_step
        self.uplink_max_ns = uplink_max_ns(fleet.terms)
        self._ahead_max = ahead_max(fleet.terms) if fleet.terms.scheme in COMMITTING else 0
        self._bounds = INPUT_TOLERANCE * np.array(fleet.terms.u_max)[:, None]
        self._withheld: set[int] = set()
        """Rows of the vehicles to which no plan is sent at this step."""

    def forget(self, row: int) -> None:
        with self._errors:
            self._inner.forget(row)

    def observe(self, row: int, observation: Observation) -> bool:
        """Let the scheme store an observation, see `Scheme`; return False if the scheme fails."""
        with self._errors:
            return bool(self._inner.observe(row, observation))
        return False

    def foresee(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        """Do nothing, because `plan` also calls the scheme's `foresee`."""

    def plan(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        """Let the scheme plan; a plan counts as unsolved if it fails or cannot be flown."""
        for i in self._call(len(rows), partial(self._plan, rows, step, foresight)):
            _blank(_cut(foresight, slice(i, i + 1)), self.figures[i : i + 1], rows[i], step[i])
            self.figures["solved"][i], self.planned[i] = False, 0.0

    def _plan(self, rows: Indices, step: Indices, foresight: Foresight, selected: slice) -> None:
        cut, n = _cut(foresight, selected), selected.stop - selected.start
        inner = self._inner
        _blank(cut, inner.figures[:n], rows[selected], step[selected])
        inner.foresee(rows[selected].copy(), step[selected].copy(), cut)
        inner.plan(rows[selected].copy(), step[selected].copy(), cut)
        self._check(cut)
        self.figures[selected], self.planned[selected] = inner.figures[:n], inner.planned[:n]

    def remember(self, rows: Indices, step: Indices, foresight: Foresight, event: Flags) -> None:
        """Let the scheme store the plans; the plan of a vehicle for which it fails is not sent."""
        failed = self._call(len(rows), partial(self._remember, rows, step, foresight, event))
        self._withheld = {int(rows[i]) for i in failed}

    def _remember(
        self, rows: Indices, step: Indices, foresight: Foresight, event: Flags, selected: slice
    ) -> None:
        cut = _cut(foresight, selected)
        self._inner.remember(
            rows[selected].copy(), step[selected].copy(), cut, event[selected].copy()
        )
        self._check(cut)

    def encode(self, batch: Batch, header: Callable[[int], Header]) -> Iterator[tuple[int, bytes]]:
        for i in batch.sent.tolist():
            if int(batch.rows[i]) not in self._withheld:
                packets: Sequence[tuple[int, bytes]] = ()
                with self._errors:
                    packets = [*self._inner.encode(batch._replace(sent=np.array([i])), header)]
                yield from packets

    def sent_plans(self, batch: Batch) -> SentPlans:
        """Plans that are sent, for the record, see `Scheme`; zeros if the scheme fails."""
        with self._errors:
            return self._inner.sent_plans(batch)
        n, step = len(batch.sent), batch.step[batch.sent]
        axes, H = self.terms.axes, self.terms.horizon
        return SentPlans(step, step, np.zeros((n, axes, 2)), np.zeros((n, axes, H)))

    def _call(self, n: int, call: Callable[[slice], None]) -> list[int]:
        failed = []
        try:
            call(slice(0, n))
        except Exception:
            for i in range(n):
                with self._errors:
                    call(slice(i, i + 1))
                    continue
                failed.append(i)
        return failed

    def _check(self, foresight: Foresight) -> None:
        """Raise ValueError unless the plans can be flown."""
        splines = foresight.splines
        if not ((foresight.ahead >= 0) & (foresight.ahead <= self._ahead_max)).all():
            raise ValueError(f"expected delay bounds from 0 to {self._ahead_max} in `ahead`")
        if not (np.abs(foresight.horizons) <= self._bounds).all():  # NaN fails too
            raise ValueError("expected inputs within ±model.u_max in `horizons`")
        if not (np.abs(splines.knots) <= FLOAT_MAX).all():
            raise ValueError("expected finite numbers in `splines.knots`")
        number = splines.number
        if not ((number >= 1) & (number <= KNOTS_MAX) & (splines.spacing >= 1)).all():
            raise ValueError(f"expected splines of 1 to {KNOTS_MAX} knots, at least 1 step apart")
        if not (np.isfinite(foresight.estimate).all() and np.isfinite(foresight.start).all()):
            raise ValueError("expected finite numbers in `estimate` and `start`")


def _cut(foresight: Foresight, selected: slice) -> Foresight:
    """Predictions for some vehicles of a block; the arrays are views."""
    arrays: Iterable[NDArray[Any]] = foresight[:-1]
    splines = Splines._make(array[selected] for array in foresight.splines)
    return Foresight._make((*(array[selected] for array in arrays), splines))


def _blank(foresight: Foresight, figures: Figures, rows: Indices, step: Indices) -> None:
    """Fill in defaults: inputs of zero from the present step on."""
    splines = foresight.splines
    for array in (
        foresight.ahead,
        foresight.committed,
        foresight.held,
        foresight.disturbance,
        foresight.horizons,
    ):
        array[:] = 0
    for array in (
        foresight.estimate,
        foresight.start,
        foresight.feedback,
        splines.knots,
        splines.age,
    ):
        array[:] = 0
    foresight.usable[:] = foresight.held.shape[-1]
    splines.number[:] = splines.spacing[:] = 1
    figures[:] = 0
    figures["row"], figures["step"], figures["start"] = rows, step, step
    figures["gap"], figures["solved"] = 1, True
