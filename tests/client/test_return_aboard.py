"""Return home by the autopilot itself, when the server has been silent for long."""

from typing import Any

import numpy as np
import pytest

from airborne import SAFE, Air
from helpers import packaged
from skytether.autopilot.flavours import FlavourName
from skytether.autopilot.flight import Result
from skytether.client import vehicles
from skytether.shared.base.errors import ConfigError
from skytether.shared.events.aboard import AutopilotRefused, ParametersUnsafe
from skytether.shared.events.flight import ModeChanged
from skytether.shared.wire.protocol import Mode

FENCE = {"low_m": [-8.0, -8.0, 0.5], "high_m": [8.0, 8.0, 6.0], "wind_mps": 0.5}
RETURNS = {"on_loss": "return", "land_after_s": 3.0}
MODE_NAMES = {"ardupilot": "RTL", "px4": "AUTO.RTL"}
LOW: dict[FlavourName, dict[str, float]] = {
    "ardupilot": {"RTL_ALT": 400},
    "px4": {"RTL_RETURN_ALT": 4.0, "RTL_DESCEND_ALT": 4.0},
}
"""Altitudes of the return that fit into the fence."""


def lost(flavour: FlavourName, **keys: Any) -> Air:
    """Vehicle in flight, about 5 m from home, whose server has just died."""
    air = Air(flavour, duration=120.0, fence=FENCE, vehicle=RETURNS, **keys)
    air.fly()
    air.run(20.0, lambda: abs(air.flight.position()[1]) > 2.0)
    assert np.hypot(*air.flight.position()[:2]) > 2.0
    air.world.stop("server")
    return air


def test_a_lost_vehicle_hovers_and_returns_home_inside_its_fence() -> None:
    air = lost("px4", parameters=SAFE["px4"] | LOW["px4"])
    died_ns = air.world.now_ns
    returns_s = air.run(20.0, lambda: air.flight.mode_name == MODE_NAMES["px4"])
    assert [each.after for each in air.of(ModeChanged)][-3:] == ["brake", "hover", "return"]
    assert returns_s == pytest.approx(1.5 + 1.5 + 3.0, abs=1.2)
    quiet_ns = air.world.now_ns + 200_000_000
    air.lands(90.0)
    assert not air.setpoints(quiet_ns)
    assert np.hypot(*air.flight.position()[:2]) < 0.7
    rows = air.truth.rows()
    places = rows["state"][rows["time_ns"] > died_ns][:, :, 0]
    assert np.abs(places[:, :2]).max() < 8.0
    assert places[:, 2].max() < 6.0
    assert air.mode is Mode.RETURN


def test_a_return_that_the_autopilot_refuses_ends_in_landing() -> None:
    """For example without a home: four seconds later it is commanded to land where it is."""
    air = lost("ardupilot", parameters=SAFE["ardupilot"] | LOW["ardupilot"])
    switch = air.flight.switch
    air.flight.switch = lambda number: Result.FAILED if number == 6 else switch(number)
    air.until(lambda: air.flight.mode_name == "LAND", 30.0)
    assert "failed" in [each.answer for each in air.of(AutopilotRefused)]


def test_a_return_higher_than_the_fence_is_refused(flavour: FlavourName) -> None:
    """Nothing is armed: by default ArduCopter returns at 15 m, and PX4 at 60 m."""
    air = Air(flavour, fence=FENCE, vehicle=RETURNS)
    air.run(30.0, lambda: air.client.failure is not None)
    assert isinstance(air.client.failure, ParametersUnsafe)
    names = {each.name for each in air.client.failure.parameters}
    assert names == set(LOW[flavour])
    assert "fence.high_m" in str(air.client.failure)


def test_a_return_is_lowered_where_parameters_may_be_set(flavour: FlavourName) -> None:
    air = Air(flavour, fence=FENCE, vehicle=RETURNS, sets=True)
    air.run(30.0, lambda: bool(air.flight.armed))
    assert air.flight.armed
    scale = 100.0 if flavour == "ardupilot" else 1.0
    for name in LOW[flavour]:
        assert air.flight.parameters[name] == pytest.approx(5.0 * scale)


def test_vehicles_of_a_mission_land_straight_down() -> None:
    with pytest.raises(ConfigError, match=r"vehicle.on_loss: .*vertical landing"):
        packaged("swap", vehicle={"on_loss": "return"})


def test_only_a_vehicle_that_can_return_is_told_to() -> None:
    """A simulated vehicle cannot, nor one whose home is outside the fence."""
    flown = packaged("demo", {}, {"vehicle": {"on_loss": "return"}})
    with pytest.raises(ConfigError, match=r"vehicle.on_loss: .*cannot return by itself"):
        vehicles.make(flown, 1)
    beside = {"low_m": [1.0, -9.0, 0.5], "high_m": [9.0, 9.0, 9.0]}
    reference = {"shape": "hover", "points_m": [[5.0, 0.0, 3.0]]}
    with pytest.raises(ConfigError, match=r"vehicle.on_loss: .*home \(0, 0\) is outside"):
        Air("ardupilot", fence=beside, vehicle=RETURNS, reference=reference)
