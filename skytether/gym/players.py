"""Players: the robot's end of a link, which decides what is played at each step of the environment.

An agent sends chunks: rows of actions for coming steps. Packets are late, lost and overtaken, so
the robot needs a rule for the row of the present step. `Clocked` is Skytether's. `Newest`, `Queue`
and `Freshest` are what is common elsewhere, from public descriptions, to compare with.

A player stores tuples only: a copy of one is a snapshot of what the robot holds.
"""

from abc import ABC, abstractmethod
from typing import Any, Literal, NamedTuple

from numpy.typing import NDArray

from skytether.shared.base.errors import ConfigError

Row = NDArray[Any]
"""Action of one step; of a Dict or a Tuple a record, see `gym.spaces`."""

HELD_MAX = 16
"""Largest number of chunks that a player holds; the oldest are dropped."""
ROWS_HELD_MAX = 4096
"""Largest number of rows that `Freshest` holds; the last are dropped."""
NEWER_WEIGHT = 0.7
"""Weight of the newer row in an average, as LeRobot's default."""


class Chunk(NamedTuple):
    """Answer of an agent."""

    rows: NDArray[Any]
    """Actions of successive steps; shape (n, *row). With n = 0 nothing is sent."""
    first: int | None = None
    """Step of the first row, as the player counts steps; None: that of the observation shown."""
    thought_ns: int | None = None
    """Time that the answer took [ns], to replay a run; None: by the wrapper's `thinking`."""


class Held(NamedTuple):
    """Chunk that has arrived."""

    generation: int
    """Number of the chunk, rising in the order of sending."""
    first: int
    rows: NDArray[Any]


class Player(ABC):
    def __init__(self) -> None:
        self.held: tuple[Held, ...] = ()
        """Chunks with rows that may still be played, the newest generation first."""
        self.last: Row | None = None
        """Row to hold when rows have run out; None before the first."""

    def __copy__(self) -> "Player":
        # Three copies a step: the general way of `copy` takes ten times as long.
        made = object.__new__(type(self))
        made.__dict__.update(self.__dict__)
        return made

    def number(self, step: int) -> int:
        """Number that the robot gives to a step when it reports an observation."""
        return step

    @abstractmethod
    def accept(self, chunk: Held, step: int) -> None:
        """Accept a chunk that arrives before the row of `step` is played."""

    @abstractmethod
    def row(self, step: int) -> Row | None:
        """Row to play at a step, called once for each step; None if rows have run out."""


class Clocked(Player):
    """Plays the row of the present step, of the newest generation that has one."""

    def accept(self, chunk: Held, step: int) -> None:
        if any(each.generation == chunk.generation for each in self.held):
            return  # a copy
        left = [each for each in self.held if each.first + len(each.rows) > step]
        if self.held and not left:
            left = [self.held[0]]  # its last row may be held
        newest_first = sorted([*left, chunk], key=lambda each: -each.generation)
        self.held = tuple(newest_first[:HELD_MAX])

    def row(self, step: int) -> Row | None:
        newest = None
        for _, first, rows in self.held:
            if 0 <= step - first < len(rows):
                self.last = rows[step - first]
                return self.last
            if newest is None and first <= step:
                newest = rows
        if newest is not None:
            self.last = newest[-1]
        return None


class Newest(Player):
    """Holds the first row of the newest chunk until a newer one arrives."""

    def accept(self, chunk: Held, step: int) -> None:  # noqa: ARG002
        if not self.held or chunk.generation > self.held[0].generation:
            self.held = (chunk,)

    def row(self, step: int) -> Row | None:  # noqa: ARG002
        if self.held:
            self.last = self.held[0].rows[0]
        return self.last


class Queue(Player):
    """Queue of rows, played one after the other, as LeRobot's asynchronous inference has it.

    Steps are counted by rows played, not by the clock: while the queue is empty, the count stands
    still. Of a chunk that arrives, rows up to the count are skipped, the others take the place of
    the queue; where both have a row, the newer replaces the older, or they are averaged.

    Args:
        merge: what happens where both have a row.

    Raises:
        ConfigError: rows that are no real numbers, as of a Discrete, are to be averaged.
    """

    def __init__(self, merge: Literal["replace", "average"] = "replace") -> None:
        super().__init__()
        self.merge = merge
        self.played = 0

    def number(self, step: int) -> int:  # noqa: ARG002
        return self.played

    def accept(self, chunk: Held, step: int) -> None:  # noqa: ARG002
        rows = chunk.rows[max(0, self.played - chunk.first) :]
        first = max(chunk.first, self.played)
        if self.merge == "average" and rows.dtype.kind != "f":
            expected = "real numbers: those of a Box, or merge='replace'"
            raise ConfigError(f"player: got rows of {rows.dtype} to average, expected {expected}")
        if self.merge == "average" and self.held:
            queued = self.held[0]
            rows = rows.copy()
            low = max(first, queued.first)
            high = min(first + len(rows), queued.first + len(queued.rows))
            if low < high:
                older = queued.rows[low - queued.first : high - queued.first]
                newer = rows[low - first : high - first]
                rows[low - first : high - first] = (1 - NEWER_WEIGHT) * older + NEWER_WEIGHT * newer
        self.held = (Held(chunk.generation, first, rows),)

    def row(self, step: int) -> Row | None:  # noqa: ARG002
        if not self.held or not len(self.held[0].rows):
            return None
        generation, first, rows = self.held[0]
        self.held = (Held(generation, first + 1, rows[1:]),)
        self.played += 1
        self.last = rows[0]
        return self.last


class Freshest(Player):
    """Schedule of rows, of each step the freshest, as DRTC (distributed real-time chunking) has it.

    Steps are counted by rows played, as in `Queue`. A chunk that is not newer than the newest so
    far is ignored. Of a newer one, rows that were played are skipped; the others replace those of
    the same steps, and rows of other steps stay.
    """

    def __init__(self) -> None:
        super().__init__()
        self.newest = 0
        self.played = 0

    def number(self, step: int) -> int:  # noqa: ARG002
        return self.played

    def accept(self, chunk: Held, step: int) -> None:  # noqa: ARG002
        generation, first, rows = chunk
        if generation <= self.newest:
            return
        self.newest = generation
        by_number = {each.first: each for each in self.held}
        for at in range(max(first, self.played), first + len(rows)):
            by_number[at] = Held(generation, at, rows[at - first : at - first + 1])
        self.held = tuple(by_number[at] for at in sorted(by_number)[:ROWS_HELD_MAX])

    def row(self, step: int) -> Row | None:  # noqa: ARG002
        if not self.held:
            return None
        (_, number, rows), *_ = self.held
        self.held, self.played, self.last = self.held[1:], number + 1, rows[0]
        return self.last
