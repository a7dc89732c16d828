"""Leaders of vehicles that have two servers: each vehicle's reports of its leader (LEAD), and the
leadership number in every plan, see docs/together-proof.md.

`AssignmentOfTwo` replaces `server.assignment.Assignment` at the first LEAD (`server.reception`); a
server in real time loads this module before its first packet.
"""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

from skytether.server.assignment import Assignment
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.wire.lead import Lead, with_leadership
from skytether.shared.wire.protocol import Message, encode

TAKEOVER_PLANS = 2
"""Number of plans that a server sends when it takes over, independently of the trigger."""
LIMITS_NS = 10 * SECOND_NS
"""Time for which changed limits of motions are sent to vehicles every second [ns]."""


class SessionLead(NamedTuple):
    """A vehicle's reports of its leader in a session."""

    lead: Lead
    """The vehicle's LEAD with the largest leadership number so far."""
    step: int
    """Step in the vehicle's newest LEAD."""


class AssignmentOfTwo(Assignment):
    """Assignment that replaces the plain `Assignment` of a server at the first LEAD."""

    def __init__(self, plain: Assignment) -> None:
        super().__init__(plain.controller, plain.limits)
        self.changes, self.changed_ns = plain.changes, plain.changed_ns
        self._largest = 0
        """Largest leadership number that a vehicle has reported."""

    def of_several(self) -> Assignment:
        return self

    def begin(self, session: Any) -> None:
        said: SessionLead | None = session.lead
        self._note(session.row, said.lead if said else None)

    def take(self, session: Any, message: Message) -> Message:
        """Note which server leads a vehicle; repeats of a leadership number are ignored."""
        assert isinstance(message, Lead)
        said: SessionLead | None = session.lead
        if said is None or message.number > said.lead.number:
            session.lead = SessionLead(message, message.step if said is None else said.step)
            if session.row >= 0:
                self._note(session.row, message)
        session.lead = session.lead._replace(step=max(session.lead.step, message.step))
        return self._answer(session)

    def signed(self, session: Any, plan: bytes) -> bytes:
        said: SessionLead | None = session.lead
        return with_leadership(said.lead.number, plan) if said else plan

    def spread(self, sessions: Iterable[Any], now_ns: int) -> Iterator[Datagram]:
        """Send the largest leadership number to vehicles that follow a smaller number. For a while
        after a change of the motions' limits, send these limits to all vehicles.
        """
        is_changed = self.changed_ns is not None and now_ns < self.changed_ns + LIMITS_NS
        for session in sessions:
            said: SessionLead | None = session.lead
            if said and (is_changed or self._number(said) > said.lead.number):
                yield from session.sealed(encode(self._answer(session)), now_ns)

    def _note(self, row: int, lead: Lead | None) -> None:
        """Note a vehicle's LEAD; `lead` is None if the vehicle has only this server.

        A server that takes over from another sends two plans: the vehicle may be about to brake,
        and a plan may be lost. Vehicles of a mission hold their position instead.
        """
        leads = lead is None or bool(lead.leads)
        self._largest = max(self._largest, lead.number if lead else 0)
        takes_over = leads and lead and lead.number and self.limits is None
        self.controller.assign(
            row, lead, is_own=leads, plans_due=TAKEOVER_PLANS if takes_over else 0
        )

    def _number(self, said: SessionLead) -> int:
        """Leadership number that a vehicle should follow: the largest, if all vehicles have to
        follow one server.
        """
        return self._largest if self.limits else said.lead.number

    def _answer(self, session: Any) -> Lead:
        """LEAD with the vehicle's leadership number, the leadership number that the vehicle should
        follow, and the limits of the server's motions.
        """
        said: SessionLead = session.lead
        return Lead(
            session.vehicle,
            session.number,
            said.lead.number,
            said.lead.leads,
            self._number(said),
            said.step,
            limits=self.limits,
            changes=self.changes,
        )
