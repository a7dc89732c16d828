"""A standby server in a virtual flight, behind a network of its own."""

from collections.abc import Callable

from skytether.client.link import ClientLink
from skytether.client.several import Several
from skytether.server.endpoint import Server
from skytether.shared.base.chance import stream
from skytether.shared.endpoints.endpoint import Address, Endpoint
from skytether.shared.scenario.whole import Scenario
from skytether.sim.flight import Alone

STANDBY: Address = ("standby", 0)


class WithStandby(Alone):
    """Servers of a flight: a server and its standby.

    Args:
        standby: endpoint that is the standby server; if True, a `Server` is made.
    """

    def __init__(self, standby: Endpoint | bool) -> None:
        self._standby = standby

    def networks(self, scenario: Scenario) -> list[tuple[Address, Scenario]]:
        return [*super().networks(scenario), (STANDBY, scenario.on_path(len(scenario.paths)))]

    def reach(self, addresses: list[Address], link: Callable[..., ClientLink | None]) -> Several:
        *paths, last = addresses
        return Several(paths, link(), standby=[last], standby_link=link("standby"))

    def others(self, seed: int, started: Callable[..., Server]) -> dict[str, Endpoint]:
        if isinstance(self._standby, Endpoint):
            return {STANDBY[0]: self._standby}
        return {STANDBY[0]: started(stream(seed, "standby").bytes)}
