"""Obedience: whether a vehicle moves as it is told, by any vehicle not too unlike its model.

What it is told on an axis, u, gives two bounds of the velocity, low and high:

    high(t) = max(g u of the last θ + 0.3 s, each with an error of a quarter;  high(t - Δt) - a Δt)

and low likewise: a vehicle may follow at once, or as slowly as with a = 1 m/s² and 0.3 s later than
its dead time θ says. Whatever is further outside than

    1 m/s + fence.wind_mps

over all axes, for 0.1 s, is no wind and no error of the model: somebody else commands the
autopilot, or it has failed. `python -m pytest tests/client/test_rivals_aboard.py` flies both
autopilots in wind and turbulence, with models wrong by 30 % and 20 %: none is taken for that.
"""

import math
from collections import deque

from skytether.client.mavlink.positions import Vector
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.scenario.schema import Scenario

LATER_NS = 300 * MILLISECOND_NS
"""Time by which an input may act later than the dead time says [ns]."""
ERROR = 0.25
"""Error of the gain."""
SLOW_MPS2 = 1.0
"""Acceleration of the slowest vehicle [m/s²]."""
MARGIN_MPS = 1.0
"""Difference of velocity that is allowed in calm air [m/s]."""
NOTICED_NS = 100 * MILLISECOND_NS
"""Time for which it has to be larger [ns]."""
QUIET_NS = SECOND_NS
"""Time without, after which it obeys again [ns]."""
TOLD_MAX = 256
"""Velocities told that are remembered."""


class Obedience:
    """Watch over one vehicle's velocity.

    Args:
        scenario: its model, and the wind that its fence is to hold in.
    """

    def __init__(self, scenario: Scenario) -> None:
        terms, axes = scenario.terms(), 3 - scenario.model.axes
        self._gain = (*terms.gain, *(1.0,) * axes)
        self._late_ns = seconds_to_ns(max(terms.dead_time_s)) + LATER_NS
        self._margin = MARGIN_MPS + scenario.fence.wind_mps
        self._told: deque[tuple[int, Vector]] = deque(maxlen=TOLD_MAX)
        """Velocities told of late, and when."""
        self._low = self._high = [0.0, 0.0, 0.0]
        self._stepped_ns: int | None = None
        """Time of the newest step; None before any since `begin`."""
        self._outside_ns: int | None = None
        """Time since which the velocity has been outside; None where it is not."""
        self._strayed_ns: int | None = None
        """Newest time at which it had been outside for long enough; None for never."""
        self.off_mps = 0.0
        """Newest difference between the velocity and those that it can have [m/s]."""

    def begin(self) -> None:
        """Begin anew: somebody else has flown the vehicle until now."""
        self._told.clear()
        self._stepped_ns = self._outside_ns = self._strayed_ns = None

    def step(self, told: Vector, velocity: Vector, *, now_ns: int) -> None:
        """Compare what the vehicle does with what it was told.

        Args:
            told: velocity that is told from now on, in our axes [m/s].
            velocity: velocity that it has, in our axes [m/s].
            now_ns: time now.
        """
        before_ns, self._stepped_ns = self._stepped_ns, now_ns
        self._told.append((now_ns, told))
        while now_ns - self._told[0][0] > self._late_ns and len(self._told) > 1:
            self._told.popleft()
        if before_ns is None:
            self._low, self._high = list(velocity), list(velocity)
        slower = SLOW_MPS2 * (now_ns - (before_ns or now_ns)) / SECOND_NS
        off = []
        for axis, v in enumerate(velocity):
            steady = [self._gain[axis] * each[axis] for _, each in self._told]
            wrong = [u + ERROR * abs(u) * way for u in steady for way in (-1.0, 1.0)]
            self._low[axis] = min(*wrong, self._low[axis] + slower)
            self._high[axis] = max(*wrong, self._high[axis] - slower)
            off.append(max(0.0, v - self._high[axis], self._low[axis] - v))
        self.off_mps = math.hypot(*off)
        if self.off_mps <= self._margin:
            self._outside_ns = None
            return
        if self._outside_ns is None:
            self._outside_ns = now_ns
        if now_ns - self._outside_ns >= NOTICED_NS:
            self._strayed_ns = now_ns

    def strays(self, *, now_ns: int) -> bool:
        """Whether the vehicle does not do what it is told."""
        return self._strayed_ns is not None and now_ns - self._strayed_ns <= QUIET_NS
