"""Splines sent to vehicles: encoded as messages, and as inputs for the record."""

from collections.abc import Callable, Iterator

import numpy as np

from skytether.server.planning.compiled import Axes, axes_of, axis_at, bounded
from skytether.server.planning.scheme import Batch, Header, Scheme, SentPlans
from skytether.shared.base.kernel import F1, F3, I1, kernel, shared
from skytether.shared.law import spline
from skytether.shared.scenario.schemes import SchemeProperties
from skytether.shared.wire.protocol import Trajectory, encode

along = shared(spline.along)


class SplineScheme(Scheme):
    """A scheme that sends the splines of `Foresight.splines`."""

    properties = SchemeProperties(flown_as="trajectory", feedback=True)

    def encode(self, batch: Batch, header: Callable[[int], Header]) -> Iterator[tuple[int, bytes]]:
        sent, splines = batch.sent, batch.foresight.splines
        rows, old = batch.rows[sent], splines.age[sent]
        step = batch.step[sent] - old
        age = step - self.observed_step[rows]
        # A trajectory that is sent again may be older than the newest observation: then its age is
        # negative, and 0 is sent. A new trajectory's age is negative after the server's clock was
        # set; this age is sent unchanged: step minus age must be the step of an observation.
        age = np.where(old > 0, np.maximum(age, 0), age)
        columns = (sent, rows, step, age, splines.spacing[sent], splines.number[sent])
        for i, row, k, age_steps, spacing, n in zip(*map(np.ndarray.tolist, columns), strict=True):
            knots = splines.knots[i, :, : 2 * n].reshape(-1, n, 2)
            vehicle, session, sent_us, number, silence = header(row)
            fields = (vehicle, session, k, sent_us, age_steps, spacing, knots, number, silence)
            yield row, encode(Trajectory(*fields))

    def sent_plans(self, batch: Batch) -> SentPlans:
        terms, sent, splines = self.terms, batch.sent, batch.foresight.splines
        step = batch.step[sent] - splines.age[sent]
        knots = splines.knots[sent].astype(np.float64)
        inputs = np.empty((len(sent), terms.axes, terms.horizon))
        inputs_along(
            axes_of(terms.model),
            np.array(terms.u_max),
            terms.dt_s,
            knots,
            splines.number[sent],
            splines.spacing[sent],
            inputs,
        )
        return SentPlans(step, step + batch.foresight.ahead[sent], knots[:, :, :2], inputs)


@kernel
def inputs_along(
    model: Axes, bounds: F1, dt_s: float, knots: F3, number: I1, spacing: I1, inputs: F3
) -> None:
    """Fill in the inputs ū along splines [m/s].

    Args:
        model: eq. (4).
        bounds: u_max of each axis [m/s]; shape (axes,).
        knots: knots of each spline, as in `Splines` [m, m/s]; shape (n, axes, 2 KNOTS_MAX).
        number: number of knots; shape (n,).
        spacing: steps from one knot to the next; shape (n,).
        inputs: output; shape (n, axes, H).
    """
    for i in range(len(number)):
        for axis in range(len(bounds)):
            spline_knots = knots[i, axis, : 2 * number[i]]
            for stage in range(inputs.shape[2]):
                u = along(axis_at(model, axis), spline_knots, spacing[i], dt_s, stage)
                inputs[i, axis, stage] = bounded(u, bounds[axis])
