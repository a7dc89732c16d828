"""Desired trajectories x_d(t): position and velocity at any time (E6: the paper has positions).

A reference is a function from time since the epoch [s; any shape] to the desired state
[m, m/s; that shape + (axes, 2)], in the world frame with the third axis up.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from skytether.shared.law.model import Array

FAR_M = 1e6
"""Largest coordinate of a trajectory [m]."""
NORTH_MAX = 85.0
"""Largest latitude of an origin [degrees]."""
FAST_MPS = 1e6
"""Largest velocity along an axis of a trajectory made from points [m/s]."""
GRID_S = 0.05
"""Time between the random velocities of a target; they are interpolated linearly."""
TURN_S = 3600.0
"""Time after which a target's path is run backwards, then forwards again, to bound the memory for
the random walk."""
GRID_BLOCK = 1024
GAINS_MAX = 10_000
"""Largest number of steps until the gains of a filter are taken as steady."""
SAMPLED_S = np.concatenate([0.2347 * np.arange(512), np.geomspace(121.0, 86_400.0, 64)])
"""Times at which a plug-in's trajectory is checked before a flight [s]: dense for two minutes, then
increasingly sparse up to a day. No round numbers, since a trajectory may be special at those."""

Reference = Callable[[NDArray[Any]], Array]


class OfFleet(ABC):
    """Desired trajectories of several vehicles, and one of them as a `Reference`."""

    @property
    @abstractmethod
    def vehicles(self) -> tuple[int, ...]:
        """Numbers of the vehicles."""

    @abstractmethod
    def __call__(self, t: NDArray[Any]) -> Array:
        """See `Reference`."""

    @abstractmethod
    def of(self, vehicle: int) -> Self:
        """The same with another vehicle's as the reference."""

    @abstractmethod
    def allocated(self) -> Self:
        """The same with each vehicle's goals allocated anew."""


def _planar(
    x: Callable[[Array], tuple[Array, Array]],
    y: Callable[[Array], tuple[Array, Array]],
    axes: int,
    altitude_m: float,
) -> Reference:
    """Planar curve from functions of time to (position, velocity) for x and y; altitude is
    constant.
    """

    def sample(t: Array) -> Array:
        t = np.asarray(t, dtype=np.float64)
        state = np.zeros((*t.shape, axes, 2))
        for axis, curve in zip(range(axes), (x, y), strict=False):
            state[..., axis, 0], state[..., axis, 1] = curve(t)
        if axes == 3:
            state[..., 2, 0] = altitude_m
        return state

    return sample


def circle(radius_m: float, period_s: float, axes: int, altitude_m: float = 0.0) -> Reference:
    """Circle around the origin, counter-clockwise, from (radius, 0)."""
    w = 2.0 * np.pi / period_s
    return _planar(
        lambda t: (radius_m * np.cos(w * t), -radius_m * w * np.sin(w * t)),
        lambda t: (radius_m * np.sin(w * t), radius_m * w * np.cos(w * t)),
        axes,
        altitude_m,
    )


def figure_eight(radius_m: float, period_s: float, axes: int, altitude_m: float = 0.0) -> Reference:
    """Gerono's lemniscate: 2 radii wide, 1 radius high, from the crossing."""
    w = 2.0 * np.pi / period_s
    return _planar(
        lambda t: (radius_m * np.sin(w * t), radius_m * w * np.cos(w * t)),
        lambda t: (0.5 * radius_m * np.sin(2.0 * w * t), radius_m * w * np.cos(2.0 * w * t)),
        axes,
        altitude_m,
    )


