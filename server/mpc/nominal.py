"""Nominal MPC: its plan becomes the trajectory if the server knows future reference states.

The nominal MPC is the MPC of eq. (9) for an undisturbed vehicle, within the input bounds of eq.
(6). It starts from the reference state at step k, and follows the reference as far as the server
sees it. The vehicle follows the planned states, so a trajectory never exceeds the vehicle's
abilities: it turns early before a sharp corner, and cuts small corners.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.mpc.problem import (
    FIRST,
    MPC,
    column,
    gradient,
    lead,
    make_mpc,
    set_previous,
    set_target,
    simd_batch,
)
from skytether.server.mpc.riccati import RiccatiWorkspace, active_sets, workspace
from skytether.server.planning.compiled import advance, axis_at
from skytether.shared.base.kernel import B1, F3, I1, part
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig


class Nominal(NamedTuple):
    """Problem of the nominal MPC, and the previous plans of all vehicles for warm starts."""

    mpc: MPC
    """Problem of eq. (9), without S-term."""
    work: RiccatiWorkspace
    inputs: F3
    """Latest planned inputs [m/s]; shape (capacity, axes, H)."""
    step: I1
    """Step of the latest plans, or -1; shape (capacity,)."""
    settled: B1
    """Scratch: whether a plan is solved; shape (1,)."""


def make_nominal(terms: Terms, control: ControlConfig, capacity: int) -> Nominal:
    mpc, H = make_mpc(terms, control), terms.horizon
    return Nominal(
        mpc=mpc,
        work=workspace(mpc),
        inputs=np.zeros((capacity, terms.axes, H)),
        step=np.full(capacity, -1, dtype=np.int64),
        settled=np.zeros(1, dtype=np.bool_),
    )


@part
def plan_nominal(nominal: Nominal, row: int, k: int, desired: F3, states: F3) -> bool:
    """Fill in the planned states of a vehicle from k on; return False if the QP is not solved.

    Args:
        desired: states from k on [m, m/s]; shape (axes, H + 1 or more, 2).
        states: output from stage 1 on; stage 0 is input, the reference state at k [m, m/s]; shape
            (axes, H + 1 or fewer, 2).
    """
    mpc, settled, simd = nominal.mpc, nominal.settled, simd_batch(nominal.work.memory)
    gap, H = k - nominal.step[row], nominal.inputs.shape[2]
    fresh = nominal.step[row] < 0 or not 0 <= gap <= H
    nominal.step[row], settled[0] = -1, True
    for axis in range(len(states)):
        model, u = axis_at(mpc.model, axis), nominal.inputs[row, axis]
        p, v = states[axis, 0, 0], states[axis, 0, 1]
        simd.p[0], simd.v[0], simd.w[0] = p, v, 0.0
        set_target(desired[axis, : H + 1], simd, 0)
        set_previous(u, gap, fresh, simd, 0)
        lead(mpc, axis, simd)
        gradient(mpc, axis, FIRST, simd, simd.target_v)
        active_sets(mpc, axis, FIRST, simd, nominal.work.free, settled)
        if not settled[0]:
            return False
        column(simd.inputs, 0, u)
        for stage in range(states.shape[1] - 1):
            p, v = advance(model, p, v, u[stage])
            states[axis, stage + 1, 0], states[axis, stage + 1, 1] = p, v
    nominal.step[row] = k
    return True
