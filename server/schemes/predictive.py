"""The scheme "predictive", the paper's: predicts the present state from an old observation.

    x̂(k) = A^τ x(k-τ) + Σ_{i=1…τ} A^{i-1} B û(k-i)        τ: age of the observation in steps

û is the input history of eq. (12): the first input of each plan computed, whether sent or not
(E12). Eq. (13) is evaluated by repeating eq. (4), step by step.

The scheme "none" uses the same code and takes the newest observation as the present state.

The paper has neither observer nor feedback aboard. With `control.observer_s`, a disturbance ŵ is
estimated from pairs of observations (`server.schemes.observer`) and added to every û. With feedback
aboard the horizon carries x̂(k), ŵ and K.
"""

from collections import Counter
from typing import NamedTuple

import numpy as np

from skytether.server.mpc import exact, hierarchical, riccati
from skytether.server.planning.compiled import Laws, advance, laws_of
from skytether.server.planning.scheme import Fleet, Foresight, SchemeCode
from skytether.server.schemes import horizons
from skytether.server.schemes.feedback import feedback_gain
from skytether.server.schemes.horizons import HorizonScheme
from skytether.server.schemes.observer import decay_of, updated_disturbance
from skytether.shared.base.kernel import F2, F3, I1, S3, kernel, part
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.terms import INDEXED, Terms
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.wire.protocol import (
    DISTURBANCE,
    GAIN_P,
    GAIN_V,
    REFERENCE_P,
    REFERENCE_V,
    Observation,
)

APART_NS = 250_000_000
"""Longest time between two observations that update the disturbance [ns]. The inputs flown between
the observations are interpolated, which is too coarse over longer times."""


class EstimatorSettings(NamedTuple):
    """Constants shared by all vehicles."""

    laws: Laws
    """Model, bound and gain of each axis; shape (axes,)."""
    compensate: bool
    """Whether observations are predicted to the present; False for the scheme "none"."""
    dt_ns: int
    decay: float
    """Share of the observer's error that remains after a step, see `observer.decay_of`."""
    feeds_back: bool


class EstimatorMemory(NamedTuple):
    """Newest observation and input history of every vehicle."""

    observed: I1
    """Step of the newest observation, or -1; shape (capacity,)."""
    state: F3
    """Observed state [m, m/s]; shape (capacity, axes, 2)."""
    flown: F2
    """Input flown at the step of the newest observation [m/s]; shape (capacity, axes)."""
    base: I1
    """Step of the previous observation that updated the disturbance, or -1; shape (capacity,)."""
    base_velocity: F2
    """Velocity in the observation of step `base` [m/s]; shape (capacity, axes)."""
    base_flown: F2
    """Input flown at the step `base` [m/s]; shape (capacity, axes)."""
    disturbance: F2
    """Disturbance ŵ [m/s]; shape (capacity, axes)."""
    inputs: F3
    """Input history û, a ring over the steps [m/s]; shape (capacity, axes, age_max)."""
    last: I1
    """Newest step with an entry in the input history, or -1; shape (capacity,)."""


