"""Sessions of vehicles; each has a row in every array of the server.

A vehicle is welcomed when it sends HELLO, and gets its row with its first observation; until then
the session of an earlier run of its client continues. A row is kept free for each welcomed vehicle
without a row, but no longer than WELCOME_NS if another vehicle needs it. While observations of one
run of a client arrive, no other run gets the same vehicle number, because the other run may be on
another vehicle. Free rows are reused, lowest first, so that the rows in use are contiguous.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import islice
from typing import Any

import numpy as np

from skytether.server.assignment import Assignment
from skytether.server.gate import ReplyPath
from skytether.server.routes import Route, Routes
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.law.heartbeat import NUMBERS, SESSION_NS, Hearing
from skytether.shared.law.model import Indices
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import Close, Hello, Observation, RoomMessage, Time

InSession = Observation | Close | Time | RoomMessage
"""Messages of a vehicle in a session."""

OTHER_NS = 2 * SECOND_NS
"""Time for which packets are also sent to an address that has repeated a recent packet [ns]."""
WELCOME_NS = 5 * SECOND_NS
"""Time after the last HELLO for which a row is kept for a vehicle without an observation [ns]."""


@dataclass(slots=True)
class Session:
    """Session of one run of a vehicle's client."""

    vehicle: int
    number: int
    """Number of the session, contained in every message."""
    boot_id: int
    """Number of this run of the client, chosen by the client."""
    home: Address
    """Source address of the newest HELLO; a cookie has proven that the client receives there."""
    address: Address
    """Source address of the newest observation."""
    line: ReplyPath
    """Encoder of packets to the vehicle."""
    hearing: Hearing
    """Measured losses, and the longest silence that the server requests of the vehicle."""
    row: int = -1
    """Row of the vehicle in every array; -1 until its first observation."""
    heard_ns: int = 0
    """Time of the newest packet from the vehicle [ns]."""
    sent_ns: int = 0
    """Time of the newest packet to the vehicle [ns]."""
    doubted: bool = False
    """Whether the newest observation was rejected."""
    unsaved: bool = False
    """Whether the client's newest observation reports that its state is unsaved."""
    asked_ns: int = 0
    """Longest silence that the vehicle requests of the server [ns]; 0 for no bound."""
    sent: int = 0
    """Number of packets sent in the session, modulo NUMBERS."""
    other: Address | None = None
    """Address from which a recent packet arrived a second time: either of the two senders may be an
    attacker who forwards copies, and the other one the vehicle."""
    other_ns: int = 0
    """Time of the newest repeated packet from `other` [ns]."""
    socket: int = 0
    """Number of the server's socket that received the vehicle's newest packet."""
    route: Route | None = None
    """Route to the vehicle over several paths; None if it has only one address."""
    lead: Any = None
    """The vehicle's reports of its leader (`SessionLead`); None if it has only this server."""

    def number_next(self, now_ns: int) -> int:
        number = self.sent
        self.sent, self.sent_ns = (number + 1) % NUMBERS, now_ns
        return number

    def is_heartbeat_due(self, now_ns: int) -> bool:
        """Whether the longest silence that the vehicle allows has passed since the last packet."""
        return 0 < self.asked_ns <= now_ns - self.sent_ns

    def sealed(self, payload: bytes, now_ns: int) -> Sequence[Datagram]:
        """Datagrams that carry a message to the vehicle: one datagram, or copies for several
        addresses or paths.

        The vehicle's address may have changed since its HELLO, or an attacker's copies of its
        packets may arrive first. So packets also go to the address of the HELLO, and to the address
        from which packets were repeated.
        """
        if self.route and self.route.is_ready:
            return self.route.sealed(payload, self.line, now_ns)
        # Sealed once: with keys, the vehicle then drops all copies but the first as repeats.
        packet = self.line.seal(payload)
        if self.address == self.home and self.other is None:
            return (Datagram(packet, self.home, self.socket),)
        places = dict.fromkeys((self.address, self.home, self.other or self.home))
        return [Datagram(packet, place, self.socket) for place in places]

    def move(self, address: Address, line: ReplyPath, now_ns: int, socket: int = 0) -> None:
        """Note the source address and the receiving socket of the newest packet."""
        self.address, self.line, self.socket = address, line, socket
        if self.other is not None and now_ns - self.other_ns > OTHER_NS:
            self.other = None


