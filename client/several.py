"""A vehicle that reaches its server over several paths, has a standby server, or both."""

from collections.abc import Sequence
from typing import TypeVar

from skytether.client.alone import OneServer, Parts, Reach
from skytether.client.link import ClientLink, PlainLink
from skytether.client.route import Route
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.scenario.registry import load

PATH_SOCKETS = (0, 2, 3, 4)
"""Numbers of a client's sockets, one for each path to its server; socket 1 is the autopilot's."""
STANDBY_SOCKETS = (5, 6, 7, 8)
"""Numbers of a client's sockets, one for each path to its standby server."""

T = TypeVar("T")


def by_socket(paths: Sequence[T], standby: Sequence[T]) -> dict[int, T]:
    """Paths to the server and to the standby server, by the number of their socket."""
    return {
        **dict(zip(PATH_SOCKETS, paths, strict=False)),
        **dict(zip(STANDBY_SOCKETS, standby, strict=False)),
    }


class Several(Reach):
    """See `Reach`.

    Args:
        paths: address of the server, or of the netem in front of it, on each path.
        link: link to the server; None: without keys.
        names: name of each path in the log; empty: the addresses are the names.
        standby: addresses of the standby server, as in `paths`; empty without a standby server.
        standby_link: link to the standby server; None: without keys.
    """

    def __init__(
        self,
        paths: Sequence[Address],
        link: ClientLink | None = None,
        *,
        names: Sequence[str] = (),
        standby: Sequence[Address] = (),
        standby_link: ClientLink | None = None,
    ) -> None:
        super().__init__(paths[0], link)
        self.addresses = paths
        self._standby, self._names = standby, names
        if standby:
            self.links = (*self.links, standby_link or PlainLink())

    def routes(self, parts: Parts) -> list[Route]:
        routes = [self._route(parts, self.addresses, PATH_SOCKETS, self._names)]
        if self._standby:
            routes.append(self._route(parts, self._standby, STANDBY_SOCKETS, ()))
        return routes

    def servers(self, parts: Parts) -> OneServer:
        """See `Reach`.

        Raises:
            ConfigError: heartbeats are too rare for a standby server.
        """
        if not self._standby:
            return super().servers(parts)
        link = parts.scenario.link
        if 3 * (link.fixed_ns or 0) > seconds_to_ns(link.timeout_s):
            expected = "expected at most a third of link.timeout_s with a standby server"
            raise ConfigError(f"link.heartbeat_s: got {link.heartbeat_s}, {expected}")
        standby = load("skytether.client.standby.servers", "a standby server")
        servers: OneServer = standby.Servers(2, parts)
        return servers

    def _route(
        self, parts: Parts, paths: Sequence[Address], sockets: Sequence[int], names: Sequence[str]
    ) -> Route:
        if len(paths) == 1:
            return Route(paths, sockets, parts.out)
        link, prices = parts.scenario.link, [path.price for path in parts.scenario.paths]
        route: Route = load("skytether.client.paths", "paths").SeveralPaths(
            paths,
            sockets,
            parts.out,
            events=parts.events,
            names=names,
            # All prices are equal if the scenario has prices for another number of paths.
            prices=prices if len(prices) == len(paths) else (1.0,) * len(paths),
            spread=link.spread,
            timeout_ns=seconds_to_ns(link.timeout_s),
        )
        return route
