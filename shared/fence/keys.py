"""Keys of the fence."""

from collections.abc import Iterator
from typing import Annotated

from msgspec import Meta

from skytether.shared.law.model import ALTITUDE
from skytether.shared.scenario.owners import OfEach
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.schema import Contradiction, Position, Scenario, Section, Strength


class FenceConfig(Section, frozen=True):
    """Fence that the vehicle does not leave, whatever inputs it receives. The vehicle uses its own
    scenario's fence; a server with a fence refuses desired trajectories that cross the fence.
    """

    low_m: OfEach[tuple[Position, ...]] = ()
    """Lowest position on each axis [m]; default: no bound."""
    high_m: OfEach[tuple[Position, ...]] = ()
    """Highest position on each axis [m]; default: no bound."""
    radius_m: OfEach[Strength] = 0.0
    """Largest distance from the start [m]; 0: no bound."""
    speed_mps: OfEach[Strength] = 0.0
    """Largest desired speed over all axes [m/s]; 0: only `model.u_max`."""
    wind_mps: OfEach[Annotated[float, Meta(ge=0, le=100)]] = 1.0
    """Largest velocity that wind or a wrong gain may add without moving the vehicle over the fence
    [m/s]; a larger value widens the margins."""

    @property
    def is_there(self) -> bool:
        return bool(self.low_m or self.high_m or self.radius_m or self.speed_mps)

    @property
    def has_home(self) -> bool:
        """Whether home (0, 0) is inside the fence, in the horizontal plane."""
        low = all(each <= 0.0 for each in self.low_m[:ALTITUDE])
        return low and all(each >= 0.0 for each in self.high_m[:ALTITUDE])

    def guard(self) -> str:
        return "skytether.client.fence" if self.is_there else ""

    def contradictions(self, scenario: Scenario) -> Iterator[Contradiction]:
        if scenario.vehicle.on_loss == "return" and not self.has_home:
            yield "vehicle.on_loss", "'return'", "'land': home (0, 0) is outside the fence"
        axes = scenario.model.axes
        for key, values in (("fence.low_m", self.low_m), ("fence.high_m", self.high_m)):
            if len(values) not in (0, axes):
                yield key, list(values), f"{axes} numbers with model.axes = {axes}"

    def contradictions_of_way(
        self,
        scenario: Scenario,
        *,
        is_new: bool,  # noqa: ARG002
    ) -> Iterator[Contradiction]:
        if self.is_there:
            yield from load("skytether.shared.fence.contradictions", "fence").of_way(scenario)


SECTION = FenceConfig
