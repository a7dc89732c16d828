"""Parts of a client that has a single server and saves no state.

Other modules replace these parts: `client.standby` with a standby server, `client.several` with
several addresses. `client.memory` has a client whose next run continues in the middle of a flight.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from skytether.client.failsafe import Failsafe
from skytether.client.link import ClientLink, PlainLink
from skytether.client.route import Route
from skytether.shared.endpoints.endpoint import Address, Datagram, Events
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import Scenario
from skytether.shared.wire.protocol import Message, decode


class MotionInForce(NamedTuple):
    """Motion of a mission that a vehicle flies."""

    step: int
    """Step of the first knot."""
    observed: int
    """Step of the observation from which the motion was planned."""
    since: int
    """First step whose input was computed from the motion."""
    spacing: int
    """Steps from one knot to the next."""
    numbers: bytes
    """Position [m] and velocity [m/s] of each knot, float32 of shape (axes, knots, 2)."""


class Fresh:
    """Replacement for `memory.SavedState` if no state was saved: the flight begins anew."""

    heard_ns = 0
    began_ns: int | None = None
    motion: Any = None

    def servers(self, parts: "Parts") -> "OneServer":
        """The single server of a client without saved state."""
        return OneServer(parts.failsafe)


class Role:
    """Role of a server for its vehicle. In this base class the vehicle follows its only server.

    Args:
        failsafe: receives the packets and faults of a server that the vehicle follows.
    """

    is_followed = True
    """Whether the vehicle flies the plans of the server."""
    may_observe = True
    """Whether observations may be sent to the server."""
    decode: Callable[[bytes, Terms], Message] = staticmethod(decode)
    """Decoder of the server's messages, see `protocol.decode`."""

    def __init__(self, failsafe: Failsafe) -> None:
        self.heard: Callable[..., None] = failsafe.heard
        """Function that notes a packet of the session."""
        self.malformed: Callable[..., None] = failsafe.malformed
        """Function that notes a malformed message that proves to be from the server."""
        self.meet: Callable[..., None] = failsafe.meet
        """Function that passes a cause (`Reason`) that concerns the server to the failsafe."""

    def begin(self) -> None:
        """Note that a new session with the server begins."""

    def check_plan(self) -> None:
        """Raise ProtocolError if the plan that was decoded last must not be flown."""

    def take(self, message: Message, now_ns: int) -> bool:
        """Process a message about leadership; False if the message is about something else."""
        return False

    def lost_after_ns(self, timeout_ns: int) -> int:
        """Silence after which the server counts as lost [ns].

        Args:
            timeout_ns: silence after which a server that the vehicle follows counts as lost [ns].
        """
        return timeout_ns


class OneServer:
    """The only server of a vehicle, which the vehicle follows.

    Args:
        failsafe: receives the packets and faults of that server.
    """

    keys: frozenset[str] = frozenset()
    """Keys by which an operator chooses the server that leads."""

    def __init__(self, failsafe: Failsafe) -> None:
        self.failsafe = failsafe
        self.sessions: list[Any] = []
        """Session with each server, appended by the caller."""
        self.may_tell: Callable[[int], bool] = lambda _: True
        """Function that says whether messages may be sent at a time [ns]; see `client.memory`."""

    @property
    def followed(self) -> Any:
        """Session with the server whose plans are flown."""
        return self.sessions[0]

    def role(self, server: int) -> Role:
        """Role of a server for the vehicle."""
        return Role(self.failsafe)

    def follow(self, *, step: int, on_ground: bool, now_ns: int) -> None:
        """Choose the server that the vehicle follows; called at each step, also on the ground."""

    def objection(self, scenario: Scenario) -> str:
        """Why a change of `keys` by an operator is refused now; empty if the change is accepted."""
        return ""

    def obey(self, scenario: Scenario, *, now_ns: int) -> None:
        """Act on an operator's change of `keys`."""

    def to_keep(self) -> dict[str, Any]:
        """Values that the servers add to `memory.SavedState`, by the field's name."""
        return {}

    def figures(self) -> dict[str, Any]:
        return {}


class Parts(NamedTuple):
    """Parts of a client that its connections use."""

    scenario: Scenario
    terms: Terms
    vehicle: int
    boot_id: int
    failsafe: Failsafe
    before: Any
    """State saved by the previous run: `memory.SavedState`, or `Fresh`."""
    motion: Callable[[], MotionInForce | None]
    """Function that returns a mission's motion in force; None on the ground or without a motion."""
    out: list[Datagram]
    events: Events
    """List to which events for the operator are appended."""


class Reach:
    """Routes and links from a vehicle to its servers; this class has one server at one address.

    Args:
        server: address of the server, or of the netem in front of it.
        link: link to the server; None: without keys.
    """

    def __init__(self, server: Address, link: ClientLink | None = None) -> None:
        self._server = server
        self.links: Sequence[ClientLink] = (link or PlainLink(),)
        """Link to each server."""

    def routes(self, parts: Parts) -> list[Route]:
        """Route to each server."""
        return [Route((self._server,), (0,), parts.out)]

    def servers(self, parts: Parts) -> OneServer:
        """Servers of the vehicle; the caller adds their sessions.

        Raises:
            ConfigError: the scenario is not suited for these servers.
        """
        servers: OneServer = parts.before.servers(parts)
        return servers
