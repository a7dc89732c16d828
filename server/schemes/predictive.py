"""Downlink delay compensator, eq. (12)-(13): where the vehicle is now, from where it was.

    x̂(k) = A^τ x(k-τ) + Σ_{i=1…τ} A^{i-1} B û(k-i)        τ: age of the observation in steps

û is the history of eq. (12): the first inputs the server computed, whether sent or not (E12). The
sum is not formed: one step of eq. (4) after the other says the same.

This is the scheme "predictive", and "none", which takes the newest observation for the present.
`server.schemes.committed` is the other.

The paper has neither observer nor feedback. With `control.observer_s` a disturbance ŵ is learned
from one observation to the next (`server.schemes.observer`), between the inputs that both say were
flown, and added to every û. With feedback aboard x̂(k), ŵ and K go with the horizon.
"""

from collections import Counter
from typing import NamedTuple

import numpy as np

from skytether.server.common.compiled import Laws, advance, laws_of
from skytether.server.common.scheme import Fleet, Foresight
from skytether.server.mpc import exact, hierarchical
from skytether.server.schemes import horizons
from skytether.server.schemes.horizons import HorizonScheme
from skytether.server.schemes.observer import decay_of, learned
from skytether.shared.base.kernel import F2, F3, I1, S3, kernel, part
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.gain import feedback_gain
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.wire.protocol import (
    DISTURBANCE,
    GAIN_P,
    GAIN_V,
    LED_P,
    LED_V,
    Observation,
)

APART_NS = 250_000_000
"""Longest time between two observations from which a disturbance is learned [ns]: the inputs flown
in between are reckoned from those at both ends."""


class EstimatorSettings(NamedTuple):
    """Constants shared by all vehicles."""

    laws: Laws
    """Model, bound and gain of each axis; shape (axes,)."""
    compensate: bool
    """Whether observations are flown on to the present."""
    dt_ns: int
    """Length of a step [ns]."""
    decay: float
    """Share of the error that the disturbance observer leaves in a step; 1 for no observer."""
    feeds_back: bool
    """Whether horizons bring feedback."""


class EstimatorMemory(NamedTuple):
    """State of every vehicle as the server knows it."""

    observed: I1
    """Step of the newest observation, or -1; shape (capacity,)."""
    state: F3
    """State of it [m, m/s]; shape (capacity, axes, 2)."""
    flown: F2
    """Input flown at its step [m/s]; shape (capacity, axes)."""
    base: I1
    """Step of the one that was learned from last, or -1; shape (capacity,)."""
    base_velocity: F2
    """Velocity of that [m/s]; shape (capacity, axes)."""
    base_flown: F2
    """Input flown at its step [m/s]; shape (capacity, axes)."""
    disturbance: F2
    """Disturbance ŵ [m/s]; shape (capacity, axes)."""
    inputs: F3
    """Input history û, a ring over the steps; 0, hovering, where nothing was computed [m/s]."""
    last: I1
    """Step whose û was computed last, or -1; shape (capacity,)."""


