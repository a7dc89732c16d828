"""Received action chunks of a robot, and the reply to its program at a given time.

A row is the action of one control step of length `step_ns`. The step counter follows the clock. It
is paused while the robot executes no row: when all rows of the program's last answer are executed,
and, with a program that waits for each answer, during the call. Thus a chunk computed from an
observation during a pause starts with the next row, and no row is skipped. The robot has not moved
during a pause, but its surroundings may have changed: a chunk is discarded if its rows would be
executed more than `late_ns` after their planned time.
"""

import math
from collections import deque
from contextlib import suppress
from copy import copy
from enum import StrEnum
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.policy.players import HELD_MAX, Held, Player, Row
from skytether.policy.values import ValueRefused
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

ROWS_MAX = 1024
"""Largest number of rows of a chunk."""
STEP_NS_FIRST = 200 * MILLISECOND_NS
"""Assumed length of a control step before it is measured [ns]. Until three intervals have been
measured, the time by which a step is longer counts as a pause."""
STEP_NS_LEAST, STEP_NS_MOST = MILLISECOND_NS, SECOND_NS
"""Bounds of the measured step length [ns]: a pause of the program is not a long step."""
MEASURED = 9
"""Number of newest intervals between calls that give the step length."""
Actions = Literal["absolute", "delta"]
"""Type of the actions, which sets the hold action: last row for absolute, zeros for delta."""


class Kind(StrEnum):
    """Kind of an answer to a call."""

    FRESH = "fresh"
    """Chunk computed from the observation of this call."""
    REST = "rest"
    """Remaining rows of earlier chunks."""
    HOLD = "hold"
    """Hold action: no row remains."""
    ERROR = "error"


class Answer(NamedTuple):
    kind: Kind
    reply: Any
    """Newest reply, from the present row on; None before the first reply."""
    left: int
    """Number of rows of `reply` computed by the policy; the others are the hold action."""


