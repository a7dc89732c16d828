"""Obedience: whether the vehicle follows its commands, allowing for errors of the model.

The commanded velocity u of an axis gives two bounds of the real velocity, low and high:

    high(t) = max(g u of the last θ + 0.3 s, each with an error of a quarter;  high(t - Δt) - a Δt)

and low likewise. So a vehicle may follow at once, or as slowly as with the acceleration a = 1 m/s²,
0.3 s later than its dead time θ. Wind and model errors explain a velocity outside these bounds up
to a share of D = 1 m/s + fence.wind_mps, over all axes. Beyond that somebody else commands the
autopilot, or the autopilot has failed. The share is smaller if the deviation lasts longer:

    D for 0.1 s;  3/4 D for 3 s;  1/5 D for 5 s while no command has the direction of the motion

Such a vehicle counts as obedient again once the deviation has stayed below 0.15 D for 0.5 s. After
a second deviation within a minute it stays disobedient: the other commander is still active.

`python -m pytest tests/client/test_rivals_aboard.py` flies both autopilots in wind and turbulence,
with models wrong by 30 % and 20 %, without a false alarm. The largest deviations there, on PX4 with
the default of fence.wind_mps, are 1.73 m/s for 0.1 s (allowed: 2.0), 1.30 for 3 s (1.5), and at
rest 0.32 for 5 s (0.4).
"""

import math
from collections import deque

from skytether.client.positions import Vector
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.fence.keys import FenceConfig
from skytether.shared.scenario.schema import Scenario

LATER_NS = 300 * MILLISECOND_NS
"""Time after the model's dead time up to which an input may begin to act [ns]."""
ERROR = 0.25
SLOW_MPS2 = 1.0
"""Acceleration of the slowest vehicle [m/s²]."""
MARGIN_MPS = 1.0
"""Deviation of velocity allowed in calm air [m/s]."""
NOTICED = (
    (1.0, 100 * MILLISECOND_NS, math.inf),
    (0.75, 3 * SECOND_NS, math.inf),
    (0.2, 5 * SECOND_NS, 0.1),
)
"""Rows: share of the allowed deviation, time for which the deviation has to exceed this share [ns],
and largest command in the direction of motion for which the row applies [m/s]."""
CALM_SHARE, QUIET_NS = 0.15, 500 * MILLISECOND_NS
"""Share of the allowed deviation, and time for which the deviation must stay below this share
before the vehicle counts as obedient again."""
AGAIN_NS = 60 * SECOND_NS
"""Time after the end of a disobedience within which a second disobedience is final [ns]."""
COMMANDS_MAX = 256


class Obedience:
    """Compares one vehicle's velocity with its commands."""

    def __init__(self, scenario: Scenario) -> None:
        terms, axes = scenario.terms(), 3 - scenario.model.axes
        self._gain = (*terms.gain, *(1.0,) * axes)
        self._late_ns = seconds_to_ns(max(terms.dead_time_s)) + LATER_NS
        self._margin = MARGIN_MPS + scenario.section(FenceConfig).wind_mps
        self._commands: deque[tuple[int, Vector]] = deque(maxlen=COMMANDS_MAX)
        self._low = self._high = [0.0, 0.0, 0.0]
        self._stepped_ns: int | None = None
        self._outside_ns: list[int | None] = [None] * len(NOTICED)
        """Time since which the deviation has been too large, by row of NOTICED; None if it is
        small."""
        self._restless_ns = 0
        """Newest time at which the deviation was too large for an obedient vehicle [ns]."""
        self.strays = self._is_final = False
        self._ended_ns: int | None = None
        """Time at which the newest disobedience ended; None without one."""
        self.off_mps = 0.0
        """Distance of the newest velocity from the allowed range [m/s]."""

    def begin(self) -> None:
        """Start again after somebody else has flown the vehicle."""
        self.pause()
        self.strays, self._is_final, self._ended_ns = False, False, None

    def pause(self) -> None:
        """Start anew at the next velocity; a disobedient vehicle stays disobedient."""
        self._commands.clear()
        self._stepped_ns, self._outside_ns = None, [None] * len(NOTICED)

    def step(self, command: Vector, velocity: Vector, *, now_ns: int) -> None:
        """Compare a velocity with the commands, both north, east and up [m/s].

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
        self._judge(velocity, now_ns)

    def _judge(self, velocity: Vector, now_ns: int) -> None:
        speed = math.hypot(*velocity) or 1.0
        along = max(
            sum(v * u for v, u in zip(velocity, command, strict=True))
            for _, command in self._commands
        )
        is_noticed = False
        for row, (share, time_ns, along_max) in enumerate(NOTICED):
            if self.off_mps <= share * self._margin or along > along_max * speed:
                self._outside_ns[row] = None
                continue
            since_ns = self._outside_ns[row] = self._outside_ns[row] or now_ns
            is_noticed = is_noticed or now_ns - since_ns >= time_ns
        if self.off_mps > CALM_SHARE * self._margin:
            self._restless_ns = now_ns
        if is_noticed and not self.strays:
            again = self._ended_ns is not None and now_ns - self._ended_ns <= AGAIN_NS
            self.strays, self._is_final = True, again
        elif self.strays and not self._is_final and now_ns - self._restless_ns > QUIET_NS:
            self.strays, self._ended_ns = False, now_ns
