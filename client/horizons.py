"""Horizons of inputs on the vehicle: whether a horizon may be flown, and its input of each step."""

import numpy as np
from numpy.typing import NDArray

from skytether.client.followers import Constants, HorizonFollower
from skytether.shared.law.terms import COMMITTING, INDEXED
from skytether.shared.wire.protocol import Horizon


def late_max(horizon: int) -> int:
    """Number of steps after the committed ones within which a horizon may still come into force.

    In these steps the vehicle flies other inputs than the horizon has for them. The next plan
    corrects a few such steps; many such steps would make the server's estimate and its plans
    oscillate.
    """
    # With more steps the estimate oscillated until the vehicle flew away
    # (tests/server/test_slow.py).
    return max(2, horizon // 4)


class Horizons:
    """Rules for arriving horizons of inputs, where they differ from the rules for trajectories."""

    def __init__(self, constants: Constants) -> None:
        terms, self._constants = constants.terms, constants
        self._H, self._lasts = terms.horizon, terms.age_max + terms.horizon
        self._indexed, self._commits = terms.scheme in INDEXED, terms.scheme in COMMITTING

    def inputs(self, horizon: Horizon) -> NDArray[np.float32]:
        """Inputs at the stages of a horizon [m/s]; shape (axes, n)."""
        if self._indexed:
            return horizon.inputs
        # Without compensation the first input is flown at every stage (E21).
        return horizon.inputs[:, :1].repeat(self._lasts, axis=1)

    def is_late(self, horizon: Horizon, stage: int) -> bool:
        """Whether a horizon that arrives at this stage is too late: too many steps after its
        committed inputs were flown with other inputs.
        """
        return self._commits and stage > horizon.inputs.shape[1] - self._H + late_max(self._H)

    def follower(self, horizon: Horizon, length: int) -> HorizonFollower:
        """Follower of a horizon; `length`: number of its inputs that may be flown."""
        feedback = horizon.feedback if horizon.feedback.size else None
        return HorizonFollower(self._constants, self.inputs(horizon), length, feedback)
