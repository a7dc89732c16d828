"""Overtaken messages: what was sent before others by more than the time-out, and comes after them,
counts as lost.
"""

from collections import Counter
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from helpers import packaged
from skytether.client.endpoint import Client
from skytether.server.endpoint import Server
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.events.flight import Unauthenticated
from skytether.shared.telemetry.record import Record, Rows
from skytether.shared.wire.drop import Drop
from skytether.sim.flight import fly
from skytether.sim.world import World

STILL = {"uplink": "constant(0.05)", "downlink": "constant(0.05)"}
"""Delays without chance, so that an additional packet changes no other's delay."""
LINKS = {
    "one": ("demo", STILL, {}),
    "two": ("demo", {"paths": [STILL, STILL]}, {}),
    "standby": ("demo", STILL, {"standby": True}),
    "mission": ("swap", STILL, {"vehicles": 2, "standby": True}),
}
LATE_S, AT_S, SECONDS = 7.0, 14.0, 20.0
"""Least time from a message that comes so late to the newest that came on its way, more than any
time-out here; when it comes, and length of a flight [s]."""


class Came(NamedTuple):
    receive: Callable[..., None]
    datagram: Datagram
    host: str
    at_ns: int
    """Time of the world."""

    @property
    def stream(self) -> tuple[object, ...]:
        """Its way: where it arrived, and from where."""
        return self.host, self.datagram.peer


@cache
def flown(links: str, seed: int, lost: float, comes: str, *, secure: bool = False) -> Record:
    """Flight in which a share of the packets is lost; later copies of old ones come, in any order,
    or the lost ones.
    """
    name, network, how = LINKS[links]
    scenario = packaged(name, {"network": network}, duration=SECONDS)
    rng, came, held, worlds = stream(seed, "lost"), list[Came](), list[Came](), list[World]()

    def hooked(kind: type[Endpoint]) -> Any:
        original = kind.receive

        def receive(self: Endpoint, datagram: Datagram, *, now_ns: int) -> None:
            if worlds:
                (host,) = (n for n, each in worlds[0]._hosts.items() if each.endpoint is self)
                each = Came(partial(original, self), datagram, host, worlds[0].now_ns)
                is_lost = rng.random() < lost
                (held if is_lost else came).append(each)
                if is_lost:
                    return
            original(self, datagram, now_ns=now_ns)

        return patch.object(kind, "receive", receive)

    def come(world: World) -> None:
        late = {"nothing": [], "copies": came, "lost": held}[comes]
        newest_ns = {each.stream: each.at_ns for each in came}
        late = [
            each for each in late if newest_ns.get(each.stream, 0) - each.at_ns > LATE_S * SECOND_NS
        ]
        for i in stream(seed, "order").permutation(len(late)):
            world.act(late[i].host, partial(late[i].receive, late[i].datagram))
        worlds.clear()

    with hooked(Server), hooked(Client):
        return fly(scenario, actions=[(2.0, worlds.append), (AT_S, come)], secure=secure, **how)


def timeless(rows: Rows) -> list[bytes]:
    """Columns without the computing time."""
    return [rows[name].tobytes() for name in rows.dtype.names if name != "solve_ns"]


# A flight takes a while: a failing one is not searched for a simpler one.
@settings(max_examples=20, phases=[Phase.explicit, Phase.generate])
@given(
    st.sampled_from([*LINKS]), st.booleans(), st.integers(0, 100), st.sampled_from([0.0, 0.1, 0.3])
)
@example(
    "mission", False, 68, 0.1
)  # a vehicle is silent for 8 s there: the lost is within a time-out of the newest
def test_messages_that_come_much_too_late_are_as_good_as_lost(
    links: str, secure: bool, seed: int, lost: float
) -> None:
    expected = flown(links, seed, lost, "nothing", secure=secure)
    for comes in ["lost"] + ["copies"] * (not secure):
        found = flown(links, seed, lost, comes, secure=secure)
        assert np.array_equal(found.client, expected.client)
        assert timeless(found.server) == timeless(expected.server)
        # With keys, what a newer path's packet has overtaken looks replayed.
        events = (each for each in found.events if not isinstance(each.event, Unauthenticated))
        assert (*events,) == expected.events


@pytest.mark.parametrize("links", [*LINKS])
def test_they_are_counted(links: str) -> None:
    figures = flown(links, 1, 0.1, "copies").figures
    dropped = Counter(figures["server"]["dropped"])
    for each in figures["client"]["by_vehicle"].values():
        dropped += each["dropped"]
    assert dropped[Drop.OVERTAKEN] + dropped[Drop.COPY] > 5
