"""Desired trajectory as far as the server knows it: the window of desired states for a plan.

The plan at step k covers the steps from k + d to k + d + H. `reference.preview` limits how far
ahead the server may look: with "all" it sees the whole window, otherwise nothing after the step k +
preview. Later states are extrapolated from the last visible state at its velocity; the states of a
moving target are also reflected at the bounds of its region (docs/schemes.md lists rejected
alternatives). For a point that an operator moves in flight (`live`), only the present state is
known; this state is the same for all vehicles.

The plan of a vehicle with a dead time θ starts from the state in which its next input takes effect
(`shared.law.dead_time`), and so follows the trajectory shifted by θ on each axis.

Trajectories are computed once, in pages, and then looked up at each step. A vehicle with its own
trajectory has its own pages.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from skytether.shared.base.kernel import F1, F4, I1, inline, kernel, plain, shared
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario import reference
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.schema import Scenario
from skytether.shared.wire.protocol import ahead_max

PAGE = 128
"""Number of steps of a desired trajectory in a page."""
PAGES = 256
"""Number of slots for pages; a block of vehicles needs fewer pages at once."""
EMPTY = -1
"""Key of an empty slot."""
FOUND = -1
"""Result of `_find` if the pages of all vehicles are stored."""
TRAJECTORY = 2**40
"""Stride between keys of trajectories: page p of trajectory t has the key t * TRAJECTORY + p."""
SPREAD = 31
"""Distance between the slots of the first pages of successive trajectories, modulo PAGES; odd, so
that these slots differ."""
TINY = 1e-9
"""Rounding tolerance of a quotient such as 0.15 / 0.05."""

reflected = shared(reference.reflected)


class Window(NamedTuple):
    """Desired states of a block of vehicles at their steps k + d … k + d + H."""

    states: F4
    """Desired states [m, m/s]; shape (slots, axes, stages, 2)."""
    place: I1
    """Slot of each vehicle's states; shape (block,)."""
    first: I1
    """Index of the stage at step k + d within its slot; shape (block,)."""


class Outlook(NamedTuple):
    reach: I1
    rest_s: F1
    """Part of the dead time that exceeds the preview [s]; shape (axes,)."""


class Desired:
    """Desired trajectories of all vehicles, as far as the server may see them.

    Args:
        block: largest number of vehicles in one call.
        references: trajectory of each vehicle, by its number; None: the scenario's trajectory.
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
        longest = ahead_max(terms) + H
        late_s = np.array(terms.dead_time_s)
        self._point: Any = None
        """`LivePoint` that all vehicles follow; None unless the reference's shape is `live`."""
        if wanted.shape == "live":
            module = load("skytether.server.planning.moving_setpoint", "reference.shape live")
            self._point = module.live_point(scenario)
        self._all = wanted.preview == "all" and self._point is None
        self._reach = H
        """Number of steps that a page stores beyond its own PAGE steps: H, or the visible steps if
        the preview is limited."""
        if not self._all:
            seen_s = 0.0 if self._point or isinstance(wanted.preview, str) else wanted.preview
            # TINY, because 0.15 / 0.05 is 2.9999999999999996.
            self._reach = min(int(seen_s / terms.dt_s + TINY), longest)
        seen_s = self._reach * terms.dt_s
        self._ahead_s = late_s if self._all else np.minimum(late_s, seen_s)
        """Part of the dead time by which the states of a page are shifted [s]; shape (axes,)."""
        left = (seen_s - self._ahead_s) / terms.dt_s + TINY
        self._outlook = Outlook(left.astype(np.int64), late_s - self._ahead_s)
        left_min = H if self._all else int(self._outlook.reach.min())
        self.seen = max(min(left_min, H), 0)
        """Number of steps after k that are visible on every axis, H at most."""
        self._bound_m = wanted.radius_m if wanted.shape == "target" else np.inf
        """Coordinate at which the extrapolation is reflected [m]."""
        self._references = references
        self._shared = scenario.make_reference()
        self._number = np.zeros(capacity, dtype=np.int64)
        self._dt_s = terms.dt_s
        self._steps = np.arange(PAGE + self._reach + 1)
        self._axes, self._late, shifts = axes, bool(late_s.any()), bool(self._ahead_s.any())
        # With a dead time a page has two sets of rows: states shifted by it, and unshifted states.
        rows = 2 * axes if shifts else axes
        pages = (1, axes, 1, 2) if self._point else (PAGES, rows, len(self._steps), 2)
        self._pages = np.zeros(pages)
        """Desired states in each slot [m, m/s]; for a live point only its present state."""
        self._at_once = np.zeros(block, dtype=np.int64)
        """Zeros, passed as d to get states from step k on; shape (block,)."""
        self._keys = np.full(PAGES, EMPTY, dtype=np.int64)
        """Key of the page stored in each slot, or EMPTY; shape (PAGES,)."""
        self._found = Window(
            self._pages, np.zeros(block, dtype=np.int64), np.zeros(block, dtype=np.int64)
        )
        """Visible desired states, given by slots and stages."""
        self._foreseen = Window(
            np.zeros((block, axes, H + 1, 2)),
            np.arange(block),
            np.zeros(block, dtype=np.int64),
        )
        """Extrapolated states; not used if everything is visible."""

    def assign(self, row: int, vehicle: int) -> None:
        self._number[row] = vehicle if self._references else 0

    def number(self, row: int) -> int:
        return int(self._number[row])

    def move(self, position: Array | None, velocity: Array | None, now_ns: int) -> None:
        """Move a live point, see `LivePoint.move`; position None leaves the point where it is."""
        if self._point:
            position = self._point.at(now_ns)[:, 0] if position is None else position
            self._point.move(position, velocity, now_ns)

    def tick(self, now_ns: int) -> None:
        if self._point:
            self._pages[0, :, 0] = self._point.at(now_ns)

    def now(self, rows: Indices, steps: Indices) -> Array:
        """Desired states at the steps k of vehicles [m, m/s]; shape (n, axes, 2)."""
        pages, place, first = self._find(rows, steps, self._at_once)
        n = len(rows)
        states: Array = pages[place[:n], -self._axes :, first[:n]]
        return states

    def due(self, rows: Indices, steps: Indices) -> Array:
        """Desired states at the steps k plus the dead time, at which inputs of step k take effect;
        see `now`.
        """
        if not self._late:
            return self.now(rows, steps)
        return self.states(rows, steps, np.zeros(len(rows), dtype=np.int64))[:, :, 0]

    def window(self, rows: Indices, steps: Indices, ahead: Indices) -> Window:
        """Desired states from k + d on, valid until the next call; `ahead`: d of each vehicle."""
        if self._all:
            return self._find(rows, steps, ahead)
        visible = self._find(rows, steps, self._at_once)
        window = self._foreseen.states
        _foresee(visible, len(rows), ahead, self._outlook, self._dt_s, self._bound_m, window)
        return self._foreseen

    def states(self, rows: Indices, steps: Indices, ahead: Indices) -> Array:
        """Copy of the desired states of `window` [m, m/s]; shape (n, axes, H + 1, 2)."""
        states, place, first = self.window(rows, steps, ahead)
        n, stages = len(rows), np.arange(self._foreseen.states.shape[2])
        selected: Array = states[place[:n, None], : self._axes, first[:n, None] + stages]
        return selected.transpose(0, 2, 1, 3)

    def _find(self, rows: Indices, steps: Indices, ahead: Indices) -> Window:
        if self._point:
            return self._found
        keys = self._keys
        while (i := _find(keys, self._number, rows, steps, ahead, self._found)) != FOUND:
            # The search of `_slot` ends at an empty slot. So before the last empty slot is used,
            # all pages are dropped. A block of vehicles needs half of PAGES at most.
            if np.count_nonzero(keys == EMPTY) == 1:
                keys[:] = EMPTY
            number, page = int(self._number[rows[i]]), int(steps[i] + ahead[i]) // PAGE
            sample = self._references(number) if self._references else self._shared
            at = plain(_slot)(keys, number, page)
            times_s = (page * PAGE + self._steps) * self._dt_s
            states = sample(times_s).transpose(1, 0, 2)
            # Without a dead time both slices are the same rows, written twice.
            self._pages[at, : self._axes] = self._pages[at, -self._axes :] = states
            for axis in np.flatnonzero(self._ahead_s):
                self._pages[at, axis] = sample(times_s + self._ahead_s[axis])[:, axis]
            keys[at] = number * TRAJECTORY + page
        return self._found


