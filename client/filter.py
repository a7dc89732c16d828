"""Kalman filter aboard: position and velocity from noisy measurements.

Each axis has the state x = [p, v, w]: position [m], velocity [m/s], and a disturbance that acts
like an additional input [m/s], such as steady wind or a wrong gain. The inputs u are known exactly:

    p, v follow eq. (4) with the input u + w              w(k+1) = w(k)
    P(k+1) = F P(k) Fᵀ + Q                                F: eq. (4) of [p, v, w]

Q is that of white acceleration of strength q = `sensor.process_noise` over a step, and of a slow
random walk of w. Measurements are processed one number at a time, z = h x + noise of variance r:

    K = P hᵀ / (h P hᵀ + r)        x ← x + K (z - h x)        P ← P - K h P

so a missing number is simply skipped. If measurements arrive late, the filter's state is that of
the step at which they were made, and the estimate is this state predicted to the present with the
inputs flown since. A constant sensor error cannot be detected.

The covariance P does not depend on the measured values.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from skytether.client.vehicle import Measurement
from skytether.shared.base.compilable import Numbers, Table, compilable
from skytether.shared.law.model import Array, Axis, advance, white_acceleration
from skytether.shared.scenario import rooms
from skytether.shared.scenario.schema import Scenario

DRIFT = 0.3
"""Strength of the random walk of w relative to q: in a time t, w changes by DRIFT q √t (RMS)."""
BEGIN_MPS = 1.0, 0.5
"""Initial standard deviations of the velocity, if it was not measured, and of w [m/s]."""
# A variance of 0 would make the covariance singular.
LEAST = 1e-6
"""Smallest standard deviation assumed for a measurement [m], [m/s]."""


class Spread(NamedTuple):
    """Covariance P of [p, v, w] of an axis: its upper triangle."""

    pp: float
    pv: float
    pw: float
    vv: float
    vw: float
    ww: float


Gain = tuple[float, float, float]
"""Kalman gains K of p, v and w."""


def widened(axis: Axis, P: Spread, noise: Spread) -> Spread:
    """Covariance P one step later, F P Fᵀ + Q."""
    pv = P.pv + axis.a01 * P.vv + axis.b0 * P.vw  # covariance of the next p and the present v
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
    pp, pv, pw, vv, vw, ww = P
    total = pp + variance
    kp, kv, kw = pp / total, pv / total, pw / total
    # 1 - kp = variance / total: computed by division, as the difference loses digits near kp = 1.
    share = variance / total
    return (kp, kv, kw), Spread(
        share * pp, share * pv, share * pw, vv - kv * pv, vw - kv * pw, ww - kw * pw
    )


def by_velocity(P: Spread, variance: float) -> tuple[Gain, Spread]:
    pp, pv, pw, vv, vw, ww = P
    total = vv + variance
    kp, kv, kw = pv / total, vv / total, vw / total
    share = variance / total
    return (kp, kv, kw), Spread(
        pp - kp * pv, share * pv, pw - kp * vw, share * vv, share * vw, ww - kw * vw
    )


@compilable
def advanced(x: Table, P: Table, model: Table, noise: Table, inputs: Numbers) -> None:
    """Advance all axes by a step, in place.

    Args:
        x: state [p, v, w] of each axis; shape (axes, 3).
        P: covariance of each axis, rows of `Spread`.
        model: rows of `Axis`.
        noise: Q of each axis, rows of `Spread`.
        inputs: input that acts during the step, of each axis [m/s].
    """
    for i in range(len(x)):
        axis = Axis(model[i, 0], model[i, 1], model[i, 2], model[i, 3])
        x[i, 0], x[i, 1] = advance(axis, x[i, 0], x[i, 1], inputs[i] + x[i, 2])
        _write(P, i, widened(axis, _spread(P, i), _spread(noise, i)))


@compilable
def corrected(
    x: Table,
    P: Table,
    measured: Table,
    has_position: bool,
    has_velocity: bool,
    variance_p: float,
    variance_v: float,
) -> None:
    """Correct all axes by a measurement, in place.

    Args:
        x, P: see `advanced`.
        measured: positions [m] and velocities [m/s]; shape (2, axes).
        variance_p, variance_v: variances of position [m²] and velocity [m²/s²].
    """
    for i in range(len(x)):
        spread = _spread(P, i)
        if has_position:
            (kp, kv, kw), spread = by_position(spread, variance_p)
            off = measured[0, i] - x[i, 0]
            x[i, 0], x[i, 1], x[i, 2] = x[i, 0] + kp * off, x[i, 1] + kv * off, x[i, 2] + kw * off
        if has_velocity:
            (kp, kv, kw), spread = by_velocity(spread, variance_v)
            off = measured[1, i] - x[i, 1]
            x[i, 0], x[i, 1], x[i, 2] = x[i, 0] + kp * off, x[i, 1] + kv * off, x[i, 2] + kw * off
        _write(P, i, spread)


def _spread(table: Table, i: int) -> Spread:
    return Spread(table[i, 0], table[i, 1], table[i, 2], table[i, 3], table[i, 4], table[i, 5])


def _write(table: Table, i: int, spread: Spread) -> None:
    table[i, 0], table[i, 1], table[i, 2] = spread.pp, spread.pv, spread.pw
    table[i, 3], table[i, 4], table[i, 5] = spread.vv, spread.vw, spread.ww


class Kalman:
    """Kalman filter of a scenario's vehicle; a measurement arrives `delay` steps late."""

    def __init__(self, scenario: Scenario, delay: int) -> None:
        terms, sensor = scenario.terms(), scenario.sensor
        axes, q, dt = terms.axes, sensor.process_noise, terms.dt_s
        self._model = terms.model
        self._rows = np.stack(terms.model, -1)
        self._noise = np.zeros((axes, len(Spread._fields)))
        walk = (DRIFT * q) ** 2 * dt
        for axis, tau_s in enumerate(terms.tau_s):
            (a, _), (b, c) = (q * white_acceleration(np.array([tau_s]), dt)[0]).tolist()
            self._noise[axis] = Spread(a * a, a * b, 0.0, b * b + c * c, 0.0, walk)
        self._variances = (
            max(sensor.position_noise_m, LEAST) ** 2,
            max(sensor.velocity_noise_mps, LEAST) ** 2,
        )
        self.P = np.zeros((axes, len(Spread._fields)))
        """Covariance of each axis, rows of `Spread`."""
        self.x = np.zeros((axes, 3))
        """State of each axis, `delay` steps ago; shape (axes, 3)."""
        self._acted: deque[tuple[Array, Array | None]] = deque(
            [(np.zeros(axes), None)] * delay, delay + 1
        )
        """Inputs of the last `delay` steps, see `advance` [m/s]."""
        self._late = np.zeros((axes, 2))
        if any(terms.dead_time_s):
            self._late[:] = [each.late for each in rooms.dead_time().dead_times(terms)]

    def begin(self, measured: Measurement, numbers: Array) -> None:
        """Start from the first measurement, which must have a position; v is 0 if not measured.

        Args:
            measured: the measurement.
            numbers: its positions [m] and velocities [m/s]; shape (2, axes).
        """
        v, w = BEGIN_MPS
        self.x[:] = 0.0
        self.x[:, 0] = numbers[0]
        if measured.velocity is not None:
            v = self._variances[1] ** 0.5
            self.x[:, 1] = numbers[1]
        self.P[:] = Spread(self._variances[0], 0.0, 0.0, v * v, 0.0, w * w)

    def advance(self, due: Array, swing: Array | None = None) -> None:
        """Advance by a step; a dead time may split it between two inputs (`shared.law.dead_time`).

        Args:
            due: input acting at the end of the step, of each axis [m/s].
            swing: input acting at the start of the step minus `due` [m/s]; None without a change.
        """
        self._acted.append((due, swing))
        inputs, more = self._acted.popleft()
        advanced(self.x, self.P, self._rows, self._noise, inputs)
        if more is not None:
            self.x[:, :2] += self._late * more[:, None]

    def take(self, measured: Measurement, numbers: Array) -> None:
        """Correct the state by a measurement that was made at the state's step; arguments as in
        `begin`.
        """
        _, position, velocity = measured
        has_position, has_velocity = position is not None, velocity is not None
        corrected(self.x, self.P, numbers, has_position, has_velocity, *self._variances)

    def estimate(self) -> Array:
        """Position [m] and velocity [m/s] of each axis at the present step; shape (axes, 2)."""
        present = self.x[:, :2].copy()
        # Predict from the state's step to the present, with the inputs that acted since that step.
        for inputs, more in self._acted:
            present = self._model.step(present, inputs + self.x[:, 2])
            if more is not None:
                present += self._late * more[:, None]
        return present

    def disturbance(self) -> Array:
        """Estimated disturbance w of each axis, which acts like an input [m/s]; shape (axes,)."""
        return self.x[:, 2].copy()
