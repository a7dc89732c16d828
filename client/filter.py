"""A Kalman filter aboard: where the vehicle is and how fast, from measurements with noise.

Each axis has the state x = [p, v, w]: position [m], velocity [m/s], and what acts on the vehicle
like an input of its own [m/s], as steady wind and a wrong gain do. The inputs u are known, for the
vehicle flies them itself:

    p, v follow eq. (4) with the input u + w              w(k+1) = w(k)
    P(k+1) = F P(k) Fᵀ + Q                                F: eq. (4) of [p, v, w]

Q is that of white acceleration of the strength q = `sensor.process_noise` over a step, and of a
slow walk of w. Measurements are taken one number after the other, z = h x + noise of the variance
r:

    K = P hᵀ / (h P hᵀ + r)        x ← x + K (z - h x)        P ← P - K h P

so that one that is missing is simply left out. A measurement that is had late tells of the step it
was made at. There the filter stands; the estimate is its state, rolled on to the present with the
inputs that have acted since. A constant error of a sensor it cannot tell from the truth.

The covariance P does not depend on what is measured: axes that are alike share it.
"""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from skytether.client.vehicle import Measurement
from skytether.shared.law.model import Axis, advance, white_acceleration
from skytether.shared.scenario.schema import Scenario

DRIFT = 0.3
"""Strength of the random walk of w as a share of q [1]: w moves by DRIFT q √t in the time t."""
BEGIN_MPS = 1.0, 0.5
"""Standard deviation of the velocity at the begin, where it was not measured, and of w [m/s]."""
# With a variance of 0 the covariance would become singular.
LEAST = 1e-6
"""Smallest standard deviation that a measurement is taken to have [m], [m/s]."""


class Spread(NamedTuple):
    """Covariance P of an axis' [p, v, w]; it is symmetric, and half of it is enough."""

    pp: float
    pv: float
    pw: float
    vv: float
    vw: float
    ww: float


Gain = tuple[float, float, float]
"""Kalman gains K of p, v and w."""


def widened(axis: Axis, P: Spread, noise: Spread) -> Spread:
    """P a step later, F P Fᵀ + Q."""
    pv = P.pv + axis.a01 * P.vv + axis.b0 * P.vw  # of the next p and this v
    pw = P.pw + axis.a01 * P.vw + axis.b0 * P.ww
    vw = axis.a11 * P.vw + axis.b1 * P.ww
    return Spread(
        P.pp + axis.a01 * P.pv + axis.b0 * P.pw + axis.a01 * pv + axis.b0 * pw + noise.pp,
        axis.a11 * pv + axis.b1 * pw + noise.pv,
        pw,
        axis.a11 * (axis.a11 * P.vv + axis.b1 * P.vw) + axis.b1 * vw + noise.vv,
        vw,
        P.ww + noise.ww,
    )


def by_position(P: Spread, variance: float) -> tuple[Gain, Spread]:
    """Gain and P of a measured position."""
    pp, pv, pw, vv, vw, ww = P
    total = pp + variance
    kp, kv, kw = pp / total, pv / total, pw / total
    # (1 - K) P as variance / total · P, for 1 - K loses its digits where the sensor is good.
    left = variance / total
    return (kp, kv, kw), Spread(
        left * pp, left * pv, left * pw, vv - kv * pv, vw - kv * pw, ww - kw * pw
    )


def by_velocity(P: Spread, variance: float) -> tuple[Gain, Spread]:
    """Gain and P of a measured velocity."""
    pp, pv, pw, vv, vw, ww = P
    total = vv + variance
    kp, kv, kw = pv / total, vv / total, vw / total
    left = variance / total
    return (kp, kv, kw), Spread(
        pp - kp * pv, left * pv, pw - kp * vw, left * vv, left * vw, ww - kw * vw
    )


