"""Planners and solvers beside those that keep vehicles apart."""

import numpy as np
import pytest

from skytether.lab.benchmarks import motions, together
from skytether.lab.benchmarks.motions import MotionsOptions
from skytether.lab.benchmarks.together import ALL, BRAKING, SWAP, TogetherOptions
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.shared.law.motion import SPACING, Motion


def test_a_vehicle_may_brake_from_each_knot_on() -> None:
    """It flies its way up to there, slows down as fast as it may, and rests."""
    T, slower = SPACING * SWAP.control.dt, SPACING * SWAP.control.dt * 0.6
    velocity = np.array([[0.0, 0.0], [0.3, -0.2], [0.5, -0.2], [0.2, 0.0], [0.0, 0.0]])
    moved = np.cumsum(0.5 * T * (velocity[1:] + velocity[:-1]), axis=0)
    motion = Motion(20, np.vstack([np.zeros(2), moved]), velocity)
    found = together.stops(motion, 31)
    assert [len(stop.position) for stop in found] == [5, 5]
    for knot, stop in zip((2, 3), found, strict=True):
        assert stop.first == 20
        assert (stop.velocity[: knot + 1] == velocity[: knot + 1]).all()
        assert (stop.position[: knot + 1] == motion.position[: knot + 1]).all()
        assert (stop.velocity[-1] == 0.0).all()
        assert np.abs(np.diff(stop.velocity[knot:], axis=0)).max() <= slower + 1e-12
        rest = stop.at(np.array([1e3]), SWAP.control.dt)[0]
        assert (rest == stop.position[-1]).all()
    assert together.stops(motion, 60) == []


@pytest.mark.long
def test_vehicles_that_may_brake_anywhere_take_longer() -> None:
    """They block their whole ways for the others; afterwards the usual planner is back."""
    before = MissionPlanner._conflicts
    options = TogetherOptions(vehicles=6, duration=60.0)
    usual, braked = (
        together.fly(options, ("no loss", planner, 1)).arrived_s for planner in (ALL, BRAKING)
    )
    assert usual is not None
    assert braked is not None
    assert braked > 1.2 * usual
    assert MissionPlanner._conflicts is before


def test_solvers_agree_on_the_problems_of_a_flight() -> None:
    """As far as their tolerances go; those that are not installed take no part."""
    table = motions.solvers(MotionsOptions(problems=5, duration=4.0))
    found = {row[0]: float(row[3]) for row in table.rows}
    assert {"ours, dual active set", "OSQP", "DAQP"} <= set(found)
    assert found.pop("ours, dual active set") == 0.0
    # OSQP stops at 1e-4 of its residuals.
    assert max(found.values()) < 0.5
    assert found["DAQP"] == pytest.approx(0.0, abs=1e-2)
