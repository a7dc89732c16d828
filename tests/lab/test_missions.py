"""Missions as benchmarks: reproducible, also with cut links and restarted servers."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from bench import missions
from bench.harness import Study, TextTable
from bench.missions import MissionFlight, RandomOptions, SwapOptions
from skytether.lab.commands.pool import Flags, study
from skytether.server.missions import yielding
from skytether.server.missions.waypoints import Waypoints
from skytether.shared.base.errors import ConfigError


def test_a_mission_is_drawn_from_its_seed(tmp_path: Path) -> None:
    drawn = missions.random_mission(RandomOptions(), 5, tmp_path)
    again = missions.random_mission(RandomOptions(harsh=True), 5, tmp_path)
    assert again.mission == drawn.mission
    assert again.network.uplink.startswith(f"{drawn.network.uplink} & outages(")


@pytest.mark.long
def test_harsh_missions_keep_apart() -> None:
    """Vehicles that have not arrived are no fault there."""
    harsh = missions.study_of(RandomOptions(harsh=True, duration=60.0))
    ((name, table),) = harsh.make(6, None, Flags(2)).items()
    assert name == "random missions"
    assert sum(int(row[1]) for row in table.rows) == 6
    assert all(float(row[2]) > 0.5 for row in table.rows)


@pytest.mark.long
def test_a_gap_between_zones_that_is_too_narrow_is_flown_around(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A route fits through it, a motion does not. Otherwise a vehicle waits before the gap, or
    flies to and fro there.
    """
    assert missions.fly_random(RandomOptions(), 31463).late == 0
    assert missions.fly_random(RandomOptions(), 104503).late == 0
    monkeypatch.setattr(Waypoints, "close_way", lambda *_: False)
    assert missions.fly_random(RandomOptions(), 104503).late == 1


@pytest.mark.long
def test_a_vehicle_in_a_pocket_of_others_is_let_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of them yields, although it is nearer than plans keep. Otherwise none does."""
    assert missions.fly_random(RandomOptions(), 31906).late == 0
    monkeypatch.setattr(
        yielding, "_kept_distance", lambda places, _, apart_m: np.full(len(places), apart_m)
    )
    assert missions.fly_random(RandomOptions(), 31906).late == 1


def test_a_mission_with_a_fault_is_shown_with_its_seed() -> None:
    fine = MissionFlight(17, 2, "constant(0.1)", 0.8, 0.2, 0, 20.0, 0, 0, 1.0)
    near, late = fine._replace(seed=18, least_m=0.4), fine._replace(seed=19, late=1)
    shown = missions.random_tables(RandomOptions(), [fine, near, late])
    assert [row[0] for row in shown["faults"].rows] == ["seed 18", "seed 19"]
    shown = missions.random_tables(RandomOptions(harsh=True), [fine, late])
    assert list(shown) == ["random missions"]


def test_what_is_kept_is_not_flown_again(tmp_path: Path) -> None:
    out, one = tmp_path / "flights", Flags(0)
    assert study(math.sqrt, [4.0, 9.0], float, {"seed": 1}, out, one) == [2.0, 3.0]
    # Another function shows which cells are flown now.
    assert study(math.fabs, [4.0, 9.0, 16.0], float, {"seed": 1}, out, one) == [2.0, 3.0, 16.0]
    assert study(math.fabs, [4.0], float, {"seed": 1}, None, one) == [4.0]
    with pytest.raises(ConfigError, match="seed: got 2, expected 1"):
        study(math.fabs, [4.0], float, {"seed": 2}, out, one)


def test_a_study_flies_what_its_folder_lacks_and_makes_its_tables_of_all(tmp_path: Path) -> None:
    def squares(fly: Callable[[float], float], seeds: int) -> list[list[str]]:
        study = Study(
            None,
            lambda seeds: [float(seed) for seed in range(1, seeds + 1)],
            fly,
            float,
            lambda found: {"found": TextTable(["x"], [[f"{each:g}"] for each in found])},
            seeds=2,
        )
        return study.make(seeds, tmp_path / "flights", Flags(0))["found"].rows

    assert squares(math.sqrt, 2) == [["1"], ["1.41421"]]
    assert squares(math.fabs, 3) == [["1"], ["1.41421"], ["3"]]


def test_a_flight_without_zones_is_kept_as_well(tmp_path: Path) -> None:
    """Its distance from a zone is None, because JSON has no infinity."""
    fly = partial(missions.fly_swap, SwapOptions(vehicles=2, duration=4.0))
    again = [study(fly, [(1, "no loss")], MissionFlight, {}, tmp_path, Flags(0)) for _ in range(2)]
    assert again[0] == again[1]
    assert again[1][0].clear_m is None
