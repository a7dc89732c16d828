"""Fence: a region that the vehicle never leaves, independent of the server and of plans.

The fence acts after all other limits and choices of the input, and uses only the vehicle's own
scenario. From the state z = [p, v] in which the next input will take effect, a vehicle with zero
input drifts on to

    s = p + τ v                 and with the input u, by eq. (1):   ṡ = g u + w

So s is where the vehicle would come to rest, and inputs move s as if there were no inertia. At the
distance y = bound - s, the speed of s towards the bound is limited to

    φ(y) = y / T                   for y ≤ b T²; negative y gives a negative speed, back inside
           √(2 b (y - b T² / 2))   beyond: from this speed it can still stop with deceleration b

and the input to φ / g. T = τ + 2 Δt is slow enough for a loop whose parameters are slightly wrong.
The bounds are moved inwards by

    m = 0.06 s · u_max + 1.25 W (T + θ + 0.1 s + Δt)

where W [m/s] is the wind in which the fence must hold: wind pushes the vehicle beyond the point to
which the input leads. The factor 1.25 covers a true gain that is 20 % too small; 0.1 s covers an
error in the dead time θ; Δt covers wind that changes before the next input. Tests check that the
fence holds with time constants wrong by 30 %, gains by 20 % and dead times by 0.1 s.
"""

import math
from collections.abc import Sequence

from skytether.shared.fence.keys import FenceConfig
from skytether.shared.fence.margins import SLOW_STEPS, inner_bounds
from skytether.shared.scenario.schema import Scenario

ROUNDING = 1e-9
"""Largest change of an input that is attributed to rounding [m/s]."""


class Fence:
    def __init__(self, scenario: Scenario) -> None:
        terms, fence, dt = scenario.terms(), scenario.section(FenceConfig), scenario.control.dt
        self._tau, self._gain = terms.tau_s, terms.gain
        self._T = [tau + SLOW_STEPS * dt for tau in terms.tau_s]
        self._brake = scenario.vehicle.brake_mps2
        self._speed = fence.speed_mps or math.inf
        low, high, self._radius = inner_bounds(scenario)
        self._bounds = list(zip(low, high, strict=True))
        self._home: list[float] | None = None
        self.holds = False
        """Whether a bound on the position limited the latest input. The bound on the speed,
        `fence.speed_mps`, does not count."""

    def limited(
        self, wanted: Sequence[float], state: Sequence[tuple[float, float]], u_max: Sequence[float]
    ) -> list[float]:
        """See `client.clamp.Guard`."""
        # Home is the first known position: a real vehicle may start elsewhere than the scenario
        # says.
        self._home = self._home or [p for p, _ in state]
        rest = [p + tau * v for (p, v), tau in zip(state, self._tau, strict=True)]
        flown = self._inside(wanted, rest, u_max)
        self.holds = math.dist(flown, wanted) > ROUNDING
        if math.hypot(*flown) > self._speed:
            back = self._inside([0.0] * len(flown), rest, u_max)
            flown = _slowed(back, flown, self._speed)
        return flown

    def _inside(
        self, wanted: Sequence[float], rest: Sequence[float], u_max: Sequence[float]
    ) -> list[float]:
        axes = enumerate(zip(self._towards_home(wanted, rest), rest, u_max, strict=True))
        return [self._between(i, u, s, most) for i, (u, s, most) in axes]

    def _towards_home(self, wanted: Sequence[float], rest: Sequence[float]) -> Sequence[float]:
        if self._home is None or math.isinf(self._radius):
            return wanted
        away = [s - home for s, home in zip(rest, self._home, strict=True)]
        distance = math.hypot(*away)
        if not distance:
            return wanted
        n = [part / distance for part in away]
        most = self._most(self._radius - distance, max(self._T)) / max(self._gain)
        excess = sum(u * part for u, part in zip(wanted, n, strict=True)) - most
        return [u - max(0.0, excess) * part for u, part in zip(wanted, n, strict=True)]

    def _between(self, axis: int, wanted: float, rest: float, u_max: float) -> float:
        (low, high), T, gain = self._bounds[axis], self._T[axis], self._gain[axis]
        least = -self._most(rest - low, T) / gain
        most = self._most(high - rest, T) / gain
        return min(max(min(max(wanted, least), most), -u_max), u_max)

    def _most(self, distance: float, T: float) -> float:
        """Largest speed φ [m/s] towards a bound at a distance [m]."""
        b, linear = self._brake, self._brake * T * T
        if distance <= linear:
            return distance / T
        return math.sqrt(2.0 * b * (distance - linear / 2.0))


def _slowed(back: Sequence[float], flown: Sequence[float], speed: float) -> list[float]:
    """Input with the magnitude `speed`, between the input `back`, which leads back inside, and the
    input `flown`, which is too fast.

    The bounds allow both inputs and are convex, so they allow all inputs between these two.
    """
    most = math.hypot(*back)
    if most >= speed:
        return [u * speed / most for u in back]
    change = [fast - slow for slow, fast in zip(back, flown, strict=True)]
    a = sum(part * part for part in change)
    b = sum(slow * part for slow, part in zip(back, change, strict=True))
    share = (math.sqrt(b * b + a * (speed * speed - most * most)) - b) / a
    return [slow + share * part for slow, part in zip(back, change, strict=True)]
