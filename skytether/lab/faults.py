"""Faults: what happens to a flight under torture, as a schedule drawn from a seed.

A schedule is data: what is done to which host or direction, from when to when, and how badly. The
same generator draws the same schedule. One after which a flight fails is shrunk to the shortest
that still fails, and kept as a line of JSON with the seed of the flight.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated

import msgspec
import numpy as np

from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns


class Kind(StrEnum):
    """What a fault does while it lasts."""

    LOSS = "loss"
    """Packets are lost, a share of them."""
    BURST = "burst"
    """Packets are lost in a row, as many at a time."""
    DUPLICATES = "duplicates"
    """Packets come twice, a share of them."""
    REORDERING = "reordering"
    """Packets come later, by a time drawn for each, at most so many seconds."""
    PARTITION = "partition"
    """No packet passes either way."""
    STEP = "step"
    """A host's clock is set, by so many seconds, once and for all."""
    SKEW = "skew"
    """A host's clock runs faster, by so many ppm."""
    RESTART = "restart"
    """A host is down, and then begins another life."""
    FREEZE = "freeze"
    """A host stands still, as after SIGSTOP."""
    SOLVER = "solver"
    """The solver fails, in a share of its solves."""
    OVERLOAD = "overload"
    """The server computes for so many steps whenever it is woken."""
    REPLAY = "replay"
    """An attacker sends packets again, so many seconds after they were sent."""
    DELAY = "delay"
    """An attacker holds packets back for so many seconds."""
    CORRUPTION = "corruption"
    """An attacker flips a bit, in a share of the packets."""
    FLOOD = "flood"
    """A stranger sends forged packets, so many a second."""
    COPY = "copy"
    """An attacker copies a share of the packets, sends the copies to either end from addresses of
    his own, sooner or later than the packets come, and hands on what he is answered there."""
    KEYS = "keys"
    """The server begins another life with other keys, and then one with the right ones again."""


HARMLESS = frozenset({Kind.COPY, Kind.DUPLICATES, Kind.REPLAY, Kind.FLOOD})
"""Faults that must keep no vehicle from flying: every packet passes."""

NETWORK = ("uplink", "downlink", "both")
"""Directions in which packets suffer."""
HOSTS = ("server", "client")

SHARE = (0.05, 1.0)


@dataclass(frozen=True)
class Range:
    """What may be drawn for a kind of fault."""

    where: tuple[str, ...]
    """Hosts or directions that it may befall."""
    length_s: tuple[float, float]
    """Shortest and longest time that it lasts [s], drawn evenly on a scale of logarithms."""
    amount: tuple[float, float] = (1.0, 1.0)
    """Least and most of it, drawn likewise; the unit is that of the kind."""
    signed: bool = False
    """Whether the amount may be negative as well."""


RANGES = {
    Kind.LOSS: Range(NETWORK, (0.1, 30.0), SHARE),
    Kind.BURST: Range(NETWORK, (1.0, 30.0), (2.0, 100.0)),
    Kind.DUPLICATES: Range(NETWORK, (1.0, 30.0), SHARE),
    Kind.REORDERING: Range(NETWORK, (1.0, 30.0), (0.1, 5.0)),
    Kind.PARTITION: Range(("both",), (0.1, 30.0)),
    Kind.STEP: Range(HOSTS, (0.0, 0.0), (7.0, 3600.0), signed=True),
    Kind.SKEW: Range(HOSTS, (10.0, 60.0), (200.0, 200.0), signed=True),
    Kind.RESTART: Range(("server", "client", "netem"), (0.01, 10.0)),
    Kind.FREEZE: Range(HOSTS, (0.1, 5.0)),
    Kind.SOLVER: Range(("server",), (0.1, 10.0), SHARE),
    Kind.OVERLOAD: Range(("server",), (0.1, 10.0), (1.5, 20.0)),
    Kind.REPLAY: Range(NETWORK, (1.0, 30.0), (0.1, 30.0)),
    Kind.DELAY: Range(NETWORK, (0.5, 10.0), (0.1, 10.0)),
    Kind.CORRUPTION: Range(NETWORK, (1.0, 30.0), SHARE),
    Kind.FLOOD: Range(HOSTS, (0.1, 5.0), (100.0, 2_000.0)),
    Kind.COPY: Range(("both",), (5.0, 30.0), SHARE),
    Kind.KEYS: Range(("server",), (0.1, 10.0)),
}
"""Range of every kind."""

EVERY_NS = 5 * SECOND_NS
"""Mean time from one fault of a schedule to the next [ns]."""
SHORTEST_NS = MILLISECOND_NS
"""Length below which `shrink` shortens a fault no further [ns]."""


