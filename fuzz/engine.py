"""What torture and adversary share: schedules that shrink and are lines of JSON, packets that a
network holds back, and flights on all cores.
"""

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import replace
from heapq import heappop, heappush
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, TypeVar, cast

import msgspec

from skytether.lab.commands.pool import Flags, Interrupted, crew, writing
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.endpoints.endpoint import Datagram, Endpoint

SHORTEST_NS = MILLISECOND_NS
"""Length below which `shrink` does not shorten an event any further [ns]."""
HELD_MAX = 65536


class Timed(Protocol):
    """Event of a schedule: a frozen dataclass."""

    @property
    def length_ns(self) -> int:
        """Duration [ns]."""


T = TypeVar("T", bound=Timed)
S = TypeVar("S")
K = TypeVar("K", bound=Hashable)
Item = TypeVar("Item")
R = TypeVar("R")


def shrink(schedule: Sequence[T], fails: Callable[[tuple[T, ...]], bool]) -> tuple[T, ...]:
    """Shrink a failing schedule until leaving out any single event makes it pass.

    Delta debugging: events are left out, first many at a time and finally one by one; then each is
    halved in length while the schedule still fails.

    Args:
        fails: whether a schedule fails; called often, also with the empty one.
    """
    shortest = tuple(schedule)
    size, dropped = len(shortest), True
    while size > 1 or dropped:
        size, first, dropped = max(1, size // 2), 0, False
        while first < len(shortest):
            rest = shortest[:first] + shortest[first + size :]
            if fails(rest):
                shortest, dropped = rest, True
            else:
                first += size
    for n in range(len(shortest)):
        while shortest[n].length_ns >= 2 * SHORTEST_NS:
            shorter = cast(T, replace(cast(Any, shortest[n]), length_ns=shortest[n].length_ns // 2))
            if not fails((*shortest[:n], shorter, *shortest[n + 1 :])):
                break
            shortest = (*shortest[:n], shorter, *shortest[n + 1 :])
    return shortest


def dumps(schedule: object) -> str:
    """A schedule as a line of JSON."""
    return msgspec.json.encode(schedule).decode()


def loads(line: str, kind: type[S]) -> S:
    """Schedule of a kind from a line of JSON.

    Raises ConfigError if the line has none.
    """
    try:
        return msgspec.json.decode(line, type=kind)
    except msgspec.DecodeError as error:
        raise ConfigError(f"expected a schedule, as printed for a failure ({error})") from None


class HeldPackets(Endpoint):
    """Network that holds packets back, each until its own time."""

    def __init__(self) -> None:
        super().__init__()
        self._held: list[tuple[int, int, Datagram]] = []
        """Heap of the held packets: time of release, order, and packet."""
        self._order = 0

    def hold(self, due_ns: int, datagram: Datagram) -> None:
        if len(self._held) < HELD_MAX:
            self._order += 1
            heappush(self._held, (due_ns, self._order, datagram))

    def wake(self, *, now_ns: int) -> None:
        while self._held and self._held[0][0] <= now_ns:
            self._out.append(heappop(self._held)[2])

    def next_wake_ns(self) -> int | None:
        return self._held[0][0] if self._held else None


def flown(
    fly: Callable[[Item], R],
    items: Mapping[K, Item],
    kind: type[R],
    title: str,
    workers: int | None,
    *,
    settings: Mapping[str, Any] = MappingProxyType({}),
    out: Path | None = None,
    size: Callable[[Item], float] = lambda _: 1.0,
    tell: Callable[[Collection[R]], str],
) -> tuple[list[R], str]:
    """Results of all items in order, or of those done before Ctrl-C with a sentence that says so.

    Args:
        fly: flies an item; called in a worker.
        size: number of flights of an item.
        kind, settings, out, tell: see `Crew.study`.

    Raises:
        CommandError: interrupted before any result.
    """
    flags, total = Flags(workers), sum(map(size, items.values()))
    flags.check()
    try:
        with writing(out), crew(flags, title, total, "flights") as flyers:
            results = flyers.study(fly, items, kind, settings, out, size=size, tell=tell)
            return list(results.values()), ""
    except Interrupted as early:
        if not early.results:
            raise
        done = [key for key in items if key in early.results]
        flights = sum(size(items[key]) for key in done)
        message = f"interrupted with {flights:.0f} of {total:.0f} flights done"
        return [early.results[key] for key in done], message
