"""Desired trajectory as the server knows it: the window that a vehicle is planned along.

A vehicle at step k is planned for from k + d to k + d + H. How far ahead the server may look is
`reference.preview`: with "all" it sees the whole window, and otherwise nothing behind the step
k + preview. What lies beyond is predicted from the desired state there, which goes on at its
velocity; that of a target turns round at the bounds within which it moves (docs/schemes.md has what
else was tried). Of a point that is moved in flight only the present is known (`live`), and the same
for all vehicles.

A vehicle with a dead time θ is planned for as it will be met by its next input
(`shared.law.dead_time`), and so along the trajectory θ later, on each axis by its own.

A trajectory is looked up in pages rather than computed at each step. Where vehicles have
trajectories of their own, each has pages of its own.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from skytether.server.common.moving_setpoint import LivePoint
from skytether.shared.base.kernel import F1, F4, I1, inline, kernel, plain, shared
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario import reference
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.schema import Scenario
from skytether.shared.wire.protocol import committed_max

PAGE = 128
"""Steps of a desired trajectory in a page."""
PAGES = 256
"""Places for pages: more than a block of vehicles can need at once."""
EMPTY = -1
"""Key of a place that holds no page."""
FOUND = -1
"""Result of a search in which no vehicle's page is missing."""
TRAJECTORY = 2**40
"""Distance between the keys of two trajectories: page p of trajectory t has the key t TRAJECTORY +
p."""
SPREAD = 31
"""Number of places from the first page of a trajectory to that of the next; odd, so that no two
have the same."""
TINY = 1e-9
"""Rounding tolerance of a quotient such as 0.15 / 0.05."""

reflected = shared(reference.reflected)


class Window(NamedTuple):
    """Desired states of a block of vehicles at their steps k + d … k + d + H."""

    states: F4
    """Desired states [m, m/s]; shape (places, axes, stages, 2)."""
    place: I1
    """Place of each vehicle's states; shape (block,)."""
    first: I1
    """Stage in that place that is the step k + d; shape (block,)."""


class Outlook(NamedTuple):
    """Length of a page on each axis; shape (axes,)."""

    reach: I1
    """Steps behind k that are seen."""
    rest_s: F1
    """Time from the last of them to the time that the vehicle is planned for [s]."""


