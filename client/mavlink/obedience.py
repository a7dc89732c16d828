"""Obedience: whether the vehicle follows its commands, allowing for errors of the model.

The commanded velocity u of an axis gives two bounds of the real velocity, low and high:

    high(t) = max(g u of the last θ + 0.3 s, each with an error of a quarter;  high(t - Δt) - a Δt)

and low likewise: a vehicle may follow at once, or as slowly as with a = 1 m/s² and 0.3 s later than
its dead time θ. A velocity outside these bounds by more than

    1 m/s + fence.wind_mps

over all axes, for 0.1 s, is explained neither by wind nor by model errors: somebody else commands
the autopilot, or it has failed. `python -m pytest tests/client/test_rivals_aboard.py` flies both
autopilots in wind and turbulence, with models wrong by 30 % and 20 %, without a false alarm.
"""

import math
from collections import deque

from skytether.client.positions import Vector
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.scenario.schema import Scenario

LATER_NS = 300 * MILLISECOND_NS
"""Time by which an input may act later than the model's dead time."""
ERROR = 0.25
SLOW_MPS2 = 1.0
"""Acceleration of the slowest vehicle [m/s²]."""
MARGIN_MPS = 1.0
"""Deviation of velocity allowed in calm air."""
NOTICED_NS = 100 * MILLISECOND_NS
"""Time for which the deviation has to be larger."""
QUIET_NS = SECOND_NS
"""Time without a large deviation after which the vehicle counts as obedient again."""
COMMANDS_MAX = 256


class Obedience:
    """Compares one vehicle's velocity with its commands."""

    def __init__(self, scenario: Scenario) -> None:
        terms, axes = scenario.terms(), 3 - scenario.model.axes
        self._gain = (*terms.gain, *(1.0,) * axes)
        self._late_ns = seconds_to_ns(max(terms.dead_time_s)) + LATER_NS
        self._margin = MARGIN_MPS + scenario.fence.wind_mps
        self._commands: deque[tuple[int, Vector]] = deque(maxlen=COMMANDS_MAX)
        self._low = self._high = [0.0, 0.0, 0.0]
        self._stepped_ns: int | None = None
        self._outside_ns: int | None = None
        """Time since which the velocity has been outside the bounds; None while it is inside."""
        self._strayed_ns: int | None = None
        """Newest time at which the velocity had been outside for NOTICED_NS; None if it never had
        been."""
        self.off_mps = 0.0
        """Newest distance of the velocity from its bounds [m/s]."""

    def begin(self) -> None:
        """Start again after somebody else has flown the vehicle."""
        self._commands.clear()
        self._stepped_ns = self._outside_ns = self._strayed_ns = None

    def step(self, command: Vector, velocity: Vector, *, now_ns: int) -> None:
        """Compare a velocity with the commands, both in our axes [m/s].

        `command` applies from now on.
        """
        before_ns, self._stepped_ns = self._stepped_ns, now_ns
        self._commands.append((now_ns, command))
        while now_ns - self._commands[0][0] > self._late_ns and len(self._commands) > 1:
            self._commands.popleft()
        if before_ns is None:
            self._low, self._high = list(velocity), list(velocity)
        slower = SLOW_MPS2 * (now_ns - (before_ns or now_ns)) / SECOND_NS
        off = []
        for axis, v in enumerate(velocity):
            steady = [self._gain[axis] * past[axis] for _, past in self._commands]
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
        return self._strayed_ns is not None and now_ns - self._strayed_ns <= QUIET_NS
