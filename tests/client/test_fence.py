"""Fence: no input leads beyond it, for any error of the model and any wind."""

from typing import Any

import msgspec
import numpy as np
import pytest

from fenced_flights import furthest_m, scenario
from helpers import packaged
from skytether.client.fence import Fence
from skytether.shared.base.errors import ConfigError
from skytether.shared.events.flight import FenceHolds, ModeChanged
from skytether.shared.fence.margins import SLOW_STEPS, inner_bounds
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.wire.protocol import Mode
from skytether.sim.flight import fly


def test_no_input_leads_over_the_fence() -> None:
    """Time constants off by 30 %, gains by 20 %, dead times by 0.1 s, and turning wind."""
    assert max(map(furthest_m, range(12))) <= 0.0


class WithoutMargin(Fence):
    """Fence whose bounds are not reduced by a margin."""

    def __init__(self, flown: Scenario) -> None:
        super().__init__(flown)
        low, high = (each or (np.nan, np.nan) for each in (flown.fence.low_m, flown.fence.high_m))
        self._bounds = list(zip(low, high, strict=True))
        self._radius = flown.fence.radius_m or np.inf


class WithoutForesight(Fence):
    """Fence that checks the present position, not where the vehicle comes to rest."""

    def __init__(self, flown: Scenario) -> None:
        super().__init__(flown)
        self._tau = (0.0, 0.0)


@pytest.mark.parametrize(("fences", "seed"), [(WithoutMargin, 10), (WithoutForesight, 9)])
def test_without_a_guard_the_fence_is_flown_over(fences: type[Fence], seed: int) -> None:
    assert furthest_m(seed, fences=fences) > 0.1


def test_a_flight_that_stays_inside_is_the_same_with_a_fence() -> None:
    free = fly(scenario(duration=15.0)).trace_hash()
    wide = scenario(duration=15.0, fence={"radius_m": 50.0, "speed_mps": 5.0})
    assert fly(wide).trace_hash() == free


def held_back(scheme: str, seed: int) -> Record:
    """Flight in wind with a wrong gain and dead time, against a fence at x = 1 m.

    The demo's circle is 3.1 m wide. The scenario is built directly, without the check of the
    trajectory against the fence.
    """
    rng = np.random.default_rng(seed)
    trigger = "expected_gap(0.05)" if scheme == "trajectory" else "cost_gap(3)"
    wind = rng.uniform(-0.14, 0.14, 2).tolist()
    gain, late_s = rng.uniform(0.8, 1.2, 2).tolist(), rng.uniform(0.0, 0.1)
    unlike = {"gain": gain, "dead_time_s": [late_s], "steady_wind_mps": wind, "wind": 0.0}
    free = scenario(
        control={"scheme": scheme, "trigger": f"{trigger} | silence(1)"}, vehicle=unlike
    )
    bounds = {"low_m": (-9.0, -9.0), "high_m": (1.0, 9.0), "wind_mps": 0.2}
    fence = msgspec.convert(bounds, type(free.fence))
    return fly(msgspec.structs.replace(free, fence=fence, seed=seed))


@pytest.mark.parametrize("scheme", ["committed", "trajectory"])
def test_a_vehicle_whose_server_knows_of_no_fence_is_held_and_says_so(scheme: str) -> None:
    """In every scheme, also with a regulator aboard that counteracts the correction."""
    record = held_back(scheme, seed=1)
    assert record.client["state"][:, 0, 0].max() <= 1.0
    assert record.client["state"][:, 0, 0].min() < -1.0
    assert any(isinstance(each.event, FenceHolds) for each in record.events)


def test_a_vehicle_that_is_slowed_is_not_said_to_be_held_by_its_fence() -> None:
    """In the middle of a wide fence, whose speed limit slows the way onto the figure."""
    slowed = packaged(
        "demo", duration=20.0, fence={"radius_m": 40.0, "speed_mps": 0.65, "wind_mps": 0.2}
    )
    assert not any(isinstance(each.event, FenceHolds) for each in fly(slowed).events)


def test_a_vehicle_that_lands_is_not_said_to_be_held_by_its_fence() -> None:
    blown = packaged(
        "demo",
        duration=60.0,
        fence={"low_m": [-9.0, -9.0], "high_m": [1.0, 9.0], "wind_mps": 0.2},
        reference={"shape": "hover", "points_m": [[0.0, 0.0]]},
        vehicle={"steady_wind_mps": [0.14, 0.0], "wind": 0.0, "land_after_s": 12.0},
        network={"uplink": "constant(0.05) & outage(10, 50)", "downlink": "constant(0.05)"},
    )
    events = [(each.time_ns / 1e9, each.event) for each in fly(blown).events]
    modes = [(t, event.after) for t, event in events if isinstance(event, ModeChanged)]
    (land_s,) = (t for t, after in modes if after == str(Mode.LAND))
    held_s = [t for t, event in events if isinstance(event, FenceHolds)]
    assert held_s
    assert max(held_s) < land_s < 40.0