class Schedule:
    """Chunks and step counter of one robot program, from its connection on.

    Args:
        player: rule that chooses the row of each step.
        actions: see `Actions`.
        key: key of the actions in the policy's reply.
        step_ns: length of a control step [ns], by which the clock counts rows; None: measured as
            the time from an answer to the next call, divided by `rows`.
        rows: number of rows that the program executes of each answer.
        late_ns: longest allowed delay of a row after its planned time [ns].
        began_ns: time of step 0 [ns].
    """

    def __init__(
        self,
        player: Player,
        actions: Actions,
        key: str,
        step_ns: int | None,
        rows: int,
        late_ns: int,
        began_ns: int,
    ) -> None:
        self._player, self._actions, self._key = player, actions, key
        self._rows, self._late_ns = None if step_ns else rows, late_ns
        """Number of rows that each call counts as executed; None: the clock counts rows."""
        self.step_ns, self._at_ns = step_ns or STEP_NS_FIRST, began_ns
        self._intervals_ns = deque([STEP_NS_FIRST * rows], MEASURED)
        """Newest times from an answer to the next call [ns]; the first is an assumed value."""
        self._answered_ns: int | None = None
        """Time of the last answer [ns]."""
        self._count = 0.0
        self._end = 0
        """First step without a row in the received chunks."""
        self._given = 0
        """First step without a row in the program's last answer; later chunks do not change it."""
        self._reply: Any = None
        self._dtype: np.dtype[Any] = np.dtype(np.float64)
        """Type that holds the numbers of all received chunks."""
        self._answered: tuple[int, list[Row]] = 0, []
        """Step and rows of the program's newest answer with rows."""
        self._last: Row | None = None
        """Last row that the program has executed."""
        self._newest = -1
        """Number of the call that `_reply` answers."""
        self._first = 0
        """Step of the first row of `_reply`, as the player counts steps."""
        self._stands = False
        """Whether the step counter is paused by a call, although rows may remain."""
        self.stood_ns = 0.0
        """Total time for which the step counter has been paused [ns]."""
        self._made: dict[int, float] = {}
        """`stood_ns` at the observation of each chunk, by call number [ns]."""
        self.since_ns: int | None = began_ns
        """Time at which the program ran out of rows [ns]; None while rows remain."""

    def stand(self, *, now_ns: int) -> None:
        """Pause the step counter until `go`, while the program waits for an answer.

        A call is made between two rows, so the counter is rounded to a whole number.
        """
        if self._rows and self._answered_ns is not None:
            self._intervals_ns.append(now_ns - self._answered_ns)
            # Lower quartile: long pauses are more frequent than calls without executed rows.
            measured_ns = sorted(self._intervals_ns)[len(self._intervals_ns) // 4]
            self.step_ns = min(max(measured_ns // self._rows, STEP_NS_LEAST), STEP_NS_MOST)
        played = self._given if self._rows else round(self._by_clock(now_ns))
        self._move(max(played, int(self._count)), now_ns)
        self._stands = True

    def has_paused(self, least_ns: int, *, now_ns: int) -> bool:
        """Whether, for `least_ns`, no row has remained and the program has made no call."""
        ended_ns, answered_ns = self.since_ns, self._answered_ns
        if ended_ns is None or answered_ns is None:
            return False
        return now_ns - max(ended_ns, answered_ns) > least_ns

    def go(self, *, now_ns: int) -> None:
        """Continue the step counter when the program gets its answer."""
        self._given = self.advance(now_ns=now_ns)
        self._stands, self._answered_ns = False, now_ns

    def advance(self, *, now_ns: int) -> int:
        """Advance the step counter to `now_ns`; returns the number of the present step."""
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
        """Discard chunks that are too late, and the records of chunks without remaining rows."""
        held = self._player.held
        held = tuple(each for each in held if not self._is_late(self._made[each.generation]))
        self._player.held = held
        self._made = {each.generation: self._made[each.generation] for each in held}
        step = int(self._count)
        self._end = step + len(self._coming(step, ROWS_MAX + HELD_MAX)[0])

    def open_step(self, rows: int, *, now_ns: int) -> int:
        """First step whose row a chunk that arrives now can change.

        Args:
            rows: number of rows that the program executes of its last answer before the next call;
                0 during a call.
        """
        step = self.advance(now_ns=now_ns)
        if self._stands:
            return step
        if self._rows:
            return self._given
        return max(math.ceil(self._count), min(self._answered[0] + rows, self._given))

    def number(self, *, now_ns: int) -> int:
        """Number of the present step as the player counts steps; a chunk begins with this step."""
        return self._player.number(self.advance(now_ns=now_ns))

    def accept(
        self, call: int, first: int, stood_ns: float | None, reply: Any, *, now_ns: int
    ) -> None:
        """Accept a chunk.

        Args:
            call: number of the call that the chunk answers; numbers increase.
            first: number of the step of the chunk's observation, see `number`.
            stood_ns: `stood_ns` at the time of the chunk's observation [ns]; None: the robot has
                stood since then, so that the chunk is not late.
            reply: the policy's reply.

        Raises:
            ValueRefused: the reply has no valid rows, its row shape has changed, or the chunk is
                more than `late_ns` late.
        """
        made = rows_of(reply, self._key)
        rows, step = made.astype(np.float64), self.advance(now_ns=now_ns)
        if self._reply is not None:
            before = rows_of(self._reply, self._key).shape[1:]
            if before != rows.shape[1:]:
                raise ValueRefused(
                    f"{self._key}: got row shape {rows.shape[1:]}, expected {before} as before"
                )
        if stood_ns is None:
            stood_ns = self.stood_ns
        elif self._is_late(stood_ns):
            late_s = (self.stood_ns - stood_ns) / SECOND_NS
            why = f"the robot has paused for {late_s:.1f} s since the chunk's observation"
            raise ValueRefused(f"{why}, expected at most the sum of deadline and hold")
        self._made[call] = stood_ns
        if self._reply is None:
            self._dtype = made.dtype
        elif self._dtype != made.dtype:
            self._dtype = np.result_type(self._dtype, made.dtype)
        self._player.accept(Held(call, first, rows), step)
        if call > self._newest:
            self._newest, self._reply, self._first = call, reply, first
        self._forget()

    def left(self, *, now_ns: int) -> int:
        """Number of remaining rows."""
        return max(0, self._end - self.advance(now_ns=now_ns))

    def coming(self, count: int, *, now_ns: int) -> NDArray[Any] | None:
        """Next rows to execute, at most `count`; shape (n, *row), None if no row remains."""
        rows, _ = self._coming(self.advance(now_ns=now_ns), count)
        return self._typed(rows) if rows else None

    def _typed(self, rows: list[Row]) -> NDArray[Any]:
        """Rows of the type of the received chunks; a mean of whole numbers is rounded."""
        stacked = np.stack(rows)
        return (stacked if self._dtype.kind == "f" else stacked.round()).astype(self._dtype)

    def _coming(self, step: int, count: int) -> tuple[list[Row], Row | None]:
        """At most `count` rows from a step on, and the row to repeat when rows have run out."""
        player, rows = copy(self._player), list[Row]()
        while len(rows) < count and (row := player.row(step + len(rows))) is not None:
            rows.append(row)
        return rows, player.last

    def answer(self, kind: Kind, *, now_ns: int) -> Answer:
        """Newest reply from the present row on, padded to its length with the hold action.

        Args:
            kind: kind of the answer if rows remain; otherwise the kind is HOLD.
        """
        if self._reply is None:
            return Answer(Kind.HOLD, None, 0)
        step = self.advance(now_ns=now_ns)
        made = rows_of(self._reply, self._key)
        rows, last = self._coming(step, len(made))
        first, before = self._answered
        if step > first:
            self._last = before[step - first - 1]
        if rows:
            given, last = min(len(rows), self._rows or len(rows)), rows[-1]
            self._given, self.since_ns, self._answered = step + given, None, (step, rows)
        else:
            last = last if self._last is None else self._last
            kind = Kind.HOLD
            self.since_ns = now_ns if self.since_ns is None else self.since_ns
        if last is None:
            return Answer(kind, None, 0)
        fill = last if self._actions == "absolute" else np.zeros_like(last)
        every = self._typed([*rows, *[fill] * (len(made) - len(rows))])
        cut = min(max(self._player.number(step) - self._first, 0), len(made) - 1)
        reply = _cut(self._reply, len(made), cut)
        reply[self._key] = every
        return Answer(kind, reply, len(rows))


def rows_of(reply: Any, key: str) -> NDArray[Any]:
    """Rows of actions in a policy's reply; shape (n, *row).

    Raises:
        ValueRefused: the reply has no rows or more than ROWS_MAX, or a number is not finite.
    """
    rows = reply.get(key) if isinstance(reply, dict) else None
    if isinstance(rows, list):  # as some policy servers send them
        with suppress(ValueError):  # rows of different lengths
            rows = np.array(rows)
    if not isinstance(rows, np.ndarray) or not rows.ndim or not rows.size or len(rows) > ROWS_MAX:
        shape = getattr(rows, "shape", None)
        what = f"an array of shape {shape}" if shape is not None else type(rows).__name__
        raise ValueRefused(f"{key}: got {what}, expected an array with 1 to {ROWS_MAX} rows")
    if rows.dtype.kind not in "iuf" or not np.isfinite(rows).all():
        raise ValueRefused(f"{key}: got {rows.dtype} or NaN or infinity, expected finite numbers")
    return rows


def _cut(value: Any, length: int, first: int) -> Any:
    """Value whose arrays of `length` rows are shifted by `first` rows; the last row is repeated."""
    if isinstance(value, dict):
        return {name: _cut(each, length, first) for name, each in value.items()}
    if isinstance(value, np.ndarray) and value.ndim and len(value) == length and first:
        return np.concatenate([value[first:], np.repeat(value[-1:], first, axis=0)])
    return value
