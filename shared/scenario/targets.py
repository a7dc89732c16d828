"""Target: a random walk that the vehicle has to follow, and noisy measurements of its positions."""

import numpy as np

from skytether.shared.base.chance import stream
from skytether.shared.law.model import Array
from skytether.shared.scenario.reference import Reference, reflected
from skytether.shared.scenario.registry import REFERENCES
from skytether.shared.scenario.schema import Scenario

GRID_S = 0.05
"""Time between random velocities of a target [s]; between them the velocity changes linearly."""
TURN_S = 3600.0
"""Time after which a target follows its path backwards, then forwards again [s]. The turn bounds
the memory for the random walk."""
GRID_BLOCK = 1024
GAINS_MAX = 10_000
"""Largest number of steps until the gains of a filter count as steady."""


def target(
    rng: np.random.Generator,
    axes: int,
    *,
    agility: float,
    speed_mps: float,
    radius_m: float,
    turn_every_s: float = 0.0,
) -> Reference:
    """Random walk from the origin, by white acceleration or by random turns.

    Velocity and position are reflected at their bounds. Before time 0 the target is at rest at the
    origin. After TURN_S the target follows its path backwards.

    Args:
        rng: generator used by this walk only; states at later times draw more numbers.
        agility: strength of the white acceleration [m/s per √s].
        speed_mps: largest velocity along an axis [m/s].
        radius_m: largest coordinate [m].
        turn_every_s: mean time between two turns [s]; the velocity then changes at turns only,
            by as much as the white acceleration would have changed it since the last turn. 0:
            no turns.
    """
    walk = _Walk(rng, axes, turn_every_s)

    def sample(t: Array) -> Array:
        t = np.maximum(np.asarray(t, dtype=np.float64), 0.0)
        legs = np.floor(t / TURN_S)
        back = np.mod(legs, 2.0)
        t = np.where(back, (legs + 1.0) * TURN_S - t, t - legs * TURN_S)
        velocities, positions = walk.upto(
            int(t.max(initial=0.0) / GRID_S) + 1, agility=agility, speed_mps=speed_mps
        )
        at = (t / GRID_S).astype(np.int64)
        after = (t - at * GRID_S)[..., None]
        v, rise = velocities[at], (velocities[at + 1] - velocities[at]) / GRID_S
        p = positions[at] + after * (v + 0.5 * after * rise)
        position, way = reflected(p, radius_m)
        way *= 1.0 - 2.0 * back[..., None]
        return np.stack([position, way * (v + after * rise)], axis=-1)

    return sample


class _Walk:
    """Velocity and position of a target on a time grid of GRID_S, drawn on demand."""

    def __init__(self, rng: np.random.Generator, axes: int, turn_every_s: float) -> None:
        self._rng = rng
        self._turns = min(GRID_S / turn_every_s, 1.0) if turn_every_s else 1.0
        """Probability of a turn at a grid point."""
        self._free = np.zeros((1, axes))
        self._velocities = np.zeros((1, axes))
        self._positions = np.zeros((1, axes))

    def upto(self, last: int, *, agility: float, speed_mps: float) -> tuple[Array, Array]:
        """Velocities [m/s], positions [m] at grid points 0 … last or more; shape (points, axes)."""
        while len(self._free) <= last:
            kicks = self._rng.standard_normal((GRID_BLOCK, self._free.shape[1]))
            if self._turns < 1.0:
                turned = self._rng.random((GRID_BLOCK, 1)) < self._turns
                kicks *= turned / np.sqrt(self._turns)
            free = self._free[-1] + np.cumsum(agility * np.sqrt(GRID_S) * kicks, axis=0)
            v, _ = reflected(np.concatenate([self._free[-1:], free]), speed_mps)
            p = self._positions[-1] + np.cumsum(0.5 * GRID_S * (v[:-1] + v[1:]), axis=0)
            self._free = np.concatenate([self._free, free])
            self._velocities = np.concatenate([self._velocities, v[1:]])
            self._positions = np.concatenate([self._positions, p])
        return self._velocities, self._positions


class Measured:
    """States of a target as estimated from its positions, measured with noise at every step.

    A Kalman filter with the steady gains K for white acceleration estimates the states: it predicts
    one step at constant velocity, then x ← x + K (z - p). A state between two steps is predicted
    from the earlier step. At time 0 the target is known to be at rest.

    Args:
        target: true states.
        rng: generator used by this noise only.
        dt_s: length of a step [s].
        noise_m: standard deviation of the noise of each coordinate [m], above 0.
        agility: strength of the white acceleration [m/s per √s].
    """

    def __init__(
        self,
        target: Reference,
        rng: np.random.Generator,
        *,
        dt_s: float,
        noise_m: float,
        agility: float,
    ) -> None:
        self._target, self._rng = target, rng
        self._dt_s, self._noise_m = dt_s, noise_m
        self._gains = _steady_gains(dt_s, noise_m, agility)
        self._states = target(np.zeros(1))

    def __call__(self, t: Array) -> Array:
        t = np.maximum(np.asarray(t, dtype=np.float64), 0.0)
        # 1e-9 covers the rounding error of the quotient.
        steps = np.floor(t / self._dt_s + 1e-9).astype(np.int64)
        self._estimate_until(int(steps.max(initial=0)))
        states = self._states[steps]
        states[..., 0] += states[..., 1] * (t - steps * self._dt_s)[..., None]
        return states

    def _estimate_until(self, last: int) -> None:
        first = len(self._states)
        if last < first:
            return
        steps = np.arange(first, first + max(last + 1 - first, GRID_BLOCK))
        positions = self._target(steps * self._dt_s)[..., 0]
        noisy = positions + self._noise_m * self._rng.standard_normal(positions.shape)
        estimated, (k_p, k_v) = np.empty((*noisy.shape, 2)), self._gains
        p, v = self._states[-1, :, 0], self._states[-1, :, 1]
        for i, z in enumerate(noisy):
            p = p + v * self._dt_s
            p, v = p + k_p * (z - p), v + k_v * (z - p)
            estimated[i, :, 0], estimated[i, :, 1] = p, v
        self._states = np.concatenate([self._states, estimated])


def _steady_gains(dt_s: float, noise_m: float, agility: float) -> tuple[float, float]:
    """Gains of position and velocity [1, 1/s] in the steady state of the filter of `Measured`."""
    F = np.array([[1.0, dt_s], [0.0, 1.0]])
    Q = agility**2 * np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]])
    P, gain = Q, np.zeros(2)
    for _ in range(GAINS_MAX):
        before, gain = gain, P[:, 0] / (P[0, 0] + noise_m**2)
        if np.abs(gain - before).max() <= 1e-12:
            break
        P = F @ (P - np.outer(gain, P[0])) @ F.T + Q
    return float(gain[0]), float(gain[1])


@REFERENCES(name="target")
def flown_target(scenario: Scenario) -> Reference:
    """Random walk that only the server knows, by `agility`, `speed_mps` and `radius_m`."""
    config = scenario.reference
    return target(
        stream(scenario.seed, "target"),
        scenario.model.axes,
        agility=config.agility,
        speed_mps=config.speed_mps,
        radius_m=config.radius_m,
        turn_every_s=config.turn_every_s,
    )
