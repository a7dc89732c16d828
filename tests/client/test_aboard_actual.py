"""What actual autopilots were seen to do, shown by the scripted ones."""

import pytest

from airborne import Air, modes
from skytether.autopilot.flavours import FlavourName

BOTH: tuple[FlavourName, ...] = ("ardupilot", "px4")


# -- the clock --------------------------------------------------------------------------------


@pytest.mark.parametrize("ppm", [-20_000.0, -8600.0, 20_000.0])
def test_a_clock_that_runs_up_to_2_percent_wrong_is_followed(ppm: float) -> None:
    """PX4's own simulator runs 0.86 % slow: its positions are used from first to last."""
    air = Air("px4", autopilot_ppm=ppm, duration=25.0)
    air.fly()
    air.end()
    told = air.figures()
    assert sum(told["dropped"].values()) < 10, told
    assert told["drift_ppm"] == pytest.approx(-ppm, rel=0.03)
    assert not [mode for mode in modes(air) if mode[0] == "brake"]
