"""Rows that a robot will execute until a new chunk can arrive, predicted where chunks are made.

A robot sends, with each observation, its step and the rows that it has. Chunks computed from
earlier observations may be under way, and will replace some of these rows when they arrive. Each is
expected d steps after the step of its observation, where the delay bound d is the longest of the
newest DELAYS delays from an observation to its chunk; one that is later counts as lost. The first d
of the predicted rows are *committed*: a new chunk cannot change them, and should continue them.
"""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple

from numpy.typing import NDArray

from skytether.policy.players import Held, Player, Row

DELAYS = 64
"""Number of newest delays of which the longest is the delay bound."""
UNDER_WAY_MAX, BYTES_MAX = 1024, 16_000_000
"""Largest number and total size [B] of chunks under way; the oldest are forgotten."""


class RobotRows(NamedTuple):
    """Rows that a robot has when it makes an observation, sent with it."""

    key: str
    """Key of the actions in the policy's reply."""
    step: int
    """Step of the observation, as the robot's player counts steps."""
    acknowledged: int
    """Newest call of which the robot has the chunk; chunks of earlier calls do not change rows."""
    rows: NDArray[Any] | None
    """Rows for this step and the next ones; shape (n, *row), None if there are none."""


class UnderWay:
    """Chunks sent to a robot that it has not acknowledged."""

    def __init__(self) -> None:
        self._sent: OrderedDict[int, tuple[int, Held]] = OrderedDict()
        """Chunks by generation, each with the step of its observation."""
        self._bytes = 0
        """Total size of their rows [B]."""

    def add(self, made: int, chunk: Held) -> None:
        """Add a chunk computed from the observation of the step `made`."""
        self._sent[chunk.generation] = made, chunk
        self._bytes += chunk.rows.nbytes
        while len(self._sent) > UNDER_WAY_MAX or self._bytes > BYTES_MAX:
            self._forget()

    def acknowledge(self, generation: int) -> None:
        """Forget chunks up to this one, which the robot has; earlier ones are lost or replaced."""
        while self._sent and next(iter(self._sent)) <= generation:
            self._forget()

    def _forget(self) -> None:
        """Forget the oldest chunk."""
        self._bytes -= self._sent.popitem(last=False)[1][1].rows.nbytes

    def predict(
        self,
        player: Player,
        step: int,
        delay: int,
        count: int,
        fill: Callable[[Row | None], Row | None] = lambda _: None,
    ) -> tuple[list[Row], int]:
        """Rows that a robot executes from a step on, at most `count`.

        Args:
            player: copy of the robot's player at that step.
            delay: delay bound d [steps].
            fill: from the last row (None before the first) to the row that is executed when no row
                remains; None if it is unknown.

        Returns: the rows, and the number of them before rows run out.
        """
        rows, ran_out = list[Row](), None
        under_way = [each for each in self._sent.values() if each[0] + delay > step]
        for at in range(step, step + count):
            for made, chunk in under_way:
                if made + delay == at:
                    player.accept(chunk, at)
            row = player.row(at)
            if row is None:
                ran_out = len(rows) if ran_out is None else ran_out
                row = fill(player.last)
                if row is None or len(rows) >= delay:
                    break
            rows.append(row)
        return rows, len(rows) if ran_out is None else ran_out