@inline
def _slot(keys: I1, number: int, page: int) -> int:
    """Slot of a page, or an empty slot for it; at least one slot must be EMPTY."""
    at, key = (page + SPREAD * number) % PAGES, number * TRAJECTORY + page
    while keys[at] != key and keys[at] != EMPTY:
        at = (at + 1) % PAGES
    return at


@kernel
def _find(keys: I1, numbers: I1, rows: I1, steps: I1, ahead: I1, found: Window) -> int:
    """Fill in slots and stages from k + d on; return the first vehicle without a page, or FOUND."""
    for i in range(len(rows)):
        step = steps[i] + ahead[i]
        number, page = numbers[rows[i]], step // PAGE
        at = _slot(keys, number, page)
        if keys[at] == EMPTY:
            return i
        found.place[i], found.first[i] = at, step - page * PAGE
    return FOUND


@inline
def _extrapolated(p: float, v: float, after_s: float, bound_m: float) -> tuple[float, float]:
    """Position [m] and velocity [m/s] after a time, reflected at ± bound_m."""
    p += v * after_s
    if abs(p) <= bound_m:
        return p, v
    p, sign = reflected(p, bound_m)
    return p, sign * v


@kernel
def _foresee(
    visible: Window, n: int, ahead: I1, outlook: Outlook, dt_s: float, bound_m: float, window: F4
) -> None:
    """Fill in the windows of vehicles: the visible states, then extrapolated states.

    Args:
        visible: slots and stages of the desired states from k on, used up to k + reach.
        ahead: d of each vehicle; shape (block,).
        outlook: visible part of the trajectory.
        bound_m: coordinate at which the extrapolation is reflected [m].
        window: output [m, m/s]; shape (block, axes, H + 1, 2).
    """
    for i in range(n):
        states, first = visible.states[visible.place[i]], visible.first[i]
        for axis in range(window.shape[1]):
            reach, rest_s = outlook.reach[axis], outlook.rest_s[axis]
            for stage in range(window.shape[2]):
                step = ahead[i] + stage
                seen = first + min(step, reach)
                p, v = states[axis, seen, 0], states[axis, seen, 1]
                if step > reach or rest_s > 0.0:
                    p, v = _extrapolated(p, v, max(step - reach, 0) * dt_s + rest_s, bound_m)
                window[i, axis, stage, 0], window[i, axis, stage, 1] = p, v
