"""Nominal motion of a vehicle: the plan that a trajectory is made from where the server sees ahead.

It is the MPC of eq. (9) for an undisturbed vehicle, from where it is led at step k along the
desired trajectory, as far as the server sees that, within the bounds of the input, eq. (6). Its
states are what the vehicle is told to follow, so a trajectory asks for nothing that the vehicle
cannot fly: it begins to turn before a turn that is too sharp, and smooths one that is not worth the
effort.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.control.exact import Workspace, active_set, workspace
from skytether.server.control.law import advance, axis_at
from skytether.server.control.mpc import FIRST, MPC, gradient, lead, make_mpc
from skytether.shared.base.kernel import F1, F2, F3, I1, part
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig


class Nominal(NamedTuple):
    """The problem, and what is remembered of every vehicle to begin the next search with."""

    mpc: MPC
    """The problem of eq. (9), without S-term."""
    work: Workspace
    """Scratch of the solver."""
    inputs: F3
    """Inputs planned last [m/s]; shape (capacity, axes, H)."""
    step: I1
    """Step that they were planned at, or -1; shape (capacity,)."""
    gradient: F1
    """Scratch; shape (H,)."""
    drift: F2
    """Scratch; shape (H, 2)."""
    found: F1
    """Scratch: inputs in the making [m/s]; shape (H,)."""


def make_nominal(terms: Terms, control: ControlConfig, capacity: int) -> Nominal:
    """The problem of a scenario, for up to `capacity` vehicles."""
    mpc, H = make_mpc(terms, control), terms.horizon
    return Nominal(
        mpc=mpc,
        work=workspace(mpc),
        inputs=np.zeros((capacity, terms.axes, H)),
        step=np.full(capacity, -1, dtype=np.int64),
        gradient=np.zeros(H),
        drift=np.zeros((H, 2)),
        found=np.zeros(H),
    )


@part
def plan_nominal(nominal: Nominal, row: int, k: int, desired: F3, states: F3) -> bool:
    """Fill in the nominal states of a vehicle from k on; False where no plan is found.

    Args:
        row: of the vehicle.
        desired: states from k on [m, m/s]; shape (axes, H + 1 or more, 2).
        states: what is filled in, behind the first stage, which is where the vehicle is led at k
            [m, m/s]; shape (axes, H + 1 or fewer, 2).
    """
    mpc, drift, g, u = nominal.mpc, nominal.drift, nominal.gradient, nominal.found
    gap, H = k - nominal.step[row], len(u)
    fresh = nominal.step[row] < 0 or not 0 <= gap <= H
    nominal.step[row] = -1
    for axis in range(len(states)):
        model, before = axis_at(mpc.model, axis), nominal.inputs[row, axis]
        p, v = states[axis, 0, 0], states[axis, 0, 1]
        target = desired[axis, : H + 1]
        lead(mpc, axis, (p, v), 0.0, target, drift)
        gradient(mpc, axis, FIRST, 0.0, target, before, gap, fresh, drift, g)
        if active_set(mpc, axis, FIRST, nominal.work, g, before, gap, fresh, u) <= 0:
            return False
        for stage in range(H):
            before[stage] = u[stage]
        for stage in range(states.shape[1] - 1):
            p, v = advance(model, p, v, u[stage])
            states[axis, stage + 1, 0], states[axis, stage + 1, 1] = p, v
    nominal.step[row] = k
    return True
