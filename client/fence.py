"""The fence: a place that the vehicle never leaves, whatever it is told and by whom.

It lies behind everything that chooses an input, and knows the vehicle's own file alone. From the
state z = [p, v] in which the next input will meet it, a vehicle that is told zero drifts on to

    s = p + τ v                 and with the input u, for eq. (1):   ṡ = g u + w

so that s is where it comes to rest, and the inputs lead s as if it had no inertia. At the distance
y = bound - s, u towards the bound may be at most

    φ(y) = y / T                   up to y = b T², and in negative as well: it comes back
           √(2 b (y - b T² / 2))   beyond: as fast as it can still brake from, by b

of which g is taken out. T = τ + 2 Δt: slow enough for a loop whose numbers are a little wrong. The
bounds are drawn in by

    m = 0.06 s · u_max + 1.25 W (T + θ + 0.1 s + Δt)

for the wind W [m/s] that the fence is to hold in, by whose push the vehicle comes to rest beyond
where it was led: a quarter more for a gain of 0.8, and with θ, by how much it may be longer, and a
step for wind that turns before anything can be done about it. Tests hold it to that, with time
constants wrong by 30 %, gains by 20 % and dead times by 0.1 s.
"""

import math
from collections.abc import Sequence

from skytether.shared.scenario.fence import SLOW_STEPS, inner
from skytether.shared.scenario.schema import Scenario

ROUNDING = 1e-9
"""Change of an input that is rounding alone [m/s]."""


class Fence:
    """Fence of a scenario's vehicle.

    Args:
        scenario: of which only the vehicle's own keys, and its model, are used.
    """

    def __init__(self, scenario: Scenario) -> None:
        terms, fence, dt = scenario.terms(), scenario.fence, scenario.control.dt
        self._tau, self._gain = terms.tau_s, terms.gain
        self._T = [tau + SLOW_STEPS * dt for tau in terms.tau_s]
        self._brake = scenario.vehicle.brake_mps2
        self._speed = fence.speed_mps or math.inf
        low, high, self._radius = inner(scenario)
        self._bounds = list(zip(low, high, strict=True))
        self._home: list[float] | None = None
        self.holds = False
        """Whether the input that was asked for last would have led too far."""

    def limited(
        self, wanted: Sequence[float], state: Sequence[tuple[float, float]], u_max: Sequence[float]
    ) -> list[float]:
        """Input that may be flown, of each axis [m/s].

        Args:
            wanted: the input that was chosen, of each axis [m/s].
            state: state in which it will meet the vehicle, of each axis [m, m/s]; the first
                position is home.
            u_max: bound of each axis [m/s].
        """
        # The first state that is known, and not the scenario's start: a real vehicle begins where
        # it stands.
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
        """Input that leads over no bound, of each axis [m/s]."""
        axes = enumerate(zip(self._towards_home(wanted, rest), rest, u_max, strict=True))
        return [self._between(i, u, s, most) for i, (u, s, most) in axes]

    def _towards_home(self, wanted: Sequence[float], rest: Sequence[float]) -> Sequence[float]:
        """Input of which no more leads away from home than may."""
        if self._home is None or math.isinf(self._radius):
            return wanted
        away = [s - home for s, home in zip(rest, self._home, strict=True)]
        distance = math.hypot(*away)
        # Right at home there is no direction that leads away.
        if not distance:
            return wanted
        n = [each / distance for each in away]
        most = self._most(self._radius - distance, max(self._T)) / max(self._gain)
        excess = sum(u * each for u, each in zip(wanted, n, strict=True)) - most
        return [u - max(0.0, excess) * each for u, each in zip(wanted, n, strict=True)]

    def _between(self, axis: int, wanted: float, rest: float, u_max: float) -> float:
        """Input of an axis that leads no further than its bounds allow."""
        (low, high), T, gain = self._bounds[axis], self._T[axis], self._gain[axis]
        least = -self._most(rest - low, T) / gain
        most = self._most(high - rest, T) / gain
        return min(max(min(max(wanted, least), most), -u_max), u_max)

    def _most(self, distance: float, T: float) -> float:
        """Speed φ towards a bound at a distance [m] that may be told [m/s]."""
        b, linear = self._brake, self._brake * T * T
        if distance <= linear:
            return distance / T
        return math.sqrt(2.0 * b * (distance - linear / 2.0))


def _slowed(back: Sequence[float], flown: Sequence[float], speed: float) -> list[float]:
    """Input on the way from one that leads back to one that is too fast, as fast as may be.

    Both lead over no bound, and so nothing between them does: bounds are straight.
    """
    most = math.hypot(*back)
    if most >= speed:
        return [u * speed / most for u in back]
    way = [there - here for here, there in zip(back, flown, strict=True)]
    a = sum(each * each for each in way)
    b = sum(here * each for here, each in zip(back, way, strict=True))
    share = (math.sqrt(b * b + a * (speed * speed - most * most)) - b) / a
    return [here + share * each for here, each in zip(back, way, strict=True)]
