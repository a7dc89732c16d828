"""Leadership: which of its servers plans for a vehicle.

The vehicle decides, by a number that only rises: with s servers, number n means that server n mod s
leads, and what was planned under another number is not flown. The vehicle raises it when the leader
is silent and another server is heard; when an operator says so; and on a mission when a server that
it hears has received a larger number from another vehicle, so that all then follow one server.
On a mission it follows no server that plans within other limits than the one that leads.
"""

from collections.abc import Sequence

from skytether.shared.law.limits import Limits

NUMBER_MAX, JUMP_MAX = 2**32 - 1, 10_000
"""Largest number, and largest rise at once to a number that a server sends."""
ASK_SHARE, CHANGE_SHARE = 0.35, 0.75
"""Shares of the time-out for which the leader has to be silent before another server is asked
whether it is there, and before it leads. The first is just more than the time between heartbeats
over a good link: every tenth of a second counts, since the plan in force ends."""


class Leadership:
    """Number of the leadership.

    Args:
        servers: number of servers, 1 or more.
        number: number of an earlier run of the client.
        timeout_ns: silence after which the vehicle takes a server for lost [ns].
    """

    def __init__(self, servers: int, number: int, timeout_ns: int) -> None:
        self._servers, self.number = servers, number
        self._ask_ns = round(ASK_SHARE * timeout_ns)
        self._change_ns = round(CHANGE_SHARE * timeout_ns)
        self.limits: list[Limits | None] = [None] * servers
        """Limits of each server's motions, as it last sent them; None before that, or without a
        mission."""
        self._changes = [0] * servers
        """Number of changes of these limits in the server's run, as it last sent it."""

    @property
    def leader(self) -> int:
        """Which server leads, from 0."""
        return self.number % self._servers

    def begin(self, server: int) -> None:
        """Begin a session with another run of a server, which counts its changes anew."""
        self._changes[server] = 0

    def hear_limits(self, server: int, limits: Limits | None, changes: int) -> None:
        """Note the limits that a server sent, unless later ones have arrived."""
        if changes >= self._changes[server]:
            self._changes[server], self.limits[server] = changes, limits

    def may_lead(self, server: int) -> bool:
        """Whether a server plans within the limits of the present leader, as far as is known."""
        theirs, ours = self.limits[server], self.limits[self.leader]
        return theirs is None or ours is None or theirs == ours

    def doubts(self, heard_ns: Sequence[int], now_ns: int) -> bool:
        """Whether the leader is silent for so long that other servers are to be asked.

        Args:
            heard_ns: when each server was last heard.
        """
        return now_ns - heard_ns[self.leader] >= self._ask_ns

    def successor(self, heard_ns: Sequence[int], now_ns: int) -> int | None:
        """Server that is to lead in place of a silent leader; None if the leader is not silent, or
        no other server is heard that may lead.
        """
        last_ns = heard_ns[self.leader]
        if now_ns - last_ns < self._change_ns:
            return None
        newest = max(filter(self.may_lead, range(self._servers)), key=heard_ns.__getitem__)
        # Only one that was heard since the leader was doubted: both may be out of reach.
        return newest if heard_ns[newest] >= last_ns + self._ask_ns else None

    def hand_over(self, server: int) -> None:
        """Let a server lead from now on; no effect if it leads, or once no number is left."""
        raised = self.number + (server - self.number) % self._servers
        if raised <= NUMBER_MAX:
            self.number = raised

    def exceed(self, number: int, server: int) -> None:
        """Let `server` lead, if it may, with a number above one that it received from an earlier
        run of this vehicle, which has not saved it.
        """
        if self.number < number <= NUMBER_MAX - self._servers:
            leads = server if self.may_lead(server) else self.leader
            self.number = number + 1
            self.hand_over(leads)

    def learn(self, number: int, server: int) -> bool:
        """Take over a larger number from a server that leads with it, if it may lead."""
        is_larger = self.number < number <= min(NUMBER_MAX, self.number + JUMP_MAX)
        if not is_larger or number % self._servers != server or not self.may_lead(server):
            return False
        self.number = number
        return True