class Kalman:
    """Filter of a scenario's vehicle.

    Args:
        scenario: its model, and what it is told of its sensor.
        delay: how old a measurement is when it is had [steps].
    """

    def __init__(self, scenario: Scenario, delay: int) -> None:
        terms, sensor = scenario.terms(), scenario.sensor
        self._model = terms.model.axes()
        # One covariance for axes of the same numbers: it does not depend on what is measured.
        alike = sorted(set(self._model))
        self.kinds = [alike.index(axis) for axis in self._model]
        """Which of the axes that differ each one is like."""
        q, dt = sensor.process_noise, terms.dt_s
        self.noise = []
        for axis in alike:
            tau_s = terms.tau_s[self._model.index(axis)]
            (a, _), (b, c) = (q * white_acceleration(np.array([tau_s]), dt)[0]).tolist()
            walk = (DRIFT * q) ** 2 * dt
            self.noise.append(Spread(a * a, a * b, 0.0, b * b + c * c, 0.0, walk))
        self._alike = alike
        self.variances = (
            max(sensor.position_noise_m, LEAST) ** 2,
            max(sensor.velocity_noise_mps, LEAST) ** 2,
        )
        self.spreads: list[Spread] = []
        """P of each kind of axis; empty before the first measurement."""
        self.x: list[tuple[float, float, float]] = []
        """State of each axis, `delay` steps ago."""
        nothing = [0.0] * terms.axes
        self._acted: deque[tuple[list[float], Sequence[float]]] = deque(
            [(nothing, ())] * delay, delay + 1
        )
        """Inputs that have acted since, see `advance` [m/s]."""
        self._late = [each.late for each in terms.dead_times]

    def begin(self, measured: Measurement) -> None:
        """Take the first measurement, which has a position; the vehicle stands."""
        assert measured.position is not None
        v, w = BEGIN_MPS
        if measured.velocity is not None:
            v = self.variances[1] ** 0.5
        velocity = measured.velocity or [0.0] * len(self._model)
        P = Spread(self.variances[0], 0.0, 0.0, v * v, 0.0, w * w)
        self.spreads = [P] * len(self._alike)
        self.x = [(p, v, 0.0) for p, v in zip(measured.position, velocity, strict=True)]

    def advance(self, due: list[float], swing: Sequence[float] = ()) -> None:
        """Advance by a step, over which these inputs act, see `shared.law.dead_time`.

        Args:
            due: the input that acts at its end, of each axis [m/s].
            swing: by how much more acts at its begin [m/s]; empty without.
        """
        self._acted.append((due, swing))
        inputs, more = self._acted.popleft()
        self.x = [
            (*advance(axis, p, v, u + w), w)
            for axis, (p, v, w), u in zip(self._model, self.x, inputs, strict=True)
        ]
        if more:
            moved = self._swung([(p, v) for p, v, _ in self.x], more)
            self.x = [(p, v, w) for (p, v), (_, _, w) in zip(moved, self.x, strict=True)]
        self.spreads = [
            widened(axis, P, noise)
            for axis, P, noise in zip(self._alike, self.spreads, self.noise, strict=True)
        ]

    def take(self, measured: Measurement) -> None:
        """Take what was measured at the step the filter stands at."""
        for which, (correct, values) in enumerate(
            zip((by_position, by_velocity), measured[1:], strict=True)
        ):
            if values is None:
                continue
            variance = self.variances[which]
            corrected = [correct(P, variance) for P in self.spreads]
            self.spreads = [P for _, P in corrected]
            gains = [corrected[kind][0] for kind in self.kinds]
            self.x = [
                (p + kp * off, v + kv * off, w + kw * off)
                for (p, v, w), (kp, kv, kw), off in (
                    (x, gain, z - x[which])
                    for x, gain, z in zip(self.x, gains, values, strict=True)
                )
            ]

    def estimate(self) -> list[tuple[float, float]]:
        """Position [m] and velocity [m/s] of each axis at the present step."""
        present = [(p, v) for p, v, _ in self.x]
        # From the step of the newest measurement to the present, by what has acted since.
        for inputs, more in self._acted:
            present = [
                advance(axis, p, v, u + w)
                for axis, (p, v), (_, _, w), u in zip(
                    self._model, present, self.x, inputs, strict=True
                )
            ]
            if more:
                present = self._swung(present, more)
        return present

    def _swung(
        self, states: list[tuple[float, float]], swing: Sequence[float]
    ) -> list[tuple[float, float]]:
        """States at the end of a step at whose begin another input acted, see `advance`."""
        axes = zip(states, self._late, swing, strict=True)
        return [(p + late[0] * u, v + late[1] * u) for (p, v), late, u in axes]

    def disturbance(self) -> list[float]:
        """Disturbance w that acts on each axis like an input [m/s]."""
        return [w for _, _, w in self.x]
