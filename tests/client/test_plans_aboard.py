"""A plan of QGroundControl, flown by an autopilot that takes off by itself."""

import json
from pathlib import Path

import pytest

from airborne import Air
from skytether.autopilot.flavours import FlavourName

HOME = [47.0, 8.0]


def item(command: int, latitude: float, altitude_m: float) -> dict[str, object]:
    params = [0, 0, 0, None, latitude, HOME[1], altitude_m]
    return {"type": "SimpleItem", "command": command, "frame": 3, "params": params}


def test_a_plan_is_flown_from_the_altitude_of_its_take_off(
    tmp_path: Path, flavour: FlavourName
) -> None:
    """The vehicle does not come down again to where the plan's take-off begins."""
    north = HOME[0] + 6.0 / 111_000.0
    mission = {
        "plannedHomePosition": [*HOME, 400.0],
        "hoverSpeed": 0.5,
        "items": [item(22, HOME[0], 3.0), item(16, north, 3.0)],
    }
    file = tmp_path / "field.plan"
    file.write_text(json.dumps({"fileType": "Plan", "mission": mission}))
    reference = {"shape": "csv", "file": str(file), "radius_m": 1.0}
    air = Air(flavour, reference=reference, duration=12.0)
    air.fly()
    assert air.flight.position()[2] == pytest.approx(3.0, abs=0.5)
    air.run(11.0)
    assert air.rows()["state"][:, 2, 0].min() > 2.0
    assert air.flight.position()[1] == pytest.approx(0.0, abs=1.0)
    assert air.flight.position()[0] > 3.0