class Desired:
    """The desired trajectory of every vehicle, as far as the server knows it.

    Args:
        scenario: what to fly, and how far ahead the server may look.
        terms: the same, as far as both ends agree on it.
        capacity: number of vehicles there can be.
        block: number of vehicles that are asked for at a time.
        references: the trajectory of each vehicle, by its number; left out: the scenario's for all.
    """

    def __init__(
        self,
        scenario: Scenario,
        terms: Terms,
        capacity: int,
        block: int,
        references: Callable[[int], Reference] | None = None,
    ) -> None:
        axes, H, wanted = terms.axes, terms.horizon, scenario.reference
        longest = committed_max(terms) + H
        late_s = np.array(terms.dead_time_s)
        self._point = _live(scenario) if wanted.shape == "live" else None
        self._all = wanted.preview == "all" and self._point is None
        self._reach = H
        """Steps of a page behind its last; unless all is seen, the steps that are."""
        if not self._all:
            seen_s = 0.0 if self._point or isinstance(wanted.preview, str) else wanted.preview
            # TINY: 0.15 / 0.05 is 2.9999999999999996.
            self._reach = min(int(seen_s / terms.dt_s + TINY), longest)
        seen_s = self._reach * terms.dt_s
        self._ahead_s = late_s if self._all else np.minimum(late_s, seen_s)
        """Time from a step to the state kept for it in a page, on each axis [s]; shape (axes,)."""
        left = (seen_s - self._ahead_s) / terms.dt_s + TINY
        self._outlook = Outlook(left.astype(np.int64), late_s - self._ahead_s)
        left_min = H if self._all else int(self._outlook.reach.min())
        self.seen = max(min(left_min, H), 0)
        """Steps behind k that are seen on every axis, H at most."""
        self._bound_m = wanted.radius_m if wanted.shape == "target" else np.inf
        """Coordinate at which a prediction turns round [m]."""
        self._references = references
        self._shared = scenario.make_reference()
        self._number = np.zeros(capacity, dtype=np.int64)
        """Number of each vehicle's trajectory; shape (capacity,)."""
        self._dt_s = terms.dt_s
        self._steps = np.arange(PAGE + self._reach + 1)
        self._axes, self._late, shifts = axes, bool(late_s.any()), bool(self._ahead_s.any())
        # Pages shifted by a dead time also have rows for the states at the steps themselves.
        rows = 2 * axes if shifts else axes
        pages = (1, axes, 1, 2) if self._point else (PAGES, rows, len(self._steps), 2)
        self._pages = np.zeros(pages)
        """Desired states in each place [m, m/s]; of a live point its present state alone."""
        self._at_once = np.zeros(block, dtype=np.int64)
        """Zeros in place of d, for states from k on; shape (block,)."""
        self._held = np.full(PAGES, EMPTY, dtype=np.int64)
        """Key of the page in each place, or EMPTY; shape (PAGES,)."""
        self._found = Window(
            self._pages, np.zeros(block, dtype=np.int64), np.zeros(block, dtype=np.int64)
        )
        """Place in the pages of the states from a step on."""
        self._foreseen = Window(
            np.zeros((block, axes, H + 1, 2)),
            np.arange(block),
            np.zeros(block, dtype=np.int64),
        )
        """Predicted states; not used where everything is seen."""

    def assign(self, row: int, vehicle: int) -> None:
        """Assign a row to a vehicle, whose trajectory is looked up by its number."""
        self._number[row] = vehicle if self._references else 0

    def number(self, row: int) -> int:
        """Number of the trajectory of the vehicle in a row."""
        return int(self._number[row])

    def move(self, position: Array | None, velocity: Array | None, now_ns: int) -> None:
        """Move a live point, see `LivePoint.move`; any other trajectory stays as it is.

        Without a position it goes on from where it is by then.
        """
        if self._point:
            here = self._point.at(now_ns)[:, 0] if position is None else position
            self._point.move(here, velocity, now_ns)

    def tick(self, now_ns: int) -> None:
        """Take note of the time [ns]: a live point has moved on."""
        if self._point:
            self._pages[0, :, 0] = self._point.at(now_ns)

    def now(self, rows: Indices, steps: Indices) -> Array:
        """Desired states of vehicles at their steps k [m, m/s]; shape (n, axes, 2).

        Args:
            rows: the vehicles, no more than a block; shape (n,).
            steps: k of each; shape (n,).
        """
        pages, place, first = self._find(rows, steps, self._at_once)
        n = len(rows)
        states: Array = pages[place[:n], -self._axes :, first[:n]]
        return states

    def due(self, rows: Indices, steps: Indices) -> Array:
        """Desired states where inputs of the steps k meet vehicles, as `now` without a dead time.

        Args:
            rows: the vehicles, no more than a block; shape (n,).
            steps: k of each; shape (n,).
        """
        if not self._late:
            return self.now(rows, steps)
        return self.states(rows, steps, np.zeros(len(rows), dtype=np.int64))[:, :, 0]

    def window(self, rows: Indices, steps: Indices, ahead: Indices) -> Window:
        """Desired states of vehicles from k + d on, valid until the next are asked for.

        Args:
            rows: the vehicles, no more than a block; shape (n,).
            steps: k of each; shape (n,).
            ahead: d of each; the n vehicles come first.
        """
        if self._all:
            return self._find(rows, steps, ahead)
        found = self._find(rows, steps, self._at_once)
        window = self._foreseen.states
        _foresee(found, len(rows), ahead, self._outlook, self._dt_s, self._bound_m, window)
        return self._foreseen

    def states(self, rows: Indices, steps: Indices, ahead: Indices) -> Array:
        """Desired states of a window, see there, in an array of their own [m, m/s]; shape
        (n, axes, H + 1, 2).
        """
        states, place, first = self.window(rows, steps, ahead)
        n, stages = len(rows), np.arange(self._foreseen.states.shape[2])
        found: Array = states[place[:n, None], : self._axes, first[:n, None] + stages]
        return found.transpose(0, 2, 1, 3)

    def _find(self, rows: Indices, steps: Indices, ahead: Indices) -> Window:
        """Look up desired states from k + d on, and compute the pages that are missing."""
        if self._point:
            return self._found
        held = self._held
        while (i := _find(held, self._number, rows, steps, ahead, self._found)) != FOUND:
            # Each search of `_place` ends at a free place at the latest: before the last one is
            # taken, all pages go. A block of vehicles needs half of PAGES at most.
            if np.count_nonzero(held == EMPTY) == 1:
                held[:] = EMPTY
            number, page = int(self._number[rows[i]]), int(steps[i] + ahead[i]) // PAGE
            sample = self._references(number) if self._references else self._shared
            at = plain(_place)(held, number, page)
            times_s = (page * PAGE + self._steps) * self._dt_s
            states = sample(times_s).transpose(1, 0, 2)
            # Where no axis is late both slices are the same rows, and this writes them twice.
            self._pages[at, : self._axes] = self._pages[at, -self._axes :] = states
            for axis in np.flatnonzero(self._ahead_s):
                self._pages[at, axis] = sample(times_s + self._ahead_s[axis])[:, axis]
            held[at] = number * TRAJECTORY + page
        return self._found


