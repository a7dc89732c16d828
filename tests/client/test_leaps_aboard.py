"""Jumps of an autopilot's position: reported in metres, hovered through, decided by a person."""

from typing import Any

import numpy as np
import pytest

from airborne import Air, flying
from skytether.autopilot.faults import LEAP
from skytether.shared.base.errors import ConfigError
from skytether.shared.events.flight import ModeChanged, StateLeapt
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.protocol import Mode

FENCE = {"low_m": [-8.0, -8.0, 0.5], "high_m": [8.0, 8.0, 9.0], "wind_mps": 0.5}


def leapt() -> Air:
    """Vehicle in flight whose reported position has just jumped by 12 m."""
    slow = {"axes": 3, "tau_s": [0.5, 0.5, 0.25], "u_max": [1.5]}
    air = flying("ardupilot", seconds=2.0, duration=90.0, fence=FENCE, model=slow)
    air.flight.displaced = LEAP
    air.run(2.0, lambda: bool(air.of(StateLeapt)))
    return air


def place(air: Air) -> Any:
    return np.array(air.flight.position()[:2])


def test_a_leap_is_told_in_metres_and_pushes_nobody() -> None:
    """The fence is 8 m wide and the jump 12 m; the vehicle brakes where it is, and hovers."""
    air = leapt()
    began = place(air)
    (event,) = air.of(StateLeapt)
    assert event.by_m == pytest.approx(LEAP, abs=0.1)
    air.run(6.0)
    assert air.mode is Mode.HOVER
    # Braking from 1.5 m/s at 2 m/s², plus dead time and inertia.
    assert np.linalg.norm(place(air) - began) < 2.0
    hovered = place(air)
    air.run(1.0)
    assert np.linalg.norm(place(air) - hovered) < 0.05


def test_without_a_choice_it_lands_and_arming_again_is_none() -> None:
    air = leapt()
    air.change(armed=False)
    air.run(3.0)
    with pytest.raises(ConfigError, match=r"armed: .*leapt by \(-12.*vehicle.after_leap"):
        air.change(armed=True)
    lands_s = 3.0 + air.run(30.0, lambda: air.mode is Mode.LAND)
    assert lands_s == pytest.approx(1.0 + 10.0 + 1.0, abs=1.0)
    last = air.of(ModeChanged)[-1]
    assert (last.after, last.reason) == ("land", str(Reason.LEAPT))


@pytest.mark.long
def test_a_choice_flies_on_in_the_frame_that_was_chosen() -> None:
    """In the new frame, figure and fence move by the jump."""
    air = leapt()
    air.change(armed=False)
    air.run(3.0)
    air.change(armed=True, vehicle__after_leap="new")
    air.until(lambda: air.mode is Mode.TRACK, 5.0)
    air.run(16.0)
    assert air.mode is Mode.TRACK
    estimate = air.rows()["estimate"][-1, :2, 0]
    np.testing.assert_allclose(estimate, place(air) + LEAP[:2], atol=0.2)
    times = air.rows()["step"][-1] * air.scenario.control.dt
    wanted = air.scenario.make_reference()(np.array(times))[:2, 0]
    assert np.linalg.norm(estimate - wanted) < 1.5


def test_the_next_leap_asks_again() -> None:
    air = leapt()
    air.run(2.0)
    air.change(vehicle__after_leap="old")
    air.run(3.0)
    assert air.mode is Mode.TRACK
    air.flight.displaced = (0.0, 0.0, 0.0)
    air.run(2.0)
    assert [each.by_m[0] for each in air.of(StateLeapt)] == pytest.approx([-12.0, 12.0], abs=0.1)
    assert air.mode is Mode.HOVER


def test_nothing_is_chosen_before_a_leap() -> None:
    air = Air("ardupilot")
    with pytest.raises(ConfigError, match=r"vehicle.after_leap: .*before its position has leapt"):
        air.change(vehicle__after_leap="old")
    with pytest.raises(ConfigError, match=r"vehicle.after_leap: .*chosen in flight"):
        Air("ardupilot", vehicle={"after_leap": "old"})


def test_the_chosen_frame_is_that_of_the_origin() -> None:
    """The operator's origin, kept over a restart, includes the choice."""
    air = leapt()
    air.change(vehicle__after_leap="old")
    assert air.flies.port.autopilot.positions.origin == pytest.approx(LEAP, abs=0.1)
    again = leapt()
    again.change(vehicle__after_leap="new")
    assert again.flies.port.autopilot.positions.origin == pytest.approx((0.0, 0.0, 0.0), abs=0.05)