class Estimator:
    """Predictor of the schemes "predictive" and "none".

    Args:
        control: `observer_s`, which the scheme "none" ignores.
        gain: gain K of the feedback aboard, 0 without feedback; shape (axes, 2).
    """

    def __init__(self, terms: Terms, control: ControlConfig, gain: Array, capacity: int) -> None:
        n, compensate = terms.axes, terms.scheme in INDEXED
        self.counts: Counter[str] = Counter()
        self._settings = EstimatorSettings(
            laws=laws_of(terms, gain),
            compensate=compensate,
            dt_ns=terms.dt_ns,
            decay=decay_of(terms, control) if compensate else 1.0,
            feeds_back=terms.feedback,
        )
        self._memory = EstimatorMemory(
            observed=np.full(capacity, -1, dtype=np.int64),
            state=np.zeros((capacity, n, 2)),
            flown=np.zeros((capacity, n)),
            base=np.full(capacity, -1, dtype=np.int64),
            base_velocity=np.zeros((capacity, n)),
            base_flown=np.zeros((capacity, n)),
            disturbance=np.zeros((capacity, n)),
            # Observations older than `age_max` are not used, so no older input is needed.
            inputs=np.zeros((capacity, n, terms.age_max)),
            last=np.full(capacity, -1, dtype=np.int64),
        )
        self.observed_step: Indices = self._memory.observed

    def forget(self, row: int) -> None:
        memory = self._memory
        memory.observed[row] = memory.base[row] = memory.last[row] = -1
        memory.disturbance[row] = 0.0
        memory.inputs[row] = 0.0

    def observe(self, row: int, observation: Observation) -> bool:
        memory = self._memory
        if observation.step <= memory.observed[row]:
            return False
        memory.observed[row] = observation.step
        memory.state[row] = observation.state
        memory.flown[row] = observation.input
        return True

    def foresee(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        """Predict x̂(k), from which planning starts at step k.

        Source: eq. (13).
        """
        _predict(self._settings, self._memory, rows, step, foresight)

    def remember(
        self,
        rows: Indices,
        step: Indices,
        foresight: Foresight,
        event: Flags,  # noqa: ARG002 - whether sent or not (E12)
    ) -> None:
        """Append û(k) ← u(k|k); steps without a plan repeat the previous input.

        Source: eq. (12).
        """
        _append_inputs(self._memory.inputs, self._memory.last, rows, step, foresight.horizons)


def make(fleet: Fleet) -> HorizonScheme:
    control, gain = fleet.scenario.control, feedback_gain(fleet.scenario)
    return HorizonScheme(Estimator(fleet.terms, control, gain, fleet.capacity), fleet)


CODE = SchemeCode(make, lambda _: (horizons, hierarchical, exact, riccati))


@part
def _observe_disturbance(
    settings: EstimatorSettings, memory: EstimatorMemory, row: int, k: int
) -> None:
    begin, end = memory.base[row], memory.observed[row]
    m, near = end - begin, APART_NS // settings.dt_ns
    for i in range(len(settings.laws)):
        axis, velocity, u = (
            settings.laws[i],
            memory.base_velocity[row, i],
            memory.base_flown[row, i],
        )
        # At least one step, even if Δt is longer than APART_NS.
        if begin >= 0 and 0 < m <= max(1, near):
            w, change = memory.disturbance[row, i], (memory.flown[row, i] - u) / m
            p, v = 0.0, velocity
            for step in range(m):
                # Inputs between two observations are not reported, but interpolated linearly here.
                p, v = advance(axis, p, v, u + step * change + w)
            off, trip_ns = memory.state[row, i, 1] - v, (k - end) * settings.dt_ns
            memory.disturbance[row, i] = updated_disturbance(
                w, off, m, axis.a11, settings.decay, trip_ns, axis.bound
            )
        memory.base_velocity[row, i] = memory.state[row, i, 1]
        memory.base_flown[row, i] = memory.flown[row, i]
    memory.base[row] = end


@kernel
def _predict(
    settings: EstimatorSettings, memory: EstimatorMemory, rows: I1, steps: I1, foresight: Foresight
) -> None:
    """Fill in x̂(k) as `estimate` and `start`, the disturbance ŵ, and the feedback.

    Source: eq. (13).
    """
    reach = memory.inputs.shape[2]
    for i in range(len(rows)):
        row, k = rows[i], steps[i]
        if settings.decay < 1.0:
            _observe_disturbance(settings, memory, row, k)
        for j in range(len(settings.laws)):
            axis, w = settings.laws[j], memory.disturbance[row, j]
            p, v = memory.state[row, j, 0], memory.state[row, j, 1]
            if settings.compensate:
                for step in range(memory.observed[row], k):
                    # Steps after `last` repeat its input.
                    u = memory.inputs[row, j, min(step, memory.last[row]) % reach]
                    p, v = advance(axis, p, v, u + w)
            foresight.estimate[i, j, 0], foresight.estimate[i, j, 1] = p, v
            foresight.start[i, j, 0], foresight.start[i, j, 1] = p, v
            foresight.disturbance[i, j] = w
            if settings.feeds_back:
                feedback = foresight.feedback[i, j]
                feedback[REFERENCE_P], feedback[REFERENCE_V], feedback[DISTURBANCE] = p, v, w
                feedback[GAIN_P], feedback[GAIN_V] = axis.gain_p, axis.gain_v


@kernel
def _append_inputs(inputs: F3, last_step: I1, rows: I1, steps: I1, horizons: S3) -> None:
    """Append the first input of each horizon to the history `inputs`, see `Estimator.remember`.

    Source: eq. (12).
    """
    reach = inputs.shape[2]
    for i in range(len(rows)):
        row, step, last = rows[i], steps[i], last_step[rows[i]]
        if last >= 0:
            for axis in range(horizons.shape[1]):
                repeated = inputs[row, axis, last % reach]
                for missed in range(max(last + 1, step - reach + 1), step):
                    inputs[row, axis, missed % reach] = repeated
        for axis in range(horizons.shape[1]):
            inputs[row, axis, step % reach] = horizons[i, axis, 0]
        last_step[row] = step