def timed_path(times_s: Array, points_m: Array, *, loop: bool = False) -> Reference:
    """Path of straight lines between points, each reached at its time.

    Args:
        times_s: rising times, from 0 [s]; shape (n,).
        points_m: points [m]; shape (n, axes).
        loop: start again after the last point; otherwise stay there.

    Raises:
        ValueError: a point is beyond FAR_M, or a speed above FAST_MPS.
    """
    times_s, points_m = np.asarray(times_s, float), np.asarray(points_m, float)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        slopes = np.diff(points_m, axis=0) / np.diff(times_s)[:, None]
    if not ((np.abs(points_m) <= FAR_M).all() and (np.abs(slopes) <= FAST_MPS).all()):
        raise ValueError(f"expected at most {FAR_M:g} m from the origin, and {FAST_MPS:g} m/s")

    def sample(t: Array) -> Array:
        t = np.asarray(t, dtype=np.float64)
        t = np.mod(t, times_s[-1]) if loop else t
        leg = np.clip(np.searchsorted(times_s, t, side="right") - 1, 0, len(slopes) - 1)
        moving = (t >= times_s[0]) & (t < times_s[-1])
        velocity = np.where(moving[..., None], slopes[leg], 0.0)
        clipped = np.clip(t, times_s[0], times_s[-1])
        position = points_m[leg] + slopes[leg] * (clipped - times_s[leg])[..., None]
        return np.stack([position, velocity], axis=-1)

    return sample


def waypoints(points_m: Array, speed_mps: float, *, loop: bool = False) -> Reference:
    """Path through points [m; shape (n, axes)] at constant speed.

    With `loop` it returns to the first point and repeats.

    Raises:
        ValueError: see `timed_path`; or two points are too close to each other.
    """
    points = np.asarray(points_m, dtype=np.float64)
    if loop:
        points = np.concatenate([points, points[:1]])
    lengths_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return timed_path(np.concatenate([[0.0], np.cumsum(lengths_m) / speed_mps]), points, loop=loop)


def square(radius_m: float, period_s: float, axes: int, altitude_m: float = 0.0) -> Reference:
    """Square with corners at (±radius, ±radius), from (radius, -radius), counter-clockwise."""
    corners = np.zeros((4, axes))
    corners[:, :2] = radius_m * np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]])
    corners[:, 2:] = altitude_m
    return waypoints(corners, 8.0 * radius_m / period_s, loop=True)


def hover(point_m: Array) -> Reference:
    point = np.asarray(point_m, dtype=np.float64)

    def sample(t: Array) -> Array:
        t = np.asarray(t, dtype=np.float64)
        state = np.zeros((*t.shape, len(point), 2))
        state[..., 0] = point
        return state

    return sample


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
    origin. After TURN_S its path is run backwards.

    Args:
        rng: generator used by this walk only; later times draw more numbers from it.
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
        """Velocities [m/s] and positions [m] at grid points 0 … last at least;
        each (points, axes).
        """
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

    A Kalman filter with the steady gains K for white acceleration: prediction at constant velocity
    over a step, then x ← x + K (z - p). A state between two steps is predicted from the last one.
    At time 0 the target is known to be at rest.

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
        # 1e-9: rounding errors of a time in steps.
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


def reflected(free: Any, bound: float) -> tuple[Any, Any]:
    """Coordinate reflected at walls at ±bound, and its direction: 1, or -1 if reversed.

    Args:
        free: coordinate without walls; number or array.
    """
    crossed = np.floor((free + bound) / (2.0 * bound))
    way = 1.0 - 2.0 * (crossed % 2.0)
    return way * (free - 2.0 * bound * crossed), way


def sampled(reference: Reference, axes: int) -> bytes:
    """States of a trajectory at SAMPLED_S, rounded to mm and mm/s to be equal on every computer.

    Raises:
        ValueError: the states have a wrong type or shape, or are too large or not finite.
    """
    for times in (np.zeros(()), SAMPLED_S):
        states, shape = np.asarray(reference(times)), (*times.shape, axes, 2)
        if states.shape != shape or states.dtype.kind != "f":
            got = f"{states.dtype.name} of shape {states.shape}"
            raise ValueError(f"got {got} at {times.size} times, expected floats of shape {shape}")
        if not (np.abs(states) <= [FAR_M, FAST_MPS]).all():  # NaN fails too
            raise ValueError(f"expected at most {FAR_M:g} m from the origin, and {FAST_MPS:g} m/s")
    return np.rint(1000.0 * states).astype(np.int64).tobytes()
