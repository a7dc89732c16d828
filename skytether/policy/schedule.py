"""Rows of actions that a robot holds, and the answer to its program at any time.

Rows are played by the clock, `step_ns` each. While the robot stands still, so does the count of its
steps: when rows have run out, and, with a program that waits for each answer, until it has come.
The first row of a chunk that was made from an observation at that place is then the next one, and
nothing is left out or played late.
"""

from copy import copy
from enum import StrEnum
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.policy.players import HELD_MAX, Held, Player, Row
from skytether.policy.values import ValueRefused

ROWS_MAX = 1024
"""Largest number of rows of a chunk."""
Actions = Literal["absolute", "delta"]
"""What to hold means: the last row again, or zeros."""


class Kind(StrEnum):
    """What a call was answered with."""

    FRESH = "fresh"
    """The chunk that was made from its own observation."""
    REST = "rest"
    """Rows left of earlier chunks."""
    HOLD = "hold"
    """No row was left, so what holds the robot."""
    ERROR = "error"


class Answer(NamedTuple):
    kind: Kind
    reply: Any
    """The policy's reply, from the present row on; None if there is none yet."""
    left: int
    """Number of rows in it that the policy has made."""


class Schedule:
    """Rows of one robot, from the connection of its program on.

    Args:
        actions: see `Actions`.
        key: key of the actions in the policy's reply.
        step_ns: length of a step [ns].
        began_ns: time of step 0.
    """

    def __init__(
        self, player: Player, actions: Actions, key: str, step_ns: int, began_ns: int
    ) -> None:
        self._player, self._actions, self._key = player, actions, key
        self._step_ns, self._at_ns = step_ns, began_ns
        self._count = 0.0
        self._end = 0
        """First step without a row."""
        self._reply: Any = None
        self._newest = -1
        """Call that the reply is an answer to."""
        self._first = 0
        self.stands = False
        """Whether the robot stands still now, although rows are left."""
        self.since_ns: int | None = began_ns
        """Time since which no row has been left [ns]; None while rows are left."""

    def set_step(self, step_ns: int, *, now_ns: int) -> None:
        self.advance(now_ns=now_ns)
        self._step_ns = step_ns

    @property
    def step_ns(self) -> int:
        return self._step_ns

    def advance(self, *, now_ns: int) -> int:
        """Play the rows until now; returns the number of the present step."""
        before = int(self._count)
        passed = 0.0 if self.stands else (now_ns - self._at_ns) / self._step_ns
        ends_ns = self._at_ns + int((self._end - self._count) * self._step_ns)
        self._at_ns, self._count = now_ns, max(min(self._count + passed, self._end), self._count)
        for step in range(before, int(self._count)):
            self._player.row(step)
        if self._count >= self._end and self.since_ns is None:
            self.since_ns = ends_ns
        return int(self._count)

    def number(self, *, now_ns: int) -> int:
        """The player's number of the present step, from which a chunk counts its rows."""
        return self._player.number(self.advance(now_ns=now_ns))

    def accept(self, call: int, first: int, reply: Any, *, now_ns: int) -> None:
        """Accept a chunk.

        Args:
            call: number of the call that it answers; that of a newer one is higher.
            first: number of the step of its observation, see `number`.

        Raises:
            ValueRefused: the reply has no rows of actions, or other ones than those before.
        """
        rows = rows_of(reply, self._key).astype(np.float64)
        step = self.advance(now_ns=now_ns)
        if self._reply is not None:
            before = rows_of(self._reply, self._key).shape[1:]
            if before != rows.shape[1:]:
                raise ValueRefused(f"{self._key}: got rows of {rows.shape[1:]}, expected {before}")
        self._player.accept(Held(call, first, rows), step)
        if call > self._newest:
            self._newest, self._reply, self._first = call, reply, first
        left = len(self._coming(step, ROWS_MAX + HELD_MAX)[0])
        self._end = step + left
        if left:
            self.since_ns = None

    def left(self, *, now_ns: int) -> int:
        """Number of rows that are left."""
        return self._end - self.advance(now_ns=now_ns)

    def coming(self, count: int, *, now_ns: int) -> NDArray[Any] | None:
        """Rows that are played next, at most `count`; shape (n, *row), None before the first."""
        rows, _ = self._coming(self.advance(now_ns=now_ns), count)
        return np.stack(rows) if rows else None

    def _coming(self, step: int, count: int) -> tuple[list[Row], Row | None]:
        """Rows from a step on, and the last row that was played if they are none."""
        player, rows = copy(self._player), list[Row]()
        while len(rows) < count and (row := player.row(step + len(rows))) is not None:
            rows.append(row)
        return rows, player.last

    def answer(self, kind: Kind, *, now_ns: int) -> Answer:
        """Reply from the present row on, as long as the newest one, filled up with what holds the
        robot.
        """
        if self._reply is None:
            return Answer(Kind.HOLD, None, 0)
        step = self.advance(now_ns=now_ns)
        made = rows_of(self._reply, self._key)
        rows, last = self._coming(step, len(made))
        if not rows:
            kind = Kind.HOLD
        assert last is not None
        fill = last if self._actions == "absolute" else np.zeros_like(last)
        every = np.stack([*rows, *[fill] * (len(made) - len(rows))]).astype(made.dtype, copy=False)
        cut = min(max(self._player.number(step) - self._first, 0), len(made) - 1)
        reply = _cut(self._reply, len(made), cut)
        reply[self._key] = every
        return Answer(kind, reply, len(rows))


def rows_of(reply: Any, key: str) -> NDArray[Any]:
    """Rows of actions in a policy's reply.

    Raises:
        ValueRefused: there are none, or too many, or one is not finite.
    """
    rows = reply.get(key) if isinstance(reply, dict) else None
    if not isinstance(rows, np.ndarray) or rows.ndim < 1 or not 0 < len(rows) <= ROWS_MAX:
        shape = getattr(rows, "shape", None)
        what = f"an array of shape {shape}" if shape is not None else type(rows).__name__
        raise ValueRefused(f"{key}: got {what}, expected an array with 1 to {ROWS_MAX} rows")
    if rows.dtype.kind not in "iuf" or not np.isfinite(rows).all():
        raise ValueRefused(f"{key}: got {rows.dtype} or no finite number, expected finite numbers")
    return rows


def _cut(value: Any, length: int, first: int) -> Any:
    """Value in which arrays of the same length begin with a row, and end with copies of their last
    row.
    """
    if isinstance(value, dict):
        return {name: _cut(each, length, first) for name, each in value.items()}
    if isinstance(value, np.ndarray) and value.ndim and len(value) == length and first:
        return np.concatenate([value[first:], np.repeat(value[-1:], first, axis=0)])
    return value
