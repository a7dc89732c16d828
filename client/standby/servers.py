"""The servers of a vehicle: choice of the leader, and LEAD messages that announce the leader.

The vehicle changes the leader by the rules of `leadership`; the failsafe receives packets and
faults of the leader only.

The class `Servers` replaces `client.alone.OneServer`. `client.several` loads it if there is a
standby server, and `client.memory` if an earlier run of the client had one.
"""

from dataclasses import dataclass
from typing import Any

from skytether.client.alone import OneServer, Parts, Role
from skytether.client.failsafe import CLOSING
from skytether.client.session import ServerSession
from skytether.client.standby.keys import LinkConfig
from skytether.client.standby.leadership import Leadership
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.events.flight import address_text
from skytether.shared.events.standby import LeaderChanged, LimitsDiffer
from skytether.shared.law.heartbeat import SESSION_NS
from skytether.shared.law.limits import LIMITS
from skytether.shared.law.terms import Difference, Terms
from skytether.shared.scenario.catalogue import differences
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.drop import ProtocolError
from skytether.shared.wire.lead import Lead, decode_led
from skytether.shared.wire.protocol import Message

LEADER_KEY = "link.leader"
NAMES = ("server", "standby")
"""Values of `link.leader`, by the number of the server."""
SOON_NS = 200 * MILLISECOND_NS
"""Time after which LEAD is sent again to a leader that has not answered [ns]."""
GROUND_NS = 3 * SECOND_NS
"""Additional time for which the leader of a vehicle on the ground may be silent [ns]: the leader
then only answers HELLOs, and the first handshake needs several packets each way."""
DEPARTURES = frozenset({Reason.CLOSED, Reason.RESTARTED})
"""Causes after which a server stops leading if another server answers."""
NEVER_NS = -(2**63)
NOT_THE_LEADER = "not the leader"
"""Reason for dropping a plan of a server that does not lead, or of an earlier leadership."""
LOST_TIMES = 6
"""Silence after which a server that does not lead counts as lost, as a multiple of the time-out;
`lost_after_ns` limits it to half of SESSION_NS."""


@dataclass(slots=True)
class LeadState:
    """LEAD messages to one server, and the server's answers, in the present session."""

    number: int | None = None
    """Largest leadership number in the server's answers; None before the first answer."""
    again_ns: int = 0
    """Time before which no further LEAD is sent to the server [ns]."""
    asked: tuple[int, int] = 0, -SESSION_NS
    """Step of the vehicle, and time [ns], at which the newest LEAD was sent to the server."""


