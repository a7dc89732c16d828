"""Uplink delay compensator, eq. (11): which input to fly now, from a horizon made earlier.

Here is which horizon is in force: that of the newest generation wins, in whatever order they arrive
(E11). What is flown by it is in `client.followers`. Without a horizon the input that was flown last
is braked along, and from a standstill that is hovering.
"""

import numpy as np
from numpy.typing import NDArray

from skytether.client.followers import Constants, Follower, HorizonFollower, SplineFollower
from skytether.shared.law.model import Array
from skytether.shared.law.rule import lasting, late_max
from skytether.shared.law.terms import Terms
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import NO_HORIZON, Horizon, Trajectory

FOREVER = 2**30
"""Stages for which a place is held: none come after."""


class Compensator:
    """Holds the newest horizon and reads the input of any step from it.

    Args:
        terms: the rule of flight.
        regulator: K and λ by which the vehicle flies along a spline, see
            `shared.scenario.gain.regulator`; shape (axes, 3).
            Horizons of inputs bring theirs along.
    """

    def __init__(self, terms: Terms, regulator: Array | None = None) -> None:
        self._terms = terms
        regulator = np.zeros((terms.axes, 3)) if regulator is None else regulator
        self._constants = Constants.of(terms, regulator)
        self._H, self._age_max, self._join = terms.horizon, terms.age_max, terms.join
        self._late_max, self._brake = late_max(terms.horizon), terms.brake
        self.begins = 0
        """Step of stage 0: that which the horizon was made for, or that at which it was dropped."""
        self.follower: Follower = self._braking(np.zeros(terms.axes))
        """What is flown by; without a horizon the input that was flown when it was dropped."""
        self._chosen = 0
        """Step chosen for last."""
        self.in_force = NO_HORIZON
        """Step that the horizon was made for, k_h, or NO_HORIZON."""
        self.newest = NO_HORIZON
        """Step that the newest horizon so far was made for, whether or not it is still held."""
        self.since = 0
        """First step that the horizon was chosen for."""
        self._new = False
        self.observed = -1
        """Step of the observation that the horizon was computed from, or -1."""
        self.covered = False
        """Whether the horizon has an input for the step chosen for last; without one the vehicle
        hovers, brakes, or holds the last."""
        self.stale = 0
        """Number of horizons that came after a newer one, or once more."""
        self.repeated = 0
        """Number of times that the horizon in force came once more: the server may not know."""

    def offer(self, horizon: Horizon | Trajectory, step: int, observed: int) -> bool:
        """Take a horizon that came before the input of a step is chosen, unless a newer has come.

        Args:
            horizon: what arrived.
            step: k, the step whose input is chosen next.
            observed: step of the observation that the horizon was planned from.

        Returns:
            Whether it is held now.

        Raises:
            ProtocolError: it is made for a time so far ahead that nothing later could replace it,
                from an observation that was not made yet, or too long ago for any of its inputs,
                or so long after its committed steps that other inputs were flown meanwhile, or it
                is a motion of a mission whose first knot is yet to come.
        """
        if horizon.step > step + self._H:
            raise ProtocolError(Drop.FROM_THE_FUTURE)
        # Newest generation wins, whatever comes last (E11).
        if horizon.step <= self.newest:
            self.stale += 1
            self.repeated += horizon.step == self.in_force
            return False
        # Without compensation the one input lasts for as long as its observation is young enough.
        given = self._age_max + self._H
        if self._terms.indexed and isinstance(horizon, Horizon):
            given = horizon.inputs.shape[1]
        length = lasting(given, horizon.step, observed, self._age_max)
        if not 0 <= observed < step:
            raise ProtocolError(Drop.OBSERVATION)
        if length < 1:
            raise ProtocolError(Drop.TOO_OLD)
        if self._join and horizon.step > step:
            # The server takes the vehicle's clock for further on than it is: before its first knot
            # the motion is not the one in force, and would be a leap.
            raise ProtocolError(Drop.TOO_EARLY)
        is_late = bool(self._join) and step - horizon.step > self._join
        if is_late or self._comes_too_late(step - horizon.step, given - self._H, length):
            raise ProtocolError(Drop.TOO_LATE)
        if isinstance(horizon, Trajectory):
            self.go_on_along(horizon.step, observed, horizon.spacing, horizon.knots)
            return True
        self._put_in_force(horizon.step, observed)
        feedback = horizon.feedback if horizon.feedback.size else None
        self.follower = HorizonFollower(self._constants, horizon.inputs, length, feedback)
        return True

    def go_on_along(
        self, made_for: int, observed: int, spacing: int, knots: NDArray[np.float32]
    ) -> None:
        """Put a spline in force: a new one, or one that an earlier run of this client has accepted.

        Args:
            made_for: step of the first knot.
            observed: step of the observation that it was planned from.
            spacing: steps from one knot to the next.
            knots: position [m] and velocity [m/s] of each; shape (axes, knots, 2).
        """
        self._put_in_force(made_for, observed)
        length = lasting(self._age_max + self._H, made_for, observed, self._age_max)
        self.follower = SplineFollower(self._constants, knots, spacing, length)

    def _put_in_force(self, made_for: int, observed: int) -> None:
        """Make a horizon the one in force, from the step on whose input is chosen next."""
        self.in_force = self.newest = self.begins = made_for
        self._new = True
        self.observed = observed

    def drop(self, step: int, flown_last: Array) -> None:
        """Drop the horizon; what was flown last is braked along, however often this is called.

        Args:
            step: the step that was flown last.
            flown_last: its input [m/s]; shape (axes,).
        """
        self.in_force, self.observed = NO_HORIZON, -1
        self._new = self.covered = False
        self.begins, self.follower = step, self._braking(flown_last)

    def _braking(self, flown: Array) -> HorizonFollower:
        """A horizon of one input, which is over: the rule of flight brakes along it."""
        return HorizonFollower(self._constants, flown[:, None], 1)

    def rest(self, step: int, state: Array) -> None:
        """Hold the present place until a horizon comes, or what is held is dropped.

        Args:
            step: k, the step whose input is chosen next.
            state: position [m] and velocity [m/s] of each axis; shape (axes, 2).
        """
        self.begins, knot = step, np.zeros((len(state), 1, 2))
        knot[:, 0, 0] = state[:, 0]
        self.follower = SplineFollower(self._constants, knot, 1, FOREVER)

    @property
    def rests(self) -> bool:
        """Whether a place is held."""
        return self.in_force == NO_HORIZON and isinstance(self.follower, SplineFollower)

    def _comes_too_late(self, stage: int, committed: int, length: int) -> bool:
        """Whether a horizon that would come into force at a stage is of no use any more.

        Args:
            stage: where in the horizon the step is.
            committed: number of its inputs that were committed, d.
            length: number of its inputs that may be flown.
        """
        ended = bool(self._brake) and stage >= length  # braking is not begun anew
        return ended or (self._terms.commits and stage > committed + self._late_max)

    def choose(
        self, step: int, state: Array, disturbance: Array, before: Array
    ) -> tuple[list[float], list[float]]:
        """Input u* for `step` on each axis, and what of it is told, without the feedback [m/s].

        Args:
            step: k, never smaller than before.
            state, disturbance, before: see `Follower.input_at`.

        Source: eq. (11).
        """
        if self._new:
            self.since, self._new = step, False
        self._chosen, self.covered = step, self._covers(step)
        flown, told = self.follower.input_at(
            step - self.begins, state, disturbance, before
        ).tolist()
        return flown, told

    def _covers(self, step: int) -> bool:
        """Whether the horizon has an input for a step."""
        return self.in_force != NO_HORIZON and step - self.begins < self.follower.length

    def foresee(self, states: Array, flown: Array | None = None) -> Array:
        """State of each axis a step after the one chosen for last, see `Follower.foresee`."""
        return self.follower.foresee(self._chosen - self.begins, states, flown)
