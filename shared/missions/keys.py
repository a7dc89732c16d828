"""Keys of a mission."""

from collections.abc import Iterator
from typing import Annotated, Any

from msgspec import Meta

from skytether.shared.scenario.owners import Key, OfServer, Owner, Term
from skytether.shared.scenario.reference import OfFleet, Reference
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.schema import Contradiction, Scenario, Section, Strength

ZONES, GOALS = "zones", "goals"
"""Groups of keys that may be changed in flight."""


class MissionConfig(Section, frozen=True):
    """Mission: several vehicles with goals, which keep apart whatever packets are lost; see
    docs/together.md.
    """

    separation_m: Term[Annotated[float, Meta(ge=1e-3, le=1e3)]] = 0.5
    """Smallest distance between two vehicles [m]."""
    height_m: Term[Annotated[float, Meta(ge=0, le=1e3)]] = 0.0
    """Smallest vertical distance if one vehicle is above another [m]; 0: `separation_m`."""
    tube_m: Term[Annotated[float, Meta(ge=0, le=1e3)]] = 0.15
    """Largest distance of a vehicle from its motion, by wind and tracking errors [m]."""
    speed_mps: OfServer[Strength] = 0.0
    """Largest speed of a motion over all axes [m/s]; 0: only `model.u_max`."""
    acceleration_mps2: OfServer[Annotated[float, Meta(ge=1e-3, le=1e3)]] = 0.6
    """Largest acceleration of a motion on an axis [m/s²]."""
    allocate: OfServer[bool] = False
    """Whether goals are assigned to the nearest vehicles. All vehicles then need goals at the same
    times."""
    goals: Annotated[str, Meta(max_length=4000), Key(Owner.SERVER, GOALS)] = ""
    """Goals that replace the mission's goals: goal(vehicle, x, y), or goal(vehicle, x, y, z),
    combined with &."""
    zones: Annotated[str, Meta(max_length=4000), Key(Owner.SERVER, ZONES)] = ""
    """Zones combined with &: box(x0, x1, y0, y1), cylinder(x, y, radius), polygon(x, y, …),
    fence(x0, x1, y0, y1), corridor(width, x, y, …), geojson(file)."""

    @property
    def height_scale(self) -> float:
        """Factor on vertical distances before they are compared with `separation_m`."""
        return self.separation_m / self.height_m if self.height_m else 1.0

    def shared_terms(self) -> dict[str, Any]:
        keys = ("separation_m", "height_m", "tube_m")
        return {name: getattr(self, name) for name in keys}

    def contradictions(self, scenario: Scenario) -> Iterator[Contradiction]:
        if scenario.keeps_apart:
            yield from _checks().of_keys(scenario)
            return
        for key in ("zones", "goals"):
            if given := getattr(self, key):
                expected = "none without a mission: reference.shape = 'mission', or a swap"
                yield f"mission.{key}", repr(given), expected

    def contradictions_of_way(self, scenario: Scenario, *, is_new: bool) -> Iterator[Contradiction]:
        if not scenario.keeps_apart:
            return
        wrong = list(_checks().of_changes(scenario))
        yield from wrong
        if is_new and not wrong:
            yield from _checks().of_places(scenario)

    def assigned(self, reference: Reference, vehicle: int) -> Reference:
        if not (self.allocate and isinstance(reference, OfFleet)):
            return reference
        return reference.allocated().of(vehicle)


SECTION = MissionConfig


def _checks() -> Any:
    return load("skytether.shared.missions.contradictions", "missions")
