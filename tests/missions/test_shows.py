"""Shows: vehicles that follow timed paths, and keep apart as on any mission."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from skytether.shared.base.errors import ConfigError
from skytether.shared.law.model import Array
from skytether.shared.missions import contradictions, mission
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.sim import flight
from two_vehicles import separation_m

RADIUS_M, ROUND_S, VEHICLES = 3.0, 20.0, 6
FROM_S = 10.0
"""Time at which vehicles have caught up: the path begins before the first motions are flown."""


def ring(vehicles: int = VEHICLES, radius_m: float = RADIUS_M) -> str:
    """Table of vehicles on a ring, which begins to turn after 3 s."""
    rows = ["vehicle,t,x,y"]
    for number in range(vehicles):
        for t in np.arange(0.0, 30.1, 0.25):
            gone_s = t - 4.5 if t >= 6.0 else max(t - 3.0, 0.0) ** 2 / 6.0
            angle = 2.0 * np.pi * (number / vehicles + gone_s / ROUND_S)
            x, y = radius_m * np.cos(angle), radius_m * np.sin(angle)
            rows.append(f"{number + 1},{t},{x:.4f},{y:.4f}")
    return "\n".join(rows)


def scenario(folder: Path, text: str, shape: str = "show", **table: Any) -> Scenario:
    file = folder / "show.csv"
    file.write_text(text)
    base = reading.to_table(reading.load("swap"))
    base["duration"] = 30.0
    base["reference"] |= {"shape": shape, "file": str(file)}
    for section, keys in table.items():
        base[section] |= keys
    return reading.check(base, "show")


def errors_m(scenario: Scenario, flown: Record) -> Array:
    """RMSE of each vehicle from its path, from FROM_S on [m]."""
    errors = []
    for number in range(1, VEHICLES + 1):
        own = flown.client[flown.client["vehicle"] == number]
        own = own[own["step"] > FROM_S / scenario.control.dt]
        desired = scenario.make_reference(number)(own["step"] * scenario.control.dt)[..., 0]
        errors.append(((own["state"][..., 0] - desired) ** 2).sum(axis=1).mean() ** 0.5)
    return np.array(errors)


@pytest.mark.long
def test_vehicles_are_where_their_paths_are_at_each_time(tmp_path: Path) -> None:
    """As goals, the same points are flown to one after the other, and metres behind."""
    shown = scenario(tmp_path, ring())
    flown = flight.fly(shown, vehicles=VEHICLES)
    worst_m = errors_m(shown, flown).max()
    assert worst_m < 0.06
    assert flown.figures["server"]["counts"].get("left_tube", 0) == 0
    goals = flight.fly(scenario(tmp_path, ring(), "mission"), vehicles=VEHICLES)
    assert errors_m(shown, goals).min() > 20.0 * worst_m


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_vehicles_of_a_show_keep_apart_on_a_bad_network(seed: int, tmp_path: Path) -> None:
    """Twelve on a ring where the next is 1.14 m ahead, with half of all packets lost."""
    air = "uniform(0.05, 0.6) & loss(0.5)"
    shown = scenario(tmp_path, ring(12, 2.2), network={"uplink": air, "downlink": air})
    flown = flight.fly(msgspec.structs.replace(shown, seed=seed), vehicles=12)
    assert separation_m(flown) > shown.mission.separation_m


def test_paths_that_cross_are_refused_with_the_time(tmp_path: Path) -> None:
    crossing = "vehicle,t,x,y\n1,0,-5,0\n1,10,5,0\n2,0,0,-5\n2,10,0,5\n"
    with pytest.raises(ConfigError, match=r"as the paths of vehicles 1 and 2 at 5 s$"):
        scenario(tmp_path, crossing)
    scenario(tmp_path, crossing.replace("2,10,0,5", "2,30,0,5"))


def test_a_path_through_a_zone_is_refused(tmp_path: Path) -> None:
    through = "vehicle,t,x,y\n1,0,-5,0\n1,10,5,0\n"
    with pytest.raises(ConfigError, match=r"mission.zones: got box\(-1, 1, -1, 1\)"):
        scenario(tmp_path, through, mission={"zones": "box(-1, 1, -1, 1)"})


def test_a_goal_set_in_flight_replaces_the_path_of_one_vehicle_alone(tmp_path: Path) -> None:
    """The others are where their paths are at each time; vehicle 1 makes way for it first."""
    shown = scenario(tmp_path, ring(), mission={"goals": "goal(2, 0, 0)"})
    flown = flight.fly(shown, vehicles=VEHICLES)
    last = flown.client[flown.client["vehicle"] == 2][-1]
    assert np.abs(last["state"]).max() < 0.1
    assert errors_m(shown, flown)[2:].max() < 0.06


def test_a_path_faster_than_the_vehicle_is_refused(tmp_path: Path) -> None:
    text = "vehicle,t,x,y\n1,0,0,0\n1,8,0,0\n1,18,{far},0\n2,0,0,3\n"
    with pytest.raises(ConfigError, match=r"vehicle 1 to fly 1.45 m/s from 8 s on$"):
        scenario(tmp_path, text.format(far=14.5))
    slow = text.format(far=7.2)
    scenario(tmp_path, slow)
    with pytest.raises(ConfigError, match=r"at most 0.707 m/s on an axis"):
        scenario(tmp_path, slow, mission={"speed_mps": 1.0})


def test_a_show_is_not_allocated(tmp_path: Path) -> None:
    """Its paths would be flown as goals, one after the other."""
    with pytest.raises(ConfigError, match=r"mission.allocate: got true"):
        scenario(tmp_path, ring(), mission={"allocate": True})


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_paths_are_those_of_a_dense_grid(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mission, "PLACES_AT_ONCE", 8)  # in several parts
    rng = np.random.default_rng(seed)
    goals = {}
    for vehicle in range(1, 5):
        times_s = np.append(0.0, np.cumsum(rng.uniform(0.5, 4.0, int(rng.integers(0, 6)))))
        goals[vehicle] = times_s, rng.uniform(-8.0, 8.0, (len(times_s), 2))
    show = mission.Mission(goals, 2, 1, is_show=True)
    dense_s = np.arange(0.0, show.lasts_s + 1.0, 0.001)
    at = np.stack([show.of(vehicle)(dense_s)[..., 0] for vehicle in goals])
    away_m = np.array(
        [np.linalg.norm(at[i] - at[j], axis=1) for i in range(4) for j in range(i + 1, 4)]
    )
    assert show.nearest(float(away_m.min()) - 0.02, 1.0) is None
    apart_m = float(away_m.min()) + 0.5
    found = show.nearest(apart_m, 1.0)
    assert found is not None
    one, other, at_s, distance_m = found
    both = np.array([show.of(each)(np.array(at_s))[:, 0] for each in (one, other)])
    assert np.linalg.norm(both[0] - both[1]) == pytest.approx(distance_m, abs=1e-9)
    knots_s = np.unique(np.concatenate([times_s for times_s, _ in goals.values()]))
    first_s = dense_s[(away_m < apart_m).any(axis=0).argmax()]
    assert np.searchsorted(knots_s, first_s, "right") == np.searchsorted(knots_s, at_s, "right")


def test_a_show_that_takes_too_long_to_check_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contradictions, "PLACES_MAX", 700)
    with pytest.raises(ConfigError, match=r"times vehicles, got 726$"):
        scenario(tmp_path, ring())
