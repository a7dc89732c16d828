"""Dropped packets by end and reason, from the figures of processes, and the page that lists all."""

import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from skytether.client.standby.servers import NOT_THE_LEADER
from skytether.shared.telemetry.drops import DirectionCounts, counted, drops
from skytether.shared.wire.drop import Drop

OPERATING = Path(__file__).parents[2] / "docs" / "operating.md"


def test_drops_are_by_end_and_reason() -> None:
    """By vehicle, and summed over the workers of a server; zeros are left out."""
    figures: dict[str, dict[str, Any]] = {
        "server": {"dropped": {"replayed": 2, "forged": 0}, "refused": {"full": 7}},
        "server.1": {"dropped": {"replayed": 1}, "kernel_drops": 4, "step": "other figures"},
        "netem": {"refused": 3, "uplink": {"lost": 5, "packets": 90}, "downlink": {"dropped": 6}},
        "client": {"by_vehicle": {"1": {"dropped": {"too old": 8}}, "2": {"dropped": {"type": 9}}}},
    }
    assert drops(figures, 1) == {
        "server": {"kernel": 4, "replayed": 3},
        "netem": {"downlink dropped": 6, "uplink lost": 5, "refused": 3},
        "client": {"too old": 8},
    }
    figures["client"]["others_dropped"] = {"type": 2}
    assert drops(figures, 1)["client"] == {"too old": 8}
    assert drops(figures)["client"] == {"type": 11, "too old": 8}
    assert drops({"server": {"dropped": {}}}, 1) == {}


@pytest.mark.parametrize(
    "figures",
    [{"dropped": {"forged": "many"}}, {"uplink": 3}, {"by_vehicle": {"1": []}}],
)
def test_figures_of_other_types_are_refused(figures: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="Expected"):
        counted(figures)


def test_the_page_lists_every_reason() -> None:
    section = OPERATING.read_text().split("## Dropped packets")[1].split("\n## ")[0]
    listed = re.findall(r"^\| `([^`]*)` \|", section, re.MULTILINE)
    of_netem = [f"uplink {each.name}" for each in msgspec.structs.fields(DirectionCounts)]
    assert listed == [*Drop, NOT_THE_LEADER, *of_netem, "refused", "kernel"]
