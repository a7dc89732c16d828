"""Players: rules at the robot's end of the link that choose the action of each step.

An agent sends chunks: rows of actions for coming steps. Packets are late, lost and overtaken, so
the robot needs a rule for the row of the present step. `Clocked` is Skytether's. `Newest`, `Queue`
and `Freshest`, for comparison, are common rules of other projects, from public descriptions.

A player stores only tuples, so that a shallow copy is a snapshot of what the robot holds.
"""

from abc import ABC, abstractmethod
from typing import Any, Literal, NamedTuple

from numpy.typing import NDArray

from skytether.shared.base.errors import ConfigError

Row = NDArray[Any]
"""Action of one step; a record for a Dict or Tuple space, see `gym.spaces`."""

HELD_MAX = 16
"""Largest number of chunks that a player holds; the oldest are dropped."""
ROWS_HELD_MAX = 4096
"""Largest number of rows that `Freshest` holds; the last are dropped."""
NEWER_WEIGHT = 0.7
"""Weight of the newer row in an average: LeRobot's default."""


class Chunk(NamedTuple):
    """Answer of an agent."""

    rows: NDArray[Any]
    """Actions of successive steps; shape (n, *row). With n = 0 nothing is sent."""
    first: int | None = None
    """Step of the first row, as the player counts steps; None: the newest observation's step."""
    thought_ns: int | None = None
    """Thinking time of the answer [ns], to replay a run; None: from the wrapper's `thinking`."""


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
        """Row to repeat when rows have run out; None before the first."""

    def __copy__(self) -> "Player":
        # Called three times per step; the default `copy` takes ten times as long.
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
    """Player that plays the present step's row, from the newest chunk that has this row."""

    def accept(self, chunk: Held, step: int) -> None:
        if any(each.generation == chunk.generation for each in self.held):
            return  # a duplicate
        left = [each for each in self.held if each.first + len(each.rows) > step]
        if self.held and not left:
            left = [self.held[0]]  # its last row may be repeated
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
    """Player that repeats the first row of the newest chunk until a newer chunk arrives."""

    def accept(self, chunk: Held, step: int) -> None:  # noqa: ARG002
        if not self.held or chunk.generation > self.held[0].generation:
            self.held = (chunk,)

    def row(self, step: int) -> Row | None:  # noqa: ARG002
        if self.held:
            self.last = self.held[0].rows[0]
        return self.last


class Queue(Player):
    """Player that plays a queue of rows in order, as in LeRobot's asynchronous inference.

    Steps are counted by rows played, not by the clock: the count stops while the queue is empty.
    When a chunk arrives, its rows up to the count are skipped, and the others replace the queue; if
    both have a row for a step, the newer one is played, or an average.

    Args:
        merge: rule for steps with an older and a newer row.

    Raises:
        ConfigError: rows are to be averaged, but are not real numbers, as in a Discrete space.
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
    """Player that plays the newest row of each step, as in DRTC (distributed real-time chunking).

    Steps are counted by rows played, as in `Queue`. A chunk older than the newest so far is
    ignored. Rows of a newer chunk replace rows of the same steps, except steps that were played;
    rows of other steps stay.
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