class Sessions:
    """Sessions of one run of the server.

    Args:
        entropy: function that returns a number of random bytes, for the numbers of sessions.
        silence_ns: time after which a silent vehicle may count as gone [ns].
        hearing: function that makes the `Hearing` of a session.
        assignment: chooses the vehicles that the server plans for.
        keeps_rows: whether a row stays reserved for its vehicle after its session, as on a mission,
            where the other vehicles avoid a silent vehicle.
    """

    def __init__(
        self,
        capacity: int,
        entropy: Callable[[int], bytes],
        silence_ns: int,
        hearing: Callable[[], Hearing],
        assignment: Assignment,
        *,
        keeps_rows: bool = False,
    ) -> None:
        self._hearing = hearing
        self.entropy = entropy
        self._silence_ns = silence_ns
        self._live: dict[int, Session] = {}
        """Live sessions, by number of the vehicle."""
        self.welcomed_vehicles: OrderedDict[int, Session] = OrderedDict()
        """Welcomed vehicles without a row, oldest HELLO first; at most as many as free rows."""
        self._successors: dict[int, Session] = {}
        """Sessions of new client runs of vehicles with a row, until their first observation."""
        self._by_row: dict[int, Session] = {}
        self._free_rows = list(range(capacity))
        """Free rows, as a heap."""
        self._keeps_rows = keeps_rows
        self._reserved: dict[int, int] = {}
        """Rows reserved for vehicles without a session, by vehicle."""
        self.rows: Indices = np.zeros(0, dtype=np.int64)
        """Rows in use, ascending; shape (n,)."""
        self.vehicle = np.zeros(capacity, dtype=np.int64)
        """Number of the vehicle in each row; shape (capacity,)."""
        self.stale = np.zeros(capacity, dtype=np.int64)
        """Number of observations of each session that arrived after a newer observation; shape
        (capacity,)."""
        self.routes = Routes()
        """Routes to the vehicles; replaced once a vehicle has several paths."""
        self.assignment = assignment
        """Choice of the vehicles that the server plans for."""
        self.idle = np.zeros(capacity, dtype=np.int64)
        """`Idle` reason of the vehicle in each row, as last reported; shape (capacity,)."""

    def __len__(self) -> int:
        return len(self._live)

    def __iter__(self) -> Iterator[Session]:
        return iter(self._live.values())

    def first(self, count: int) -> list[Session]:
        return list(islice(self, count))

    def heartbeats_due(self, now_ns: int) -> list[Session]:
        return [session for session in self._live.values() if session.is_heartbeat_due(now_ns)]

    def live(self, vehicle: int) -> Session | None:
        return self._live.get(vehicle)

    def at(self, row: int) -> Session:
        return self._by_row[row]

    def holder(self, hello: Hello, now_ns: int) -> Session | None:
        """Session of another run with the vehicle's number, because of which this HELLO is refused.

        It is the live session while packets of this session arrive; otherwise a welcomed session
        whose first observation may still arrive.
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
        """Row of the HELLO's vehicle, if the row may belong to another run of its client.

        A client that cannot save its state may have restarted from an older state with the same
        boot id.
        """
        live = self._live.get(hello.vehicle)
        if live is None:
            return self._reserved.get(hello.vehicle)
        return None if live.boot_id == hello.boot_id and not live.unsaved else live.row

    def is_full(self, hello: Hello, now_ns: int) -> bool:
        """Whether there is no row for the vehicle that sends this HELLO."""
        has_place = self._has_row(hello.vehicle) or hello.vehicle in self.welcomed_vehicles
        if has_place or len(self.welcomed_vehicles) < len(self._free_rows):
            return False
        oldest = next(iter(self.welcomed_vehicles.values()), None)
        return oldest is None or _is_expected(oldest, now_ns)

    def welcome(
        self, hello: Hello, address: Address, line: ReplyPath, now_ns: int, socket: int = 0
    ) -> Session:
        """Session of the sender of a HELLO, present or new; `is_full` must be False."""
        live = self._live.get(hello.vehicle)
        if live is not None and live.boot_id == hello.boot_id:
            live.home = address
            return live
        waiting = self._waiting(hello.vehicle)
        session = waiting.pop(hello.vehicle, None)
        if session is None or session.boot_id != hello.boot_id:
            number, hearing = self._number(), self._hearing()
            session = Session(hello.vehicle, number, hello.boot_id, address, address, line, hearing)
        session.home, session.heard_ns, session.socket = address, now_ns, socket
        # The oldest welcomed vehicle loses its row. It has been silent for so long that `is_full`
        # expects no observation from it.
        if waiting is self.welcomed_vehicles and len(waiting) == len(self._free_rows):
            self.welcomed_vehicles.popitem(last=False)
        waiting[hello.vehicle] = session
        return session

    def _number(self) -> int:
        """Random number of a new session, always of the same length on the wire."""
        # The highest bit is set, so that msgpack uses five bytes for every number.
        return int.from_bytes(self.entropy(4)) | 2**31

    def _waiting(self, vehicle: int) -> dict[int, Session]:
        return self._successors if self._has_row(vehicle) else self.welcomed_vehicles

    def _has_row(self, vehicle: int) -> bool:
        return vehicle in self._live or vehicle in self._reserved

    def _is_heard(self, live: Session, now_ns: int) -> bool:
        return now_ns - live.heard_ns <= self._silence_ns

    def welcomed(self, message: RoomMessage) -> Session | None:
        """Session of a message, even if its vehicle has no row yet."""
        waiting = self._waiting(message.vehicle).get(message.vehicle)
        for session in (self._live.get(message.vehicle), waiting):
            if session and session.number == message.session:
                return session
        return None

    def find(self, message: InSession) -> Session | None:
        session = self._live.get(message.vehicle)
        return session if session and session.number == message.session else None

    def begin(self, observation: Observation, now_ns: int) -> Session:
        """Make the welcomed session of a first observation the live session, and return it.

        Raises:
            ProtocolError: there is no such session, or an earlier run of the client is active.
        """
        before = self._live.get(observation.vehicle)
        waiting = self._waiting(observation.vehicle)
        session = waiting.get(observation.vehicle)
        if session is None or session.number != observation.session:
            raise ProtocolError(Drop.UNKNOWN_SESSION)
        # This is checked again, because the earlier run may have returned since the WELCOME.
        if before is not None and self._is_heard(before, now_ns):
            raise ProtocolError(Drop.TAKEN)
        del waiting[session.vehicle]
        if before is not None:
            self.routes.forget(before)
            session.row = before.row
        elif session.vehicle in self._reserved:
            session.row = self._reserved.pop(session.vehicle)
        else:
            # The lowest free row, so that the rows in use are contiguous.
            session.row = heappop(self._free_rows)
        session.sent_ns = now_ns
        self._live[session.vehicle] = self._by_row[session.row] = session
        self.vehicle[session.row], self.stale[session.row] = session.vehicle, 0
        self._note_rows()
        return session

    def expire(self, now_ns: int) -> list[Session]:
        """End the sessions of silent vehicles, and return these sessions."""
        gone = [each for each in self if now_ns - each.heard_ns > SESSION_NS]
        for session in gone:
            self.end(session)
        return gone

    def end(self, session: Session) -> None:
        del self._live[session.vehicle], self._by_row[session.row]
        self.routes.forget(session)
        if self._keeps_rows:
            self._reserved[session.vehicle] = session.row
        else:
            heappush(self._free_rows, session.row)
            # The row goes to a new run of the client that was waiting until the earlier run ended.
            successor = self._successors.pop(session.vehicle, None)
            if successor is not None:
                self.welcomed_vehicles[session.vehicle] = successor
        self._note_rows()

    def _note_rows(self) -> None:
        self.rows = np.array(sorted(self._by_row), dtype=np.int64)


def _is_expected(welcomed: Session, now_ns: int) -> bool:
    return now_ns - welcomed.heard_ns <= WELCOME_NS
