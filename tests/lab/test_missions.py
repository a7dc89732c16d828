"""Random missions: reproducible, and harsh ones with links that are cut and servers that die."""

from pathlib import Path

import numpy as np
import pytest

from skytether.lab.benchmarks import missions
from skytether.lab.benchmarks.missions import MissionsOptions
from skytether.server.missions import yielding
from skytether.server.missions.waypoints import Waypoints


def test_a_mission_is_drawn_from_its_seed(tmp_path: Path) -> None:
    """Harsh ones are the same, over links that are cut as well."""
    drawn = missions.mission(MissionsOptions(), 5, tmp_path)
    again = missions.mission(MissionsOptions(harsh=True), 5, tmp_path)
    assert again.mission == drawn.mission
    assert again.network.uplink.text.startswith(f"{drawn.network.uplink.text} & outages(")


@pytest.mark.long
def test_harsh_missions_keep_apart() -> None:
    """Vehicles that have not arrived are no fault there."""
    table, told = missions.table(MissionsOptions(missions=6, harsh=True, duration=60.0))
    assert told == []
    assert sum(int(row[1]) for row in table.rows) == 6
    assert all(float(row[2]) > 0.5 for row in table.rows)


@pytest.mark.long
def test_a_gap_between_zones_that_is_too_narrow_is_flown_around(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A way fits through it and a motion does not. Ablation: else one vehicle stays before it, or
    flies to and fro there.
    """
    assert missions.fly(MissionsOptions(), 31463).late == 0
    assert missions.fly(MissionsOptions(), 104503).late == 0
    monkeypatch.setattr(Waypoints, "close_way", lambda *_: False)
    assert missions.fly(MissionsOptions(), 104503).late == 1


@pytest.mark.long
def test_a_vehicle_in_a_pocket_of_others_is_let_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of them yields, though it is nearer than plans keep. Ablation: else nobody does."""
    assert missions.fly(MissionsOptions(), 31906).late == 0
    monkeypatch.setattr(
        yielding, "_kept_distance", lambda places, _, apart_m: np.full(len(places), apart_m)
    )
    assert missions.fly(MissionsOptions(), 31906).late == 1
