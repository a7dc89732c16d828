"""Uplink delay compensator, eq. (11): the input of the present step, from a plan made earlier.

Of all plans that arrived, the plan made for the latest step is in force (E11). `client.followers`
computes the input from this plan. Without a plan the vehicle brakes from the last input, or hovers
if it stands still.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from skytether.client.followers import Constants, Follower, HorizonFollower, SplineFollower
from skytether.shared.law.model import Array
from skytether.shared.law.rule import lasting
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.registry import load
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import NO_HORIZON, Horizon, Trajectory

if TYPE_CHECKING:
    from skytether.client.horizons import Horizons

UNENDING = 2**30
"""Number of steps for which a position is held; so many that the hold never ends."""


class Compensator:
    """Keeps the newest plan, and computes the input of each step from this plan.

    Args:
        regulator: K and λ of the feedback along a spline, see `shared.scenario.gain.regulator`;
            shape (axes, 3). Horizons of inputs contain their own feedback.
    """

    def __init__(self, terms: Terms, regulator: Array | None = None) -> None:
        regulator = np.zeros((terms.axes, 3)) if regulator is None else regulator
        self._constants = Constants.of(terms, regulator)
        self._H, self._age_max, self._join = terms.horizon, terms.age_max, terms.join
        self._brake = terms.brake
        self._horizons: Horizons | None = None
        """Horizons of inputs; None with a scheme that sends trajectories."""
        if not terms.splines:
            horizons = load("skytether.client.horizons", f"control.scheme {terms.scheme}")
            self._horizons = horizons.Horizons(self._constants)
        self.begins = 0
        """Step of stage 0: the plan's first step, or the step at which the plan was dropped."""
        self.follower: Follower = self._braking(np.zeros(terms.axes))
        """Follower of the plan in force; without a plan, one that brakes or holds a position."""
        self._chosen = 0
        self.in_force = NO_HORIZON
        """Step that the plan in force was made for, or NO_HORIZON."""
        self.newest = NO_HORIZON
        """Step that the newest plan was made for, even if that plan was dropped since."""
        self.since = 0
        """First step whose input came from the plan in force."""
        self._new = False
        self.observed = -1
        self.covered = False
        """Whether the plan in force has an input for the step of the latest call of `choose`."""
        self.stale = 0
        """Number of plans that arrived after a newer plan, or for a second time."""
        self.repeated = 0
        """Number of times that the plan in force arrived again, because the server did not know
        that the plan had arrived."""

    def offer(self, horizon: Horizon | Trajectory, step: int, observed: int) -> bool:
        """Put a plan in force unless a newer plan has arrived; return whether it is in force now.

        Args:
            horizon: plan received.
            step: k, the next step whose input is chosen.
            observed: step of the observation from which the plan was computed.

        Raises:
            ProtocolError: the plan is too far in the future; its observation is in the future, or
                too old for any input; the plan arrived after its last input was due, or so long
                after its committed inputs that the vehicle has flown too many other inputs; or the
                plan is a mission's motion whose first knot is in the future.
        """
        if horizon.step > step + self._H:
            raise ProtocolError(Drop.FROM_THE_FUTURE)
        # The plan made for the latest step is flown, whatever the order of arrival (E11).
        if horizon.step <= self.newest:
            self.stale += 1
            self.repeated += horizon.step == self.in_force
            return False
        count = self._age_max + self._H
        if self._horizons and isinstance(horizon, Horizon):
            count = self._horizons.inputs(horizon).shape[1]
        length = lasting(count, horizon.step, observed, self._age_max)
        if not 0 <= observed < step:
            raise ProtocolError(Drop.OBSERVATION)
        if length < 1:
            raise ProtocolError(Drop.TOO_OLD)
        if self._join and horizon.step > step:
            # The server estimated a later step than the vehicle's step. Flying the motion before
            # the step of its first knot would make the reference jump.
            raise ProtocolError(Drop.TOO_EARLY)
        is_late = bool(self._join) and step - horizon.step > self._join
        if is_late or self._comes_too_late(horizon, step - horizon.step, length):
            raise ProtocolError(Drop.TOO_LATE)
        if isinstance(horizon, Trajectory):
            self.go_on_along(horizon.step, observed, horizon.spacing, horizon.knots)
            return True
        self._put_in_force(horizon.step, observed)
        assert self._horizons
        self.follower = self._horizons.follower(horizon, length)
        return True

    def go_on_along(
        self,
        made_for: int,
        observed: int,
        spacing: int,
        knots: NDArray[np.float32],
        *,
        since: int | None = None,
    ) -> None:
        """Put a spline in force that has just arrived, or that an earlier run of the client flew.

        Args:
            made_for: step of the first knot.
            observed: step of the observation that the spline was planned from.
            spacing: steps from one knot to the next.
            knots: position [m] and velocity [m/s] of each knot; shape (axes, knots, 2).
            since: first step whose input came from the spline in the earlier run; None: new spline.
        """
        self._put_in_force(made_for, observed)
        if since is not None:
            self.since, self._new = since, False
        length = lasting(self._age_max + self._H, made_for, observed, self._age_max)
        if self._join:
            # A mission's motion is flown to its last knot, even if its observation is then too old:
            # other vehicles avoid exactly this motion, to its end.
            length = max(length, spacing * (knots.shape[1] - 1) + 1)
        self.follower = SplineFollower(self._constants, knots, spacing, length)

    def _put_in_force(self, made_for: int, observed: int) -> None:
        self.in_force = self.newest = self.begins = made_for
        self._new = True
        self.observed = observed

    def drop(self, step: int, flown_last: Array) -> None:
        """Drop the plan, and brake from `flown_last`, the input of `step` [m/s]."""
        self.in_force, self.observed = NO_HORIZON, -1
        self._new = self.covered = False
        self.begins, self.follower = step, self._braking(flown_last)

    def _braking(self, flown: Array) -> HorizonFollower:
        """Follower that brakes from the input `flown`: it follows a horizon with this one input."""
        return HorizonFollower(self._constants, flown[:, None], 1)

    def rest(self, step: int, state: Array) -> None:
        """Hold the present position until a plan arrives or `drop` is called.

        Args:
            step: k, the next step whose input is chosen.
            state: position [m] and velocity [m/s] of each axis; shape (axes, 2).
        """
        self.begins, knot = step, np.zeros((len(state), 1, 2))
        knot[:, 0, 0] = state[:, 0]
        self.follower = SplineFollower(self._constants, knot, 1, UNENDING)

    @property
    def last_step(self) -> int:
        """Step of the last knot of the spline in force, or NO_HORIZON."""
        flown = self.follower
        if self.in_force == NO_HORIZON or not isinstance(flown, SplineFollower):
            return NO_HORIZON
        return self.begins + flown.last

    @property
    def rests(self) -> bool:
        return self.in_force == NO_HORIZON and isinstance(self.follower, SplineFollower)

    def _comes_too_late(self, horizon: Horizon | Trajectory, stage: int, length: int) -> bool:
        """Whether a plan arrives too late to be flown.

        Args:
            stage: stage of the plan at the present step.
            length: number of its stages that may be flown.
        """
        if self._brake and stage >= length:  # a plan after its end would only restart the braking
            return True
        if self._horizons is None or isinstance(horizon, Trajectory):
            return False
        return self._horizons.is_late(horizon, stage)

    def choose(
        self, step: int, state: Array, disturbance: Array, before: Array
    ) -> tuple[list[float], list[float]]:
        """Inputs u* of a step with and without feedback, on each axis [m/s]; see
        `Follower.input_at`.

        `step` never decreases.

        Source: eq. (11).
        """
        if self._new:
            self.since, self._new = step, False
        self._chosen = step
        self.covered = self.in_force != NO_HORIZON and step - self.begins < self.follower.length
        flown, without_feedback = self.follower.input_at(
            step - self.begins, state, disturbance, before
        ).tolist()
        return flown, without_feedback

    def flown_since(self, step: int) -> int:
        """First step with an input from the plan in force; `step`: the next step to be flown."""
        return step if self._new else self.since

    def foresee(self, states: Array, flown: Array | None = None) -> Array:
        """State of each axis one step after the latest call of `choose`, see `Follower.foresee`."""
        return self.follower.foresee(self._chosen - self.begins, states, flown)
