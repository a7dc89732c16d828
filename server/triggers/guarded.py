"""Wrapper that catches the errors of a plug-in's policy."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.server.planning.plugin_errors import PluginErrors
from skytether.server.planning.scheme import Tell
from skytether.server.triggers.trigger import (
    Figures,
    Situation,
    Trigger,
    Verdict,
    all_of,
    timed,
)
from skytether.shared.law.model import Indices
from skytether.shared.telemetry.record import Compared


class Guarded(Trigger):
    """Wrapper that catches the errors of a plug-in's policy; if the policy fails, a plan is sent.

    A needless packet only costs bytes, but a missing packet may end the flight. A `budget` joined
    by & still limits the rate. The policy gets read-only arrays.

    Args:
        name: name of the policy, for messages.
        inner: the policy.
    """

    def __init__(self, name: str, inner: Trigger, tell: Tell) -> None:
        self.doubts = inner.doubts
        self._inner = inner
        then = "when it fails, a horizon is sent"
        self._errors = PluginErrors(f"the trigger {name}", then, "trigger_errors", tell)

    def forget(self, row: int) -> None:
        with self._errors:
            self._inner.forget(row)

    def test(self, situation: Situation) -> Verdict:
        rows, figures, estimate, planned, arrays = situation
        # Read-only views: an error in a policy must not change what is sent.
        views = map(_read_only, (rows, figures, estimate, planned))
        with self._errors:
            verdict = self._inner.test(Situation._make((*views, arrays)))
            return Verdict(
                column(verdict.event, np.bool_, len(rows)),
                column(verdict.figure, np.float64, len(rows)),
                column(verdict.threshold, np.float64, len(rows)),
                Compared(verdict.compared),
            )
        return timed(all_of(len(rows)), figures)

    def sent(self, rows: Indices, figures: Figures) -> None:
        with self._errors:
            self._inner.sent(rows.copy(), figures.copy())


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    view = array.view()
    view.flags.writeable = False
    return view


def column(values: Any, kind: type[np.generic], n: int) -> NDArray[Any]:
    """Values of n vehicles as an array of a type; shape (n,).

    Raises:
        ValueError: the values have another shape, or cannot be cast to the type.
    """
    column = np.asarray(values)
    if column.shape != (n,) or not np.can_cast(column.dtype, kind):
        got = f"{column.dtype.name} of shape {column.shape}"
        raise ValueError(f"got {got}, expected {np.dtype(kind).name} of shape ({n},)")
    # Kernels do not check types at each call: the array must have this type and be contiguous.
    return np.ascontiguousarray(column, dtype=kind)
