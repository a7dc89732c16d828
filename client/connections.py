"""Connections of a vehicle: a session with each of its servers."""

from skytether.client.alone import OneServer, Parts, Reach
from skytether.client.session import ServerSession
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.law.heartbeat import Hearing

Ends = dict[tuple[int, Address], tuple[ServerSession, int]]
"""Session and path number of an arriving datagram, by its socket and its peer."""


def connect(reach: Reach, parts: Parts) -> tuple[OneServer, Ends]:
    """Servers of a vehicle, each with a session that is not open yet.

    Raises:
        ConfigError: see `Reach.servers`.
    """
    link = parts.scenario.link
    timeout_ns = seconds_to_ns(link.timeout_s)
    servers, ends = reach.servers(parts), Ends()
    for i, (route, keys) in enumerate(zip(reach.routes(parts), reach.links, strict=True)):
        session = ServerSession(
            parts.terms,
            vehicle=parts.vehicle,
            # Each server gets a different boot id: otherwise a packet that is delivered to the
            # wrong server could replace the session there.
            boot_id=parts.boot_id ^ i,
            role=servers.role(i),
            route=route,
            timeout_ns=timeout_ns,
            connect_s=link.connect_s,
            link=keys,
            hearing=Hearing(timeout_ns, parts.terms.dt_ns, link.fixed_ns),
            events=parts.events,
        )
        servers.sessions.append(session)
        ends |= {end: (session, number) for number, end in enumerate(route.ends)}
    return servers, ends
