"""Players: rules at the robot end that choose the row (action) to execute at each control step.

A policy sends action chunks: rows for successive steps. Chunks arrive late, out of order or not at
all, so the robot needs a rule that chooses the row of the present step. `Clocked` is Skytether's.
`Newest`, `Queue` and `Freshest` are rules of other projects, for comparison, implemented from
public descriptions.

A player stores only tuples, so that a shallow copy is a snapshot of its state.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import copy
from functools import partial
from typing import Any, Literal, NamedTuple

from numpy.typing import NDArray

from skytether.shared.base.errors import ConfigError

Row = NDArray[Any]
"""Action of one control step; a structured array for a Dict or Tuple space, see `gym.spaces`."""

HELD_MAX = 16
"""Largest number of chunks that a player stores; the oldest are discarded."""
ROWS_HELD_MAX = 4096
"""Largest number of rows that `Freshest` stores; the rows of the latest steps are discarded."""
NEWER_WEIGHT = 0.7
"""Weight of the newer row in an average; the default of LeRobot."""


class Chunk(NamedTuple):
    """Action chunk of a policy."""

    rows: NDArray[Any]
    """Actions of successive steps; shape (n, *row). With n = 0 no chunk is sent."""
    first: int | None = None
    """Step of the first row, as the player counts steps; None: step of the newest observation."""
    thought_ns: int | None = None
    """Computation time of the chunk [ns]; give it to repeat an earlier run. None: measured or drawn
    as the environment's option `thinking` says."""


class Held(NamedTuple):
    """Received chunk."""

    generation: int
    """Number of the chunk, increasing in the order of sending."""
    first: int
    """Step of the first row, as the player counts steps."""
    rows: NDArray[Any]


class Player(ABC):
    """Rule that chooses the row to execute at each control step."""

    settled: tuple[Row | None, ...] = ()
    """Rows of the next steps that later chunks do not change."""

    def __init__(self) -> None:
        self.held: tuple[Held, ...] = ()
        """Chunks with rows that may still be executed."""
        self.last: Row | None = None
        """Row to repeat when no row remains; None before the first row."""

    def __copy__(self) -> "Player":
        # Called three times per step; the default `copy` takes ten times as long.
        made = object.__new__(type(self))
        made.__dict__.update(self.__dict__)
        return made

    def number(self, step: int) -> int:
        """Number of a step as the player counts steps; sent with an observation."""
        return step

    @abstractmethod
    def accept(self, chunk: Held, step: int) -> None:
        """Accept a chunk that arrives before the row of `step` is executed."""

    @abstractmethod
    def row(self, step: int) -> Row | None:
        """Row to execute at a step, called once per step; None if no row remains."""


class Clocked(Player):
    """Player that executes the row of the newest chunk whose first row is not for a later step.

    When this chunk ends, no row of an older chunk follows: a policy whose plan ends early stops.
    """

    def accept(self, chunk: Held, step: int) -> None:
        if any(each.generation == chunk.generation for each in self.held):
            return  # a duplicate
        newest_first = sorted([*self.held, chunk], key=lambda each: -each.generation)
        begun = next((i for i, each in enumerate(newest_first) if each.first <= step), HELD_MAX)
        self.held = tuple(newest_first[: min(begun + 1, HELD_MAX)])

    def row(self, step: int) -> Row | None:
        for _, first, rows in self.held:
            if first <= step:
                self.last = rows[min(step - first, len(rows) - 1)]
                return self.last if step - first < len(rows) else None
        return None


class Batched(Player):
    """Player of a program that executes several rows of each answer, as openpi's
    `ActionChunkBroker`: a chunk that arrives meanwhile is used in the next answer.

    Args:
        make: function that makes the player that chooses the rows of an answer.
        count: number of rows that the program executes of each answer.
    """

    def __init__(self, make: Callable[[], Player], count: int) -> None:
        super().__init__()
        self._player, self._count = make(), count

    def number(self, step: int) -> int:
        return self._player.number(step)

    def accept(self, chunk: Held, step: int) -> None:
        self._player = copy(self._player)
        self._player.accept(chunk, step)

    def row(self, step: int) -> Row | None:
        if not self.settled:
            player = copy(self._player)
            self.settled = tuple(player.row(step + i) for i in range(self._count))
        self._player = copy(self._player)
        self._player.row(step)  # some players count these calls
        (row, *_), self.settled = self.settled, self.settled[1:]
        if row is not None or self.last is None:
            self.last = self._player.last if row is None else row
        return row


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
    """Player that executes a queue of rows in order, as in LeRobot's asynchronous inference.

    Steps are counted by executed rows, not by the clock: the count stops while the queue is empty.
    When a chunk arrives, its rows for steps already executed are skipped, and its other rows
    replace the queue. With "average", a step in both gets a weighted average of the two rows.

    Args:
        merge: rule for steps with an older and a newer row.

    Raises:
        ConfigError: `accept` cannot average rows of other types than floating-point numbers, for
            example of a Discrete space.
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
            expected = "floating-point numbers, as of a Box space, or merge='replace'"
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
    """Player that executes the newest row of each step, as distributed real-time chunking (DRTC).

    Steps are counted by executed rows, as in `Queue`. A chunk older than the newest received chunk
    is ignored. Rows of a newer chunk replace rows of the same steps, except steps already executed;
    rows of other steps are kept.
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


PLAYERS: dict[str, Callable[[], Player]] = {
    "clock": Clocked,
    "average": partial(Queue, "average"),
    "drtc": Freshest,
}
"""Players by the names of `--merge`."""
