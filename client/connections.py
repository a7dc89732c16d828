"""Connections of a vehicle: a session with each of its servers, over one path or several.

The plain form is one server and one path. The room of a standby server, and that of several paths,
are loaded if a vehicle is given their addresses.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from skytether.client.alone import MotionInForce, OneServer
from skytether.client.failsafe import Failsafe
from skytether.client.link import ClientLink, PlainLink
from skytether.client.route import Route
from skytether.client.session import ServerSession
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.endpoints.endpoint import (
    PATH_SOCKETS,
    STANDBY_SOCKETS,
    Address,
    Datagram,
    Events,
)
from skytether.shared.law.heartbeat import Hearing
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.schema import Scenario


class Reached(NamedTuple):
    """Addresses of a vehicle's servers, and of the networks in front of them."""

    paths: Sequence[Address]
    """Address of the server on each path."""
    prices: Sequence[float]
    """Price of a packet on each path; if there are not as many as paths, all alike."""
    names: Sequence[str]
    """What the log calls each path; empty: its address."""
    standby: Sequence[Address]
    """Address of the standby server on each path; empty without one."""


def connect(
    scenario: Scenario,
    terms: Terms,
    reached: Reached,
    links: Sequence[ClientLink | None],
    failsafe: Failsafe,
    *,
    vehicle: int,
    boot_id: int,
    leadership: int,
    motion: Callable[[], MotionInForce | None],
    may_tell: Callable[[int], bool],
    out: list[Datagram],
    events: Events,
) -> tuple[OneServer, dict[tuple[int, Address], tuple[int, int]]]:
    """Servers of a vehicle, each with a session that waits to be opened.

    Args:
        links: link to each server; None: without keys.
        leadership: number of the leadership of an earlier run; 0 without one.
        motion, may_tell: see `client.servers`.

    Returns:
        the servers; and the numbers of the server and of its path, by the socket and the peer of a
        datagram.

    Raises:
        ConfigError: heartbeats are too rare for a standby server.
    """
    timeout_ns, fixed_ns = seconds_to_ns(scenario.link.timeout_s), scenario.link.fixed_ns
    if reached.standby and 3 * (fixed_ns or 0) > timeout_ns:
        expected = "expected at most a third of link.timeout_s with a standby server"
        raise ConfigError(f"link.heartbeat_s: got {scenario.link.heartbeat_s}, {expected}")
    addresses = [reached.paths, reached.standby] if reached.standby else [reached.paths]
    servers = OneServer(failsafe)
    if reached.standby or leadership:
        servers = load("skytether.client.servers", "a standby server").Servers(
            len(addresses),
            leadership,
            failsafe,
            vehicle=vehicle,
            timeout_ns=timeout_ns,
            dt_ns=terms.dt_ns,
            motion=motion,
            may_tell=may_tell,
            events=events,
        )
    at: dict[tuple[int, Address], tuple[int, int]] = {}
    for i, (paths, sockets) in enumerate(
        zip(addresses, (PATH_SOCKETS, STANDBY_SOCKETS), strict=False)
    ):
        ends = zip(sockets, paths, strict=False)
        at |= {each: (i, path) for path, each in enumerate(ends)}
        names = () if i else reached.names
        servers.sessions.append(
            ServerSession(
                terms,
                vehicle=vehicle,
                # To the other server it is another client: packets that are led astray must
                # not replace the session there.
                boot_id=boot_id ^ i,
                role=servers.role(i),
                route=_route(scenario, paths, sockets, names, reached.prices, out, events),
                timeout_ns=timeout_ns,
                connect_s=scenario.link.connect_s,
                link=links[i] or PlainLink(),
                hearing=Hearing(timeout_ns, terms.dt_ns, fixed_ns),
                events=events,
            )
        )
    return servers, at


def _route(
    scenario: Scenario,
    addresses: Sequence[Address],
    sockets: Sequence[int],
    names: Sequence[str],
    prices: Sequence[float],
    out: list[Datagram],
    events: Events,
) -> Route:
    """Route to a server."""
    if len(addresses) == 1:
        return Route(addresses, sockets, out)
    route: Route = load("skytether.client.paths", "paths").SeveralPaths(
        addresses,
        sockets,
        out,
        events=events,
        names=names,
        prices=prices if len(prices) == len(addresses) else (1.0,) * len(addresses),
        spread=scenario.link.spread,
        timeout_ns=seconds_to_ns(scenario.link.timeout_s),
    )
    return route
