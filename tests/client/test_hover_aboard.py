"""A hover without a plan: velocities alone let a vehicle with an autopilot drift."""

from typing import Any

import numpy as np
import pytest

from airborne import BOTH, Air, flying
from skytether.autopilot.flavours import FlavourName
from skytether.client.mavlink.vehicle import MavlinkVehicle
from skytether.shared.wire.protocol import Mode

HOVER_S, SPAN_M = 30.0, 1.0
"""Length of a hover [s], and largest distance between two places in it on an axis [m]. PX4 in its
own simulator, commanded to stand, was 2.6 m from where it had been, and rose by 3.2 m.
"""
OFF_M = 0.3
"""Largest distance of the place that is held from where the vehicle would have come to rest, on an
axis, for ArduCopter [m]."""


def hovering(flavour: FlavourName, seed: int, **table: Any) -> Air:
    """Vehicle that has lost its server while it flew at 2 m/s, and hovers."""
    vehicle = {"land_after_s": 60.0}
    reference = {"period_s": 20.0, "altitude_m": 4.0}
    table = {"duration": 120.0, "seed": seed, "vehicle": vehicle, "reference": reference} | table
    air = flying(flavour, seconds=2.0 + seed, **table)
    air.world.stop("server")
    air.until(lambda: air.mode is Mode.HOVER, 10.0)
    return air


def places(air: Air, seconds: float) -> np.ndarray:
    """True positions in the next seconds [m]; shape (n, 3)."""
    since_ns = air.world.now_ns
    air.run(seconds)
    rows = air.truth.rows()
    return np.array(rows["state"][rows["time_ns"] >= since_ns][:, :, 0])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_hover_holds_its_place(seed: int) -> None:
    air = hovering("px4", seed)
    span = np.ptp(places(air, HOVER_S), axis=0)
    assert air.mode is Mode.HOVER
    assert span.max() < SPAN_M, span


def test_velocities_alone_let_it_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MavlinkVehicle, "drifts", False)
    spans = [np.ptp(places(hovering("px4", seed), HOVER_S), axis=0).max() for seed in (1, 3)]
    assert min(spans) > 2.0 * SPAN_M, spans


@pytest.mark.parametrize("seed", [1, 2])
def test_it_holds_where_it_comes_to_rest(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not called back to where it was when it was told to stand."""
    held = places(hovering("ardupilot", seed), 10.0)
    monkeypatch.setattr(MavlinkVehicle, "drifts", False)
    left = places(hovering("ardupilot", seed), 10.0)
    assert np.abs(held[-1] - left[-1]).max() < OFF_M


@pytest.mark.parametrize("flavour", BOTH)
def test_it_holds_its_place_before_the_first_plan(flavour: FlavourName) -> None:
    air = Air(flavour, duration=60.0)
    air.fly()
    air.world.stop("server")
    air.until(lambda: air.mode is Mode.SYNC, 5.0)
    assert np.ptp(places(air, 8.0), axis=0).max() < SPAN_M


@pytest.mark.parametrize("choice", ["old", "new"])
@pytest.mark.parametrize("hz", [20, 50])
def test_a_frame_that_changes_moves_no_vehicle_that_hovers(choice: str, hz: int) -> None:
    """Its position leaps by 12 m, and an operator chooses a frame while there is no plan."""
    air = flying("px4", "leap@25", duration=120.0, mavlink={"positions_hz": hz})
    air.until(lambda: air.mode is Mode.HOVER, 40.0)
    air.world.stop("server")
    air.run(2.0)
    air.change(vehicle__after_leap=choice)
    span = np.ptp(places(air, 4.0), axis=0)
    assert air.mode in (Mode.HOVER, Mode.BRAKE)
    assert span.max() < SPAN_M, span


def test_a_vehicle_whose_place_is_unknown_is_commanded_to_stand() -> None:
    air = hovering("px4", 1)
    air.run(3.0)
    air.tap.dumb = True
    air.run(1.0)
    since_ns = air.world.now_ns
    air.run(1.0)
    assert air.mode is Mode.HOVER
    sent = air.setpoints(since_ns)
    assert sent
    assert {(each.vx, each.vy, abs(each.vz)) for _, each in sent} == {(0.0, 0.0, 0.0)}
