"""Flights of a mission with scheduled restarts of processes, and figures of the flown paths."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fuzz.adversary import lives
from fuzz.adversary.lives import world_s
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.missions.zones import Zones
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.summary import nearest
from skytether.sim.flight import SERVER

LOOK_S = 10 * MILLISECOND_NS / SECOND_NS
"""Sampling time of the vehicles' positions [s]."""


class Restart(NamedTuple):
    """Restart of a vehicle's client."""

    vehicle: int
    at_s: float
    """Time of the world at which it stops [s]."""
    down_s: float = 0.2
    remembers: bool = True
    """Whether the next life finds the saved state."""


class Death(NamedTuple):
    """Restart of the server."""

    at_s: float
    down_s: float
    remembers: bool = True
    """Whether the next life keeps what was set in flight."""
    zones: str = ""


class Lives(lives.Lives):
    """Mission with scheduled restarts.

    Args:
        restarts: restarts of clients.
        deaths: restarts of the server.
        settings: keys that an operator sets at the server: times [s], and values by key.
    """

    def __init__(
        self,
        scenario: Scenario,
        restarts: Sequence[Restart] = (),
        deaths: Sequence[Death] = (),
        settings: Sequence[tuple[float, Mapping[str, Any]]] = (),
    ) -> None:
        super().__init__(scenario)
        for each in restarts:
            begin = partial(self.start_client, each.vehicle, remembers=each.remembers)
            self._at(each.at_s, partial(self.clients[each.vehicle].kill, self.world))
            self._at(each.at_s + each.down_s, begin)
        for death in deaths:
            others = {"mission.zones": death.zones} if death.zones else {}
            self._at(death.at_s, partial(self.servers[SERVER[0]].kill, self.world))
            self._at(
                death.at_s + death.down_s,
                partial(self.start_server, others, remembers=death.remembers),
            )
        for at_s, values in settings:
            self._at(at_s, partial(self.set, values))

    def _at(self, time_s: float, action: Any) -> None:
        self.world.at(seconds_to_ns(time_s), action)

    def fly(self, until_s: float | None = None) -> None:
        self.run(self.scenario.duration + 10.0 if until_s is None else until_s)

    def inside_s(self, zones: Zones, since_s: float = 0.0) -> float:
        """Time that vehicles spent within zones from `since_s` on, summed over vehicles [s]."""
        at_s = np.arange(since_s, self.world.now_ns / SECOND_NS, LOOK_S)
        inside = 0
        for times, at in self.tracks().values():
            places = np.stack([np.interp(at_s, times + world_s(0.0), x) for x in at.T], 1)
            inside += int((zones.clearance(places).min(axis=1) < 0.0).sum())
        return inside * LOOK_S

    def least_m(self) -> float:
        _, apart_m = nearest(list(self.tracks().values()), LOOK_S)
        return float(np.nanmin(apart_m))