@pytest.mark.parametrize(
    ("fence", "said"),
    [
        ({"radius_m": 2.0}, r"fence.radius_m.*got 2.*more, because the trajectory needs"),
        ({"low_m": [-9.0, -9.0], "high_m": [1.5, 9.0]}, r"fence.high_m.*higher"),
        ({"low_m": [0.0, -9.0]}, r"fence.low_m.*lower, because the trajectory needs"),
        ({"speed_mps": 0.1, "wind_mps": 0.05}, r"fence.speed_mps.*more, because the trajectory n"),
        ({"low_m": [1.0, 1.0], "high_m": [2.0, 2.0]}, r"fence.high_m.*above fence.low_m"),
        ({"radius_m": 0.5}, r"fence.radius_m.*more than"),
        ({"speed_mps": 0.5}, r"fence.wind_mps.*less than 0.5, the vehicle's speed"),
        ({"low_m": [1.0]}, r"fence.low_m.*2 numbers"),
    ],
)
def test_what_leads_over_the_fence_is_refused(fence: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        scenario(fence=fence)


def test_wind_that_a_weak_vehicle_cannot_fly_against_is_refused() -> None:
    """Its speed is the largest input times the model's gain."""
    with pytest.raises(ConfigError, match=r"fence.wind_mps.*less than 0.8, the vehicle's speed"):
        scenario(fence={"radius_m": 20.0, "wind_mps": 1.0}, model={"u_max": [1.6], "gain": 0.5})


FAR_M = {"low_m": [-9.0, -9.0], "high_m": [9.0, 9.0]}
WEAK = {"gain": [1.25, 0.8]}
"""Gains of the two axes."""


@pytest.mark.parametrize(("squares", "speed"), [(0.1, 0.1), (1.0, 1.0), (2.5, 2.0)])
@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_the_speed_towards_a_bound_lets_the_vehicle_stop(
    way: float, squares: float, speed: float
) -> None:
    """At a distance of so many b T² so many b T, where T = τ + 2 Δt: without τ, a vehicle with a
    large time constant would come too close.
    """
    flown = scenario(fence=FAR_M, model=WEAK)
    terms, (low, high, _) = flown.terms(), inner_bounds(flown)
    T = terms.tau_s[0] + SLOW_STEPS * flown.control.dt
    b, bound = flown.vehicle.brake_mps2, high[0] if way > 0.0 else low[0]
    places = [(bound - way * squares * b * T * T, 0.0), (0.0, 0.0)]
    limited = Fence(flown).limited([way * 99.0, 0.0], places, [99.0, 99.0])
    assert limited == pytest.approx([way * speed * b * T / terms.gain[0], 0.0])


def test_the_radius_is_kept_for_the_strongest_and_slowest_axis_from_where_the_vehicle_began() -> (
    None
):
    flown = scenario(fence={"radius_m": 9.0}, model=WEAK | {"tau_s": [0.4, 0.8]})
    terms, (_, _, radius) = flown.terms(), inner_bounds(flown)
    fence, u_max = Fence(flown), [99.0, 99.0]
    assert fence.limited([1.0, 0.0], [(50.0, 0.0), (0.0, 0.0)], u_max) == [1.0, 0.0]
    assert not fence.holds
    T = max(terms.tau_s) + SLOW_STEPS * flown.control.dt
    near = [(50.0 + radius - 0.1, 0.0), (0.0, 0.0)]
    assert fence.limited([9.0, 0.0], near, u_max) == pytest.approx([0.1 / T / max(WEAK["gain"]), 0])
    assert fence.holds
    fence.limited([-1.0, 0.0], near, u_max)
    assert not fence.holds


def test_the_way_back_inside_is_no_faster_than_the_fence_allows() -> None:
    flown = scenario(fence=FAR_M | {"speed_mps": 1.0, "wind_mps": 0.2})
    limited = Fence(flown).limited([0.0, 0.0], [(30.0, 0.0), (0.0, 0.0)], flown.u_max.tolist())
    assert limited == pytest.approx([-1.0, 0.0])
