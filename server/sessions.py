"""Who flies: sessions of vehicles, each with a row in every array of the server.

A vehicle is welcomed when it says HELLO, and gets its row with its first observation; until then
the session of an earlier life of it goes on. Rows that are free are used again, lowest first, so
that what is in use lies close together.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import islice

import numpy as np

from shared.endpoint import SECOND_NS, Address
from shared.model import Indices
from shared.protocol import Hello, Observation, ProtocolError

SESSION_NS = 30 * SECOND_NS
"""A vehicle unheard for so long is forgotten [ns]."""


@dataclass(slots=True)
class Session:
    """One life of one vehicle."""

    vehicle: int
    """Number of the vehicle."""
    number: int
    """Number of the session, named in everything that follows."""
    boot_id: int
    """Number of this life of the vehicle."""
    address: Address
    """Where its newest observation came from."""
    row: int = -1
    """Where its numbers lie in every array; -1 until its first observation."""
    observed_ns: int = -1
    """Stamp of its newest observation [vehicle's clock]."""
    heard_ns: int = 0
    """When something was heard of it last."""
    sent_ns: int = 0
    """When something was sent to it last."""
    stale: int = 0
    """Number of observations that came after a newer one."""


class Sessions:
    """The sessions of one life of a server.

    Args:
        room: vehicles at once.
        first: the number before that of the first session.
    """

    def __init__(self, room: int, first: int) -> None:
        self._room = room
        self._opened = first
        self._live: dict[int, Session] = {}
        """Sessions by vehicle."""
        self.welcomed: dict[int, Session] = {}
        """New lives of vehicles, until their first observation, by vehicle."""
        self._by_row: dict[int, Session] = {}
        self._free_rows = list(range(room))
        """Rows that are free, a heap."""
        self.rows: Indices = np.zeros(0, dtype=np.int64)
        """Rows in use, rising; shape (n,)."""
        self.vehicle = np.zeros(room, dtype=np.int64)
        """Number of the vehicle in each row; shape (room,)."""

    def __len__(self) -> int:
        return len(self._live)

    def __iter__(self) -> Iterator[Session]:
        return iter(self._live.values())

    def first(self, count: int) -> list[Session]:
        """So many of the sessions."""
        return list(islice(self, count))

    def at(self, row: int) -> Session:
        """The session in a row."""
        return self._by_row[row]

    def welcome(self, hello: Hello, address: Address) -> Session:
        """The session of the life that says HELLO, a new one or the one it has.

        Raises:
            ProtocolError: there is no room for another vehicle.
        """
        for known in (self._live, self.welcomed):
            session = known.get(hello.vehicle)
            if session is not None and session.boot_id == hello.boot_id:
                return session
        taken = self._live.keys() | self.welcomed.keys()
        if hello.vehicle not in taken and len(taken) >= self._room:
            if not self.welcomed:
                raise ProtocolError("no room for another vehicle")
            del self.welcomed[next(iter(self.welcomed))]  # the oldest that never came
        self._opened += 1
        session = Session(hello.vehicle, self._opened % 2**32, hello.boot_id, address)
        self.welcomed[hello.vehicle] = session
        return session

    def find(self, observation: Observation) -> Session | None:
        """The live session of an observation, if it has one."""
        session = self._live.get(observation.vehicle)
        return session if session and session.number == observation.session else None

    def begin(self, observation: Observation, now_ns: int) -> Session:
        """The welcomed session of a first observation, now live.

        Raises:
            ProtocolError: there is none.
        """
        session = self.welcomed.get(observation.vehicle)
        if session is None or session.number != observation.session:
            raise ProtocolError("unknown session")
        del self.welcomed[session.vehicle]
        before = self._live.get(session.vehicle)
        session.row = heappop(self._free_rows) if before is None else before.row
        session.sent_ns = now_ns
        self._live[session.vehicle] = self._by_row[session.row] = session
        self.vehicle[session.row] = session.vehicle
        self._note_rows()
        return session

    def expire(self, now_ns: int) -> list[Session]:
        """The sessions that are forgotten now."""
        gone = [each for each in self if now_ns - each.heard_ns > SESSION_NS]
        for session in gone:
            del self._live[session.vehicle], self._by_row[session.row]
            heappush(self._free_rows, session.row)
        if gone:
            self._note_rows()
        return gone

    def _note_rows(self) -> None:
        self.rows = np.array(sorted(self._by_row), dtype=np.int64)
