"""Leadership: the choice of the server that plans for a vehicle.

The vehicle decides by its leadership number, which only rises: with s servers, number n means that
server n mod s leads, and plans made under another number are not flown. The vehicle raises the
number when the leader is silent and another server answers; on an operator's order; and on a
mission when a server reports another vehicle's larger number, so that all follow one server. On a
mission it follows no server whose motions have other limits than the leader's.
"""

from collections.abc import Sequence

from skytether.shared.law.limits import Limits

NUMBER_MAX, JUMP_MAX = 2**32 - 1, 10_000
"""Largest leadership number, and largest increase by which a number reported by a server is
adopted."""
ASK_SHARE, CHANGE_SHARE = 0.35, 0.75
"""Shares of the time-out for which the leader has to be silent before the vehicle sends LEAD to
another server, and before that server leads. The first share is small, just above the interval of
heartbeats over a good link, because the plan in force soon ends."""


class Leadership:
    """Leadership number of a vehicle, and the rules by which it rises.

    Args:
        servers: number of servers, 1 or more.
        number: leadership number of an earlier run of the client; 0 without one.
        timeout_ns: silence after which the vehicle considers a server lost [ns].
    """

    def __init__(self, servers: int, number: int, timeout_ns: int) -> None:
        self._servers, self.number = servers, number
        self._ask_ns = round(ASK_SHARE * timeout_ns)
        self._change_ns = round(CHANGE_SHARE * timeout_ns)
        self.limits: list[Limits | None] = [None] * servers
        """Limits of each server's motions, as last received; None if not received, or without a
        mission."""
        self._changes = [0] * servers
        """Number of changes of `limits` since each server's start, as last received."""

    @property
    def leader(self) -> int:
        """Number of the leading server, from 0."""
        return self.number % self._servers

    def begin(self, server: int) -> None:
        """Begin a session with another run of a server, whose count of changes starts at 0."""
        self._changes[server] = 0

    def hear_limits(self, server: int, limits: Limits | None, changes: int) -> None:
        """Note the limits that a server sent, unless later limits have already arrived."""
        if changes >= self._changes[server]:
            self._changes[server], self.limits[server] = changes, limits

    def may_lead(self, server: int) -> bool:
        """Whether a server's limits equal the leader's, as far as both are known."""
        theirs, ours = self.limits[server], self.limits[self.leader]
        return theirs is None or ours is None or theirs == ours

    def doubts(self, heard_ns: Sequence[int], now_ns: int) -> bool:
        """Whether the leader has been silent for ASK_SHARE of the time-out.

        Args:
            heard_ns: time of the newest packet of each server [ns].
        """
        return now_ns - heard_ns[self.leader] >= self._ask_ns

    def successor(self, heard_ns: Sequence[int], now_ns: int) -> int | None:
        """Server that replaces a silent leader. None if the leader is not silent, or if no server
        that is allowed to lead was heard after the leader fell silent.
        """
        last_ns = heard_ns[self.leader]
        if now_ns - last_ns < self._change_ns:
            return None
        newest = max(filter(self.may_lead, range(self._servers)), key=heard_ns.__getitem__)
        # A server last heard before the leader fell silent may be unreachable for the same reason.
        return newest if heard_ns[newest] >= last_ns + self._ask_ns else None

    def hand_over(self, server: int) -> None:
        """Let a server lead from now on; no effect if it leads already or no number is left."""
        raised = self.number + (server - self.number) % self._servers
        if raised <= NUMBER_MAX:
            self.number = raised

    def exceed(self, number: int, server: int) -> None:
        """Raise the number above `number`, which an earlier run of the client sent but did not
        save, and let `server` lead if it may.
        """
        if self.number < number <= NUMBER_MAX - self._servers:
            leads = server if self.may_lead(server) else self.leader
            self.number = number + 1
            self.hand_over(leads)

    def learn(self, number: int, server: int) -> bool:
        """Adopt a larger number that makes its sender `server` the leader, if it may lead."""
        is_larger = self.number < number <= min(NUMBER_MAX, self.number + JUMP_MAX)
        if not is_larger or number % self._servers != server or not self.may_lead(server):
            return False
        self.number = number
        return True
