"""Rows of actions that a robot holds, and the answer to its program at any time.

Rows are played by the clock, `step_ns` each. While the robot stands still, so does the count of its
steps: when the rows that its program was given have run out, and, with a program that waits for
each answer, until it has come. The first row of a chunk that was made from an observation at that
place is then the next one, and nothing is left out. The robot has not moved since, but all about it
may have: a chunk is forgotten when its rows would be played more than `late_ns` after their time.
"""

from copy import copy
from enum import StrEnum
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.policy.players import HELD_MAX, Held, Player, Row
from skytether.policy.values import ValueRefused
from skytether.shared.base.units import SECOND_NS

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
        rows: number of rows that the program plays of each answer; None: as long as it takes.
        late_ns: longest time by which a row is played later than it was planned for [ns].
        began_ns: time of step 0.
    """

    def __init__(
        self,
        player: Player,
        actions: Actions,
        key: str,
        step_ns: int,
        rows: int | None,
        late_ns: int,
        began_ns: int,
    ) -> None:
        self._player, self._actions, self._key = player, actions, key
        self._rows, self._late_ns = rows, late_ns
        self.step_ns, self._at_ns = step_ns, began_ns
        self._count = 0.0
        self._end = 0
        """First step without a row."""
        self._given = 0
        """The same of the rows that the program has: it plays its answer, whatever comes later."""
        self._reply: Any = None
        self._newest = -1
        """Call that the reply is an answer to."""
        self._first = 0
        self._stands = False
        """Whether the robot stands still now, although rows may be left."""
        self.stood_ns = 0.0
        """Time for which it has stood still so far [ns]."""
        self._made: dict[int, float] = {}
        """The same when the observation of each chunk was made, by its call [ns]."""
        self.since_ns: int | None = began_ns
        """Time since which the program has had no row [ns]; None while it has."""

    def stand(self, *, now_ns: int) -> None:
        """Stand still until `go`: the program waits for an answer. It calls between two rows, so
        the count becomes a whole number.
        """
        played = self._given if self._rows else round(self._by_clock(now_ns))
        self._move(max(played, int(self._count)), now_ns)
        self._stands = True

    def go(self, *, now_ns: int) -> None:
        """Play on, as far as the program is given an answer."""
        self._given = self.advance(now_ns=now_ns)
        self._stands = False

    def advance(self, *, now_ns: int) -> int:
        """Play the rows until now; returns the number of the present step."""
        self._move(max(self._by_clock(now_ns), self._count), now_ns)
        return int(self._count)

    def _by_clock(self, now_ns: int) -> float:
        passed_ns = 0 if self._stands else now_ns - self._at_ns
        return min(self._count + passed_ns / self.step_ns, self._given)

    def _move(self, count: float, now_ns: int) -> None:
        before_ns = self._at_ns
        for step in range(int(self._count), int(count)):
            self._player.row(step)
        if count >= self._given and self.since_ns is None:
            ended_ns = before_ns + int((self._given - self._count) * self.step_ns)
            self.since_ns = min(ended_ns, now_ns)
        self.stood_ns += now_ns - before_ns - (count - self._count) * self.step_ns
        self._at_ns, self._count = now_ns, count
        if any(self._is_late(stood_ns) for stood_ns in self._made.values()):
            self._forget()

    def _is_late(self, stood_ns: float) -> bool:
        return self.stood_ns - stood_ns > self._late_ns

    def _forget(self) -> None:
        """Forget chunks that are late, and what is known of those that are played."""
        held = self._player.held
        held = tuple(each for each in held if not self._is_late(self._made[each.generation]))
        self._player.held = held
        self._made = {each.generation: self._made[each.generation] for each in held}
        step = int(self._count)
        self._end = step + len(self._coming(step, ROWS_MAX + HELD_MAX)[0])

    def number(self, *, now_ns: int) -> int:
        """The player's number of the present step, from which a chunk counts its rows."""
        return self._player.number(self.advance(now_ns=now_ns))

    def accept(self, call: int, first: int, stood_ns: float, reply: Any, *, now_ns: int) -> None:
        """Accept a chunk.

        Args:
            call: number of the call that it answers; that of a newer one is higher.
            first: number of the step of its observation, see `number`.
            stood_ns: `stood_ns` at that time.

        Raises:
            ValueRefused: the reply has no rows of actions, or other ones than those before, or it
                is too late for them.
        """
        rows = rows_of(reply, self._key).astype(np.float64)
        step = self.advance(now_ns=now_ns)
        if self._reply is not None:
            before = rows_of(self._reply, self._key).shape[1:]
            if before != rows.shape[1:]:
                raise ValueRefused(f"{self._key}: got rows of {rows.shape[1:]}, expected {before}")
        if self._reply is None:
            stood_ns = self.stood_ns  # the robot has not moved yet, however long it has waited
        elif self._is_late(stood_ns):
            late_s = (self.stood_ns - stood_ns) / SECOND_NS
            why = f"the robot has stood still since its observation for {late_s:.1f} s"
            raise ValueRefused(f"{why}, longer than deadline and hold")
        self._made[call] = stood_ns
        self._player.accept(Held(call, first, rows), step)
        if call > self._newest:
            self._newest, self._reply, self._first = call, reply, first
        self._forget()

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
        if rows:
            self._given, self.since_ns = step + min(len(rows), self._rows or len(rows)), None
        else:
            kind = Kind.HOLD
            self.since_ns = now_ns if self.since_ns is None else self.since_ns
        if last is None:
            return Answer(kind, None, 0)
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