class Estimator:
    """The paper's `Scheme`: observations and inputs of up to `capacity` vehicles.

    Args:
        terms: the rule of flight; with the scheme "none", x̂(k) is the newest observation, as it is.
        control: `observer_s`, which the scheme "none" has no use for.
        gain: K of feedback aboard, 0 without; shape (axes, 2).
    """

    def __init__(self, terms: Terms, control: ControlConfig, gain: Array, capacity: int) -> None:
        n = terms.axes
        self.counts: Counter[str] = Counter()
        self._settings = EstimatorSettings(
            laws=laws_of(terms, gain),
            compensate=terms.indexed,
            dt_ns=terms.dt_ns,
            decay=decay_of(terms, control) if terms.indexed else 1.0,
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
            # No older observation is planned from, so no older input is ever asked for.
            inputs=np.zeros((capacity, n, terms.age_max)),
            last=np.full(capacity, -1, dtype=np.int64),
        )
        self.observed_step: Indices = self._memory.observed
        """Step of the newest observation, or -1; shape (capacity,)."""

    def forget(self, row: int) -> None:
        """See `Scheme`."""
        memory = self._memory
        memory.observed[row] = memory.base[row] = memory.last[row] = -1
        memory.disturbance[row] = 0.0
        memory.inputs[row] = 0.0

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`."""
        memory = self._memory
        if observation.step <= memory.observed[row]:
            return False
        memory.observed[row] = observation.step
        memory.state[row] = observation.state
        memory.flown[row] = observation.input
        return True

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """See `Scheme`: planning starts at k, from x̂(k).

        Source: eq. (13).
        """
        _fly_on(self._settings, self._memory, rows, step, found)

    def remember(
        self,
        rows: Indices,
        step: Indices,
        found: Foresight,
        event: Flags,  # noqa: ARG002 - whether sent or not (E12)
    ) -> None:
        """Take û(k) ← u(k|k); steps at which nothing was computed repeat the input before them.

        Source: eq. (12).
        """
        _write_down(self._memory.inputs, self._memory.last, rows, step, found.horizons)


def make(fleet: Fleet) -> HorizonScheme:
    """The scheme "predictive", and "none"."""
    control, gain = fleet.scenario.control, feedback_gain(fleet.scenario)
    return HorizonScheme(Estimator(fleet.terms, control, gain, fleet.capacity), fleet)


KERNELS = (horizons, hierarchical, exact)
"""See `server.schemes.table`."""


@part
def _observe_disturbance(
    settings: EstimatorSettings, memory: EstimatorMemory, row: int, k: int
) -> None:
    """Disturbance observer: from the observation before to the newest, where there is a new one."""
    begin, end = memory.base[row], memory.observed[row]
    m, near = end - begin, APART_NS // settings.dt_ns
    for i in range(len(settings.laws)):
        axis, velocity, u = (
            settings.laws[i],
            memory.base_velocity[row, i],
            memory.base_flown[row, i],
        )
        # One step at least, where Δt itself is longer than APART_NS.
        if begin >= 0 and 0 < m <= max(1, near):
            w, change = memory.disturbance[row, i], (memory.flown[row, i] - u) / m
            p, v = 0.0, velocity
            for step in range(m):
                # Inputs between two observations are not told: a straight line between both is
                # taken for them.
                p, v = advance(axis, p, v, u + step * change + w)
            off, trip_ns = memory.state[row, i, 1] - v, (k - end) * settings.dt_ns
            memory.disturbance[row, i] = learned(
                w, off, m, axis.a11, settings.decay, trip_ns, axis.bound
            )
        memory.base_velocity[row, i] = memory.state[row, i, 1]
        memory.base_flown[row, i] = memory.flown[row, i]
    memory.base[row] = end


@kernel
def _fly_on(
    settings: EstimatorSettings, memory: EstimatorMemory, rows: I1, steps: I1, found: Foresight
) -> None:
    """Fill in x̂(k) as `estimate` and `start`, ŵ, and the state that feedback leads on from.

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
                    # Steps behind `last`, at which nothing was computed, go on with its input.
                    u = memory.inputs[row, j, min(step, memory.last[row]) % reach]
                    p, v = advance(axis, p, v, u + w)
            found.estimate[i, j, 0], found.estimate[i, j, 1] = p, v
            found.start[i, j, 0], found.start[i, j, 1] = p, v
            found.disturbance[i, j] = w
            if settings.feeds_back:
                feedback = found.feedback[i, j]
                feedback[LED_P], feedback[LED_V], feedback[DISTURBANCE] = p, v, w
                feedback[GAIN_P], feedback[GAIN_V] = axis.gain_p, axis.gain_v


@kernel
def _write_down(inputs: F3, last_step: I1, rows: I1, steps: I1, horizons: S3) -> None:
    """Put the first input of each horizon into the history `inputs`, see `Estimator.remember`.

    Source: eq. (12).
    """
    reach = inputs.shape[2]
    for i in range(len(rows)):
        row, step, last = rows[i], steps[i], last_step[rows[i]]
        if last >= 0:
            for axis in range(horizons.shape[1]):
                held = inputs[row, axis, last % reach]
                for missed in range(max(last + 1, step - reach + 1), step):
                    inputs[row, axis, missed % reach] = held
        for axis in range(horizons.shape[1]):
            inputs[row, axis, step % reach] = horizons[i, axis, 0]
        last_step[row] = step