def _live(scenario: Scenario) -> LivePoint:
    """The live point of a scenario, where it is at first."""
    velocity = scenario.reference.velocity_mps
    start = scenario.given_reference()(np.zeros(()))[:, 0]
    return LivePoint(start, np.array(velocity) if velocity else None, scenario.u_max)


@inline
def _place(held: I1, number: int, page: int) -> int:
    """Place of a page, or a free place for it; one place at least must be EMPTY."""
    at, key = (page + SPREAD * number) % PAGES, number * TRAJECTORY + page
    while held[at] != key and held[at] != EMPTY:
        at = (at + 1) % PAGES
    return at


@kernel
def _find(held: I1, numbers: I1, rows: I1, steps: I1, ahead: I1, found: Window) -> int:
    """Fill in where states from k + d on are; the first vehicle whose page is missing, or FOUND."""
    for i in range(len(rows)):
        step = steps[i] + ahead[i]
        number, page = numbers[rows[i]], step // PAGE
        at = _place(held, number, page)
        if held[at] == EMPTY:
            return i
        found.place[i], found.first[i] = at, step - page * PAGE
    return FOUND


@inline
def _led(p: float, v: float, after_s: float, bound_m: float) -> tuple[float, float]:
    """Position [m] and velocity [m/s] some time later, between walls that turn the velocity."""
    p += v * after_s
    if abs(p) <= bound_m:
        return p, v
    p, way = reflected(p, bound_m)
    return p, way * v


@kernel
def _foresee(
    known: Window, n: int, ahead: I1, outlook: Outlook, dt_s: float, bound_m: float, window: F4
) -> None:
    """Fill in the windows of vehicles: what is seen, and what is predicted behind that.

    Args:
        known: where the desired states from k on are; none after k + reach is looked at.
        n: number of vehicles.
        ahead: d of each; shape (block,).
        outlook: how far it is seen.
        dt_s: length of a step [s].
        bound_m: coordinate at which a prediction turns round [m].
        window: what is filled in [m, m/s]; shape (block, axes, H + 1, 2).
    """
    for i in range(n):
        states, first = known.states[known.place[i]], known.first[i]
        for axis in range(window.shape[1]):
            reach, rest_s = outlook.reach[axis], outlook.rest_s[axis]
            for stage in range(window.shape[2]):
                step = ahead[i] + stage
                seen = first + min(step, reach)
                p, v = states[axis, seen, 0], states[axis, seen, 1]
                if step > reach or rest_s > 0.0:
                    p, v = _led(p, v, max(step - reach, 0) * dt_s + rest_s, bound_m)
                window[i, axis, stage, 0], window[i, axis, stage, 1] = p, v
