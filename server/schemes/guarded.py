"""Wrapper of a plug-in's scheme: its errors end no flight.

If the scheme fails for a vehicle, that vehicle gets no plan at that step. It flies the plan that it
has to its end, and then its failsafe acts.
"""

import traceback
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.server.common.scheme import (
    Batch,
    Figures,
    Fleet,
    Foresight,
    Head,
    Scheme,
    SentPlans,
    Splines,
)
from skytether.shared.law.model import Flags, Indices
from skytether.shared.wire.protocol import (
    FLOAT_MAX,
    INPUT_TOLERANCE,
    KNOTS_MAX,
    Observation,
    committed_max,
)


class GuardedScheme(Scheme):
    """Plug-in's scheme with its errors caught.

    It is called for all vehicles of a block together, and if that fails, for each alone.

    Args:
        name: name of the scheme, for messages.
        inner: the scheme.
        fleet: flight and vehicles that it is made for.
    """

    def __init__(self, name: str, inner: Scheme, fleet: Fleet) -> None:
        super().__init__(fleet)
        self._name, self._inner, self._tell = name, inner, fleet.tell
        self.observed_step = inner.observed_step
        self._ahead_max = committed_max(fleet.terms) if fleet.terms.commits else 0
        self._bounds = INPUT_TOLERANCE * np.array(fleet.terms.u_max)[:, None]
        self._withheld: set[int] = set()
        """Rows of vehicles that are sent nothing at this step."""

    def forget(self, row: int) -> None:
        """See `Scheme`."""
        try:
            self._inner.forget(row)
        except Exception as error:
            self._fail(error)

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`; an observation for which it fails is not kept."""
        try:
            return bool(self._inner.observe(row, observation))
        except Exception as error:
            self._fail(error)
            return False

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """See `Scheme`; the scheme itself is asked in `plan`, both at once."""

    def plan(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """See `Scheme`; unsolved is what it fails for, and what could not be flown."""
        for i in self._ask(len(rows), partial(self._plan, rows, step, found)):
            _blank(_cut(found, slice(i, i + 1)), self.figures[i : i + 1], rows[i], step[i])
            self.figures["solved"][i], self.planned[i] = False, 0.0

    def _plan(self, rows: Indices, step: Indices, found: Foresight, some: slice) -> None:
        cut, n = _cut(found, some), some.stop - some.start
        inner = self._inner
        _blank(cut, inner.figures[:n], rows[some], step[some])
        inner.foresee(rows[some].copy(), step[some].copy(), cut)
        inner.plan(rows[some].copy(), step[some].copy(), cut)
        self._check(cut)
        self.figures[some], self.planned[some] = inner.figures[:n], inner.planned[:n]

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`; where it fails, nothing is sent."""
        failed = self._ask(len(rows), partial(self._remember, rows, step, found, event))
        self._withheld = {int(rows[i]) for i in failed}

    def _remember(
        self, rows: Indices, step: Indices, found: Foresight, event: Flags, some: slice
    ) -> None:
        cut = _cut(found, some)
        self._inner.remember(rows[some].copy(), step[some].copy(), cut, event[some].copy())
        self._check(cut)

    def encode(self, batch: Batch, head: Callable[[int], Head]) -> Iterator[tuple[int, bytes]]:
        """See `Scheme`."""
        for i in batch.sent.tolist():
            if int(batch.rows[i]) not in self._withheld:
                try:
                    yield from [*self._inner.encode(batch._replace(sent=np.array([i])), head)]
                except Exception as error:
                    self._fail(error)

    def sent_plans(self, batch: Batch) -> SentPlans:
        """See `Scheme`; zeros where it fails."""
        try:
            return self._inner.sent_plans(batch)
        except Exception as error:
            self._fail(error)
            n, step = len(batch.sent), batch.step[batch.sent]
            axes, H = self.terms.axes, self.terms.horizon
            return SentPlans(step, step, np.zeros((n, axes, 2)), np.zeros((n, axes, H)))

    def _ask(self, n: int, ask: Callable[[slice], None]) -> list[int]:
        """Call for n vehicles at once, and if that fails, for each alone; indices of the failed."""
        failed = []
        try:
            ask(slice(0, n))
        except Exception:
            for i in range(n):
                try:
                    ask(slice(i, i + 1))
                except Exception as error:
                    self._fail(error)
                    failed.append(i)
        return failed

    def _check(self, found: Foresight) -> None:
        """Check that the plans can be flown.

        Raises:
            ValueError: with the array that is out of bounds.
        """
        told = found.told
        if not ((found.ahead >= 0) & (found.ahead <= self._ahead_max)).all():
            raise ValueError(f"got other delay bounds than 0 … {self._ahead_max}")
        if not (np.abs(found.horizons) <= self._bounds).all():  # nor is NaN
            raise ValueError("got inputs that are not within ±model.u_max")
        if not (np.abs(told.knots) <= FLOAT_MAX).all():
            raise ValueError("got knots that are not finite")
        if not ((told.number >= 1) & (told.number <= KNOTS_MAX) & (told.spacing >= 1)).all():
            raise ValueError(f"got a spline of other than 1 to {KNOTS_MAX} knots, 1 step apart")
        if not (np.isfinite(found.estimate).all() and np.isfinite(found.start).all()):
            raise ValueError("got an estimate that is not finite")

    def _fail(self, error: Exception) -> None:
        if not self.counts["scheme_errors"]:
            what = f"the scheme {self._name}: {type(error).__name__}: {error}"
            trace = "".join(traceback.format_exception(error))
            self._tell(f"{trace}{what}; where it fails, its vehicle has no plan at that step")
        self.counts["scheme_errors"] += 1


def _cut(found: Foresight, some: slice) -> Foresight:
    """Predictions for some vehicles of a block; the arrays are views."""
    arrays: Iterable[NDArray[Any]] = found[:-1]
    told = Splines._make(each[some] for each in found.told)
    return Foresight._make((*(each[some] for each in arrays), told))


def _blank(found: Foresight, figures: Figures, rows: Indices, step: Indices) -> None:
    """Fill in the defaults: an input of zero from the present step on."""
    for each in (found.ahead, found.committed, found.held, found.disturbance, found.horizons):
        each[:] = 0
    for each in (found.estimate, found.start, found.feedback, found.told.knots, found.told.back):
        each[:] = 0
    found.flown[:] = found.held.shape[-1]
    found.told.number[:] = found.told.spacing[:] = 1
    figures[:] = 0
    figures["row"], figures["step"], figures["start"] = rows, step, step
    figures["gap"], figures["solved"] = 1, True