class Servers(OneServer):
    """Servers of a vehicle that has a standby server, or has had one in an earlier run.

    Args:
        count: number of servers.
        parts: parts of the client.
    """

    keys = frozenset({LEADER_KEY})

    def __init__(self, count: int, parts: Parts) -> None:
        super().__init__(parts.failsafe)
        number = getattr(parts.before, "leadership", 0)  # `Fresh` has no leadership
        timeout_ns = seconds_to_ns(parts.scenario.link.timeout_s)
        # Without a standby server, the vehicle tells its only server that this server leads now.
        number += bool(number and count == 1)
        self.leadership = Leadership(count, number, timeout_ns)
        self.sessions: list[ServerSession] = []
        self._lead_states = [LeadState() for _ in range(count)]
        self._count, self._vehicle, self._events = count, parts.vehicle, parts.events
        self._dt_ns, self._timeout_ns = parts.terms.dt_ns, timeout_ns
        self._motion = parts.motion
        self._reported = number
        """Leadership number that was last reported."""
        self._differing: dict[int, tuple[Difference, ...]] = {}
        """Differences of limits last reported, by number of a server that may not lead."""
        self._now_ns = NEVER_NS
        self._counted_from_ns: int | None = None
        """Time before which the silence of the leader does not count [ns], because a server that
        did not lead, or led a vehicle on the ground, sent rarely. None before the first wake."""
        self._was_on_ground = False
        self._silent_since_ns = NEVER_NS
        """Start of the leader's silence [ns] for which the failsafe's time-out was last restarted:
        it is restarted once in each silence."""

    @property
    def followed(self) -> ServerSession:
        return self.sessions[self.leadership.leader]

    def begin(self, server: int) -> None:
        """Note that a new session with a server begins."""
        self._lead_states[server] = LeadState()
        self.leadership.begin(server)

    def knows_leader(self, server: int) -> bool:
        """Whether a server has confirmed which server leads."""
        return self._lead_states[server].number is not None

    def to_keep(self) -> dict[str, Any]:
        return {"leadership": self.leadership.number}

    def figures(self) -> dict[str, Any]:
        address = address_text(*self.followed.address)
        return {"leadership": {"number": self.leadership.number, "server": address}}

    def role(self, server: int) -> Role:
        return OneOfServers(self, server)

    # -- deciding ----------------------------------------------------------------------------

    def follow(self, *, step: int, on_ground: bool, now_ns: int) -> None:
        """Let another server lead if the leader is silent, and tell all servers which server leads.

        Args:
            step: step of the vehicle.
        """
        lead, self._now_ns = self.leadership, now_ns
        if self._counted_from_ns is None or (self._was_on_ground and not on_ground):
            self._counted_from_ns = now_ns
        self._was_on_ground = on_ground
        heard_ns = [NEVER_NS if each.heard_ns is None else each.heard_ns for each in self.sessions]
        useful_ns = self.followed.useful_ns
        leader_ns = max(NEVER_NS if useful_ns is None else useful_ns, self._counted_from_ns)
        if on_ground:
            leader_ns += GROUND_NS + self._timeout_ns // 2
        heard_ns[lead.leader] = leader_ns
        successor = lead.successor(heard_ns, now_ns)
        if successor is not None:
            lead.hand_over(successor)
        self._report()
        self._report_limits()
        # LEAD is sent only after the number is saved: the next run of the client must not begin
        # with a smaller number than the servers know.
        if self.may_tell(now_ns):
            self._tell(lead.doubts(heard_ns, now_ns), heard_ns[lead.leader], step, now_ns)

    def name(self, server: int, *, now_ns: int) -> None:
        """Let a server lead, on an operator's order or after the leader's CLOSE."""
        self.leadership.hand_over(server)
        self._counted_from_ns = now_ns
        self._report()

    def leave(self, server: int, cause: Reason, *, now_ns: int) -> bool:
        """Let another server lead after a fault or the end of a server, if that server led.

        Returns:
            whether another server leads now; otherwise the failsafe has to act on the cause.
        """
        if self.sessions[server].role.is_followed:
            others = [i for i, each in enumerate(self.sessions) if i != server]
            may_lead = filter(self.leadership.may_lead, others)
            ready = [i for i in may_lead if not self.sessions[i].is_lost(now_ns)]
            if cause not in DEPARTURES or not ready:
                return False
            self.name(ready[0], now_ns=now_ns)
        if cause in CLOSING:
            self.sessions[server].close()
        return True

    def obey(self, scenario: Scenario, *, now_ns: int) -> None:
        self.name(NAMES.index(scenario.section(LinkConfig).leader), now_ns=now_ns)

    def objection(self, scenario: Scenario) -> str:
        named = scenario.section(LinkConfig).leader
        server = NAMES.index(named)
        if server >= len(self.sessions):
            return f"{LEADER_KEY}: got {named!r}, expected 'server' without a standby server"
        session = self.sessions[server]
        if not session.role.is_followed and session.is_lost(self._now_ns):
            at = address_text(*session.address)
            return f"{LEADER_KEY}: got {named!r}, but the server at {at} is unreachable"
        if not self.leadership.may_lead(server):
            return f"{LEADER_KEY}: got {named!r}, but {self._limits_differ(server)}"
        return ""

    # -- LEAD messages -----------------------------------------------------------------------

    def _tell(self, doubts: bool, leader_ns: int, step: int, now_ns: int) -> None:
        """Send LEAD to each server that has not answered with the present leadership number.

        Args:
            doubts: whether the leader is silent; LEAD is then sent to the other servers too, whose
                answers show that they are reachable.
            leader_ns: time at which the leader was last heard [ns].
        """
        if doubts and leader_ns != self._silent_since_ns and not self._is_alone(now_ns):
            self._silent_since_ns = leader_ns
            self.failsafe.heard(now_ns=now_ns)  # the other server gets another time-out
        for state, session in zip(self._lead_states, self.sessions, strict=True):
            if session.number is None or now_ns < state.again_ns:
                continue
            asks = doubts and not session.role.is_followed
            if asks or (state.number != self.leadership.number and not session.is_lost(now_ns)):
                again_ns = SOON_NS if asks or session.role.is_followed else SECOND_NS
                state.again_ns, state.asked = now_ns + again_ns, (step, now_ns)
                session.post(self._lead(session, step), now_ns)

    def take(self, server: int, message: Message, now_ns: int) -> bool:
        """Process a LEAD from a server; False for any other message.

        A late answer does no harm, because leadership numbers only rise. An answer shows that the
        server is alive only if the LEAD that it answers was sent recently.
        """
        if not isinstance(message, Lead):
            return False
        state, session = self._lead_states[server], self.sessions[server]
        state.number = max(state.number or 0, message.number)
        self.leadership.hear_limits(server, message.limits, message.changes)
        self.leadership.exceed(message.number, server)
        self.leadership.learn(message.largest, server)
        step, asked_ns = state.asked
        age_ns = now_ns - asked_ns + (step - message.step) * self._dt_ns
        if age_ns <= session.hearing.overtaken_ns:
            session.note_heard(now_ns)
        return True

    def _is_alone(self, now_ns: int) -> bool:
        """Whether no other server that may lead answers."""
        may_lead = filter(self.leadership.may_lead, range(self._count))
        return all(
            self.sessions[i].role.is_followed or self.sessions[i].is_lost(now_ns) for i in may_lead
        )

    def _lead(self, session: ServerSession, step: int) -> Lead:
        assert session.number is not None
        number, leads = self.leadership.number, session.role.is_followed
        message = Lead(self._vehicle, session.number, number, int(leads), step=step)
        motion = self._motion() if leads else None
        if motion is None:
            return message
        return message._replace(in_force=motion.step, spacing=motion.spacing, knots=motion.numbers)

    def _limits_differ(self, server: int) -> LimitsDiffer:
        lead, (host, port) = self.leadership, self.sessions[server].address
        ours, theirs = lead.limits[lead.leader], lead.limits[server]
        assert ours is not None
        assert theirs is not None
        differing = differences(ours, theirs, LIMITS)
        return LimitsDiffer(vehicle=self._vehicle, host=host, port=port, differences=differing)

    def _report_limits(self) -> None:
        """Report each server that may not lead, once for each difference of its limits."""
        for server in range(self._count):
            if self.leadership.may_lead(server):
                self._differing.pop(server, None)
                continue
            event = self._limits_differ(server)
            if self._differing.get(server) != event.differences:
                self._differing[server] = event.differences
                self._events.append(event)

    def _report(self) -> None:
        """Report a new leader, if any; its packets reach the failsafe from now on."""
        if self._reported == self.leadership.number:
            return
        self._reported, session = self.leadership.number, self.followed
        if session.heard_ns is not None:
            self.failsafe.heard(now_ns=max(session.heard_ns, self.failsafe.heard_ns or 0))
        (host, port), number = session.address, self._reported
        self._events.append(
            LeaderChanged(vehicle=self._vehicle, host=host, port=port, number=number)
        )