@dataclass(frozen=True)
class ScheduledFault:
    """One fault."""

    kind: Kind
    where: str
    """Host or direction that it befalls, one of its range's."""
    start_ns: Annotated[int, msgspec.Meta(ge=0)]
    """Time of the world at which it begins [ns]."""
    length_ns: Annotated[int, msgspec.Meta(ge=0)]
    """Time that it lasts [ns]; of what has no end, 0."""
    amount: float
    """How badly, in the unit of its kind."""

    @property
    def end_ns(self) -> int:
        """Time of the world at which it ends."""
        return self.start_ns + self.length_ns

    @property
    def over_ns(self) -> int:
        """Time of the world at which the last packet comes that it has held back."""
        held = self.kind in (Kind.REORDERING, Kind.DELAY)
        return self.end_ns + (seconds_to_ns(self.amount) if held else 0)


def schedule(rng: np.random.Generator, duration_ns: int) -> tuple[ScheduledFault, ...]:
    """Draw the faults of a flight, one at least, by the time at which they begin.

    Args:
        rng: source of chance.
        duration_ns: time within which they begin and end [ns].
    """
    count = 1 + rng.poisson(duration_ns / EVERY_NS)
    kinds = list(Kind)
    drawn = [_draw(rng, kinds[rng.integers(len(kinds))], duration_ns) for _ in range(count)]
    kept = [fault for fault in drawn if not _hides(fault, drawn)]
    return tuple(sorted(kept or drawn[:1], key=lambda fault: fault.start_ns))


def _hides(step: ScheduledFault, drawn: Sequence[ScheduledFault]) -> bool:
    """Whether a clock is set while its host is frozen, or a moment after it was set before.

    Then nobody aboard can know for how long it stood still. The clock that hosts live by,
    CLOCK_MONOTONIC, cannot be set by anybody.
    """
    if step.kind is not Kind.STEP:
        return False
    of_host = [each for each in drawn if each.where == step.where and each is not step]
    frozen = any(
        each.kind is Kind.FREEZE and each.start_ns <= step.start_ns <= each.end_ns
        for each in of_host
    )
    before = any(
        each.kind is Kind.STEP and 0 <= step.start_ns - each.start_ns < SECOND_NS
        for each in of_host
    )
    return frozen or before


def _draw(rng: np.random.Generator, kind: Kind, duration_ns: int) -> ScheduledFault:
    bounds = RANGES[kind]
    where = bounds.where[rng.integers(len(bounds.where))]
    start_ns = int(rng.integers(duration_ns))
    length_ns = min(seconds_to_ns(_between(rng, bounds.length_s)), duration_ns - start_ns)
    amount = _between(rng, bounds.amount)
    negative = bounds.signed and rng.random() < 0.5
    return ScheduledFault(kind, where, start_ns, length_ns, -amount if negative else amount)


def _between(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """A number between two, drawn evenly on a scale of logarithms."""
    low, high = bounds
    return low if low == high else float(low * (high / low) ** rng.random())


def shrink(
    faults: Sequence[ScheduledFault], fails: Callable[[tuple[ScheduledFault, ...]], bool]
) -> tuple[ScheduledFault, ...]:
    """Shrink a schedule to one that still fails, but with none of its faults left out.

    Delta debugging: faults are left out, many at a time at first and one by one at last; then each
    is halved in length for as long as the rest of it fails.

    Args:
        faults: schedule that fails.
        fails: whether a schedule does; asked often, of the empty one as well.
    """
    kept = tuple(faults)
    size, dropped = len(kept), True
    while size > 1 or dropped:
        size, first, dropped = max(1, size // 2), 0, False
        while first < len(kept):
            rest = kept[:first] + kept[first + size :]
            if fails(rest):
                kept, dropped = rest, True
            else:
                first += size
    for n in range(len(kept)):
        while kept[n].length_ns >= 2 * SHORTEST_NS:
            shorter = replace(kept[n], length_ns=kept[n].length_ns // 2)
            if not fails((*kept[:n], shorter, *kept[n + 1 :])):
                break
            kept = (*kept[:n], shorter, *kept[n + 1 :])
    return kept


@dataclass(frozen=True)
class Trial:
    """A flight under torture."""

    seed: Annotated[int, msgspec.Meta(ge=0, le=2**32 - 1)]
    """Seed of everything else that is drawn."""
    faults: tuple[ScheduledFault, ...]
    """What happens to it."""

    @property
    def end_ns(self) -> int:
        """Time of the world from which on nothing that is left of a fault happens any more."""
        return max((fault.over_ns for fault in self.faults), default=0)


def dumps(trial: Trial) -> str:
    """Line of JSON for a trial."""
    return msgspec.json.encode(trial).decode()


def loads(line: str) -> Trial:
    """Trial in a line of JSON.

    Raises:
        ConfigError: it is none.
    """
    try:
        trial = msgspec.json.decode(line, type=Trial)
    except msgspec.DecodeError as error:
        raise ConfigError(f"schedule of faults: {error}") from None
    for fault in trial.faults:
        where = RANGES[fault.kind].where
        if fault.where not in where:
            expected = " or ".join(where)
            raise ConfigError(f"schedule: {fault.kind}: got {fault.where!r}, expected {expected}")
    return trial
