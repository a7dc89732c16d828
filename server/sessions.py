"""Sessions of vehicles, each with a row in every array of the server.

A vehicle is welcomed when it says HELLO, and gets its row with its first observation; until then
the session of an earlier life of it goes on. For each vehicle that was welcomed and has no row yet,
one is kept free, but not for longer than WELCOME_NS where another vehicle wants it. As long as a
life of a vehicle is heard, no other life gets its number: that would be another vehicle's. Rows
that are free are used again, lowest first, so that what is in use lies close together.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import islice

import numpy as np

from skytether.server.gate import WayBack
from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.endpoint import Address, Datagram
from skytether.shared.law.heartbeat import NUMBERS, SESSION_NS, Hearing
from skytether.shared.law.model import Indices
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import Hello, Observation, Time

WELCOME_NS = 5 * SECOND_NS
"""Time after its last HELLO for which a welcomed vehicle keeps its place without coming [ns]."""


@dataclass(slots=True)
class Session:
    """Session of one life of a vehicle."""

    vehicle: int
    """Number of the vehicle."""
    number: int
    """Number of the session, named in everything that follows."""
    boot_id: int
    """Number of this life of the vehicle."""
    home: Address
    """Address of its newest HELLO; what is sent there has been shown to arrive."""
    address: Address
    """Address that its newest observation came from."""
    line: WayBack
    """Way to answer it."""
    hearing: Hearing
    """Longest silence that it is asked for."""
    row: int = -1
    """Row of its numbers in every array; -1 until its first observation."""
    heard_ns: int = 0
    """Time of the newest packet from it."""
    sent_ns: int = 0
    """Time of the newest packet to it."""
    doubted: bool = False
    """Whether its newest observation was not believed."""
    stale: int = 0
    """Number of observations that came after a newer one."""
    asked_ns: int = 0
    """Longest silence that it asks of us [ns]; 0 for none."""
    said: int = 0
    """Number of packets said in the session, modulo NUMBERS."""

    def number_next(self, now_ns: int) -> int:
        """Number of a packet that is said now."""
        number = self.said
        self.said, self.sent_ns = (number + 1) % NUMBERS, now_ns
        return number

    def is_heartbeat_due(self, now_ns: int) -> bool:
        """Whether nothing was sent for as long as the vehicle asks."""
        return 0 < self.asked_ns <= now_ns - self.sent_ns

    def sealed(self, payload: bytes) -> Sequence[Datagram]:
        """Datagram that brings the vehicle a message; one each where it may be in two places.

        It may have another address since its HELLO, or somebody may send on copies of its packets
        that come before the packets themselves: it must be heard at home then.
        """
        # Sealed once: with keys the vehicle opens the copy that comes first, and drops the other as
        # repeated.
        packet = self.line.seal(payload)
        if self.address == self.home:
            return (Datagram(packet, self.home),)
        return Datagram(packet, self.address), Datagram(packet, self.home)


class Sessions:
    """The sessions of one life of a server.

    Args:
        room: vehicles at once.
        entropy: makes so many random bytes, of which the numbers of sessions are made.
        silence_ns: time after which a vehicle that is not heard may be taken for gone [ns].
        hearing: makes an ear for each session.
        keeps_rows: whether a row stays that of its vehicle when its session has ended. On a mission
            the others have to keep apart from a vehicle that nobody hears any more.
    """

    def __init__(
        self,
        room: int,
        entropy: Callable[[int], bytes],
        silence_ns: int,
        hearing: Callable[[], Hearing],
        *,
        keeps_rows: bool = False,
    ) -> None:
        self._hearing = hearing
        self._entropy = entropy
        self._silence_ns = silence_ns
        self._live: dict[int, Session] = {}
        """Sessions by vehicle."""
        self.coming: OrderedDict[int, Session] = OrderedDict()
        """Welcomed vehicles without a row, the one that said HELLO longest ago first; never more
        than there are free rows."""
        self._again: dict[int, Session] = {}
        """New lives of vehicles that have a row, until their first observation, by vehicle."""
        self._by_row: dict[int, Session] = {}
        self._free_rows = list(range(room))
        """Rows that are free, a heap."""
        self._keeps_rows = keeps_rows
        self._kept: dict[int, int] = {}
        """Rows of vehicles without a session that keep them, by vehicle."""
        self.rows: Indices = np.zeros(0, dtype=np.int64)
        """Rows in use, rising; shape (n,)."""
        self.vehicle = np.zeros(room, dtype=np.int64)
        """Number of the vehicle in each row; shape (room,)."""
        self.idle = np.zeros(room, dtype=np.int64)
        """Why no plan is made for the vehicle in each row, as it was told last; shape (room,)."""

    def __len__(self) -> int:
        return len(self._live)

    def __iter__(self) -> Iterator[Session]:
        return iter(self._live.values())

    def first(self, count: int) -> list[Session]:
        """First sessions, `count` of them at most."""
        return list(islice(self, count))

    def heartbeats_due(self, now_ns: int) -> list[Session]:
        """Sessions without a packet for as long as their vehicles ask, see `is_heartbeat_due`."""
        return [each for each in self._live.values() if each.is_heartbeat_due(now_ns)]

    def at(self, row: int) -> Session:
        """The session in a row."""
        return self._by_row[row]

    def holder(self, hello: Hello, now_ns: int) -> Session | None:
        """The session of another life that keeps its vehicle's number from the one that says HELLO.

        It is the live one as long as it is heard, else one that was welcomed and may still come.
        """
        live = self._live.get(hello.vehicle)
        if live is not None and live.boot_id == hello.boot_id:
            return None
        if live is not None and self._is_heard(live, now_ns):
            return live
        welcomed = self._waiting(hello.vehicle).get(hello.vehicle)
        if welcomed is None or welcomed.boot_id == hello.boot_id:
            return None
        return welcomed if _is_expected(welcomed, now_ns) else None

    def row_of_other_life(self, hello: Hello) -> int | None:
        """Row of the vehicle that says HELLO, where it is that of another life of its client."""
        live = self._live.get(hello.vehicle)
        if live is None:
            return self._kept.get(hello.vehicle)
        return None if live.boot_id == hello.boot_id else live.row

    def is_full(self, hello: Hello, now_ns: int) -> bool:
        """Whether there is no room for the vehicle that says HELLO."""
        known = self._has_row(hello.vehicle) or hello.vehicle in self.coming
        if known or len(self.coming) < len(self._free_rows):
            return False
        oldest = next(iter(self.coming.values()), None)
        return oldest is None or _is_expected(oldest, now_ns)

    def welcome(self, hello: Hello, address: Address, line: WayBack, now_ns: int) -> Session:
        """The session of the life that says HELLO, a new one or the one it has.

        There must be room for it, if only that of a vehicle that was welcomed and did not come.
        """
        live = self._live.get(hello.vehicle)
        if live is not None and live.boot_id == hello.boot_id:
            live.home = address
            return live
        waiting = self._waiting(hello.vehicle)
        session = waiting.pop(hello.vehicle, None)
        if session is None or session.boot_id != hello.boot_id:
            number, hearing = self._number(), self._hearing()
            session = Session(hello.vehicle, number, hello.boot_id, address, address, line, hearing)
        session.home, session.heard_ns = address, now_ns
        # The one that said HELLO longest ago gives way: `is_full` has found that it is not expected
        # any more.
        if waiting is self.coming and len(waiting) == len(self._free_rows):
            self.coming.popitem(last=False)
        waiting[hello.vehicle] = session
        return session

    def _number(self) -> int:
        """Random number for a new session, always of the same length on the wire."""
        # The highest bit is set, so that msgpack takes five bytes for every number.
        return int.from_bytes(self._entropy(4)) | 2**31

    def _waiting(self, vehicle: int) -> dict[int, Session]:
        """Sessions among which the welcomed one of a vehicle is kept, if it has one."""
        return self._again if self._has_row(vehicle) else self.coming

    def _has_row(self, vehicle: int) -> bool:
        """Whether a row is that of a vehicle."""
        return vehicle in self._live or vehicle in self._kept

    def _is_heard(self, live: Session, now_ns: int) -> bool:
        """Whether a vehicle in session has been heard of late."""
        return now_ns - live.heard_ns <= self._silence_ns

    def find(self, told: Observation | Time) -> Session | None:
        """The live session of what a vehicle tells, if it has one."""
        session = self._live.get(told.vehicle)
        return session if session and session.number == told.session else None

    def begin(self, observation: Observation, now_ns: int) -> Session:
        """The welcomed session of a first observation, now live.

        Raises:
            ProtocolError: there is none, or an earlier life of the vehicle is heard again.
        """
        before = self._live.get(observation.vehicle)
        waiting = self._waiting(observation.vehicle)
        session = waiting.get(observation.vehicle)
        if session is None or session.number != observation.session:
            raise ProtocolError(Drop.UNKNOWN_SESSION)
        # Checked here again: the earlier life may have come back since the WELCOME.
        if before is not None and self._is_heard(before, now_ns):
            raise ProtocolError(Drop.TAKEN)
        del waiting[session.vehicle]
        if before is not None:
            session.row = before.row
        elif session.vehicle in self._kept:
            session.row = self._kept.pop(session.vehicle)
        else:
            # The lowest free row, so that arrays are used from the front.
            session.row = heappop(self._free_rows)
        session.sent_ns = now_ns
        self._live[session.vehicle] = self._by_row[session.row] = session
        self.vehicle[session.row] = session.vehicle
        self._note_rows()
        return session

    def end(self, vehicle: int, number: int) -> None:
        """Forget the live session of a vehicle.

        Raises:
            ProtocolError: it has none with this number.
        """
        session = self._live.get(vehicle)
        if session is None or session.number != number:
            raise ProtocolError(Drop.UNKNOWN_SESSION)
        self._forget(session)

    def expire(self, now_ns: int) -> list[Session]:
        """The sessions that are forgotten now."""
        gone = [each for each in self if now_ns - each.heard_ns > SESSION_NS]
        for session in gone:
            self._forget(session)
        return gone

    def _forget(self, session: Session) -> None:
        del self._live[session.vehicle], self._by_row[session.row]
        if self._keeps_rows:
            self._kept[session.vehicle] = session.row
        else:
            heappush(self._free_rows, session.row)
            # A new life that was waiting for the old one to fall silent takes the free place.
            again = self._again.pop(session.vehicle, None)
            if again is not None:
                self.coming[session.vehicle] = again
        self._note_rows()

    def _note_rows(self) -> None:
        self.rows = np.array(sorted(self._by_row), dtype=np.int64)


def _is_expected(welcomed: Session, now_ns: int) -> bool:
    """Whether the first observation of a welcomed vehicle may still come."""
    return now_ns - welcomed.heard_ns <= WELCOME_NS