class OneOfServers(Role):
    """Role of one of several servers; only the leader's packets and faults reach the failsafe.

    Args:
        server: number of the server, from 0.
    """

    def __init__(self, servers: Servers, server: int) -> None:
        self._servers, self._server = servers, server
        self._plan_number = 0
        """Leadership number of the plan that was decoded last."""
        super().__init__(servers.failsafe)
        self.heard, self.malformed, self.meet = self._heard, self._malformed, self._meet

    @property
    def is_followed(self) -> bool:  # type: ignore[override] # changes in flight
        return self._servers.leadership.leader == self._server

    @property
    def may_observe(self) -> bool:  # type: ignore[override] # changes in flight
        """See `Role`: a server that does not know the leader would assume that it leads itself."""
        return self._servers.knows_leader(self._server)

    def decode(self, payload: bytes, terms: Terms) -> Message:
        message, self._plan_number = decode_led(payload, terms)
        return message

    def begin(self) -> None:
        self._servers.begin(self._server)

    def check_plan(self) -> None:
        if not self.is_followed or self._plan_number != self._servers.leadership.number:
            raise ProtocolError(NOT_THE_LEADER)

    def take(self, message: Message, now_ns: int) -> bool:
        return self._servers.take(self._server, message, now_ns)

    def lost_after_ns(self, timeout_ns: int) -> int:
        """See `Role`; less than the time after which a server forgets a session."""
        if self.is_followed:
            return timeout_ns
        return max(timeout_ns, min(LOST_TIMES * timeout_ns, SESSION_NS // 2))

    def _heard(self, *, now_ns: int) -> None:
        if self.is_followed:
            self._servers.failsafe.heard(now_ns=now_ns)

    def _malformed(self, *, now_ns: int) -> None:
        if self.is_followed:
            self._servers.failsafe.malformed(now_ns=now_ns)

    def _meet(self, cause: Reason, *, now_ns: int) -> None:
        if not self._servers.leave(self._server, cause, now_ns=now_ns):
            self._servers.failsafe.meet(cause, now_ns=now_ns)
