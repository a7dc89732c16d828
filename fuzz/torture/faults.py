"""Faults of a flight under torture, as a schedule drawn from a seed.

A schedule is data: each fault has a kind, a host or direction, a time, a length and an amount.
Equal seeds draw equal schedules. A failing schedule is shrunk to the shortest one that still fails,
and kept as a line of JSON with the seed of the flight.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import msgspec
import numpy as np

from fuzz import engine
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS, seconds_to_ns


class FaultKind(StrEnum):
    LOSS = "loss"
    BURST = "burst"
    """Loss of several packets in a row, repeatedly."""
    DUPLICATES = "duplicates"
    REORDERING = "reordering"
    """Extra delay of each packet, random up to the amount [s]."""
    PARTITION = "partition"
    """Loss of all packets in both directions."""
    STEP = "step"
    """Permanent step of a host's clock by the amount [s]."""
    SKEW = "skew"
    """A host's clock runs fast by the amount [ppm]."""
    RESTART = "restart"
    FREEZE = "freeze"
    """Freeze of a host, as SIGSTOP freezes a process."""
    SOLVER = "solver"
    """Failure of the solver in a share of its solves."""
    OVERLOAD = "overload"
    """The server computes for the amount [steps] at each wake."""
    REPLAY = "replay"
    """Attacker that replays packets after a delay of the amount [s]."""
    DELAY = "delay"
    """Attacker that holds packets back for the amount [s]."""
    CORRUPTION = "corruption"
    """Attacker that flips a bit in a share of the packets."""
    FLOOD = "flood"
    """Attacker without keys that sends forged packets; the amount is their rate [1/s]."""
    COPY = "copy"
    """Attacker that copies a share of the packets, sends the copies from other addresses to either
    end, before or after the originals, and forwards the answers.
    """
    KEYS = "keys"
    """Restart of the server with other keys, then with the right ones again."""
    CROWD = "crowd"
    """Attacker that sends copies of vehicles' packets to netem from another host and many ports,
    and forwards the answers; the amount is their rate [1/s].
    """
    PORT = "port"
    """NAT that permanently maps every vehicle to another port; packets to the old port are lost."""


HARMLESS = frozenset(
    {FaultKind.COPY, FaultKind.CROWD, FaultKind.DUPLICATES, FaultKind.REPLAY, FaultKind.FLOOD}
)
"""Faults during which all vehicles must fly, because every packet still arrives."""

NETWORK = ("uplink", "downlink", "both")
HOSTS = ("server", "client")

SHARE = (0.05, 1.0)


@dataclass(frozen=True)
class Range:
    """Range from which the faults of a kind are drawn."""

    where: tuple[str, ...]
    length_s: tuple[float, float]
    """Shortest and longest duration [s]; drawn log-uniformly."""
    amount: tuple[float, float] = (1.0, 1.0)
    """Smallest and largest amount; drawn log-uniformly."""
    signed: bool = False
    """Whether the amount may also be negative."""


RANGES = {
    FaultKind.LOSS: Range(NETWORK, (0.1, 30.0), SHARE),
    FaultKind.BURST: Range(NETWORK, (1.0, 30.0), (2.0, 100.0)),
    FaultKind.DUPLICATES: Range(NETWORK, (1.0, 30.0), SHARE),
    FaultKind.REORDERING: Range(NETWORK, (1.0, 30.0), (0.1, 5.0)),
    FaultKind.PARTITION: Range(("both",), (0.1, 30.0)),
    FaultKind.STEP: Range(HOSTS, (0.0, 0.0), (7.0, 3600.0), signed=True),
    FaultKind.SKEW: Range(HOSTS, (10.0, 60.0), (200.0, 200.0), signed=True),
    FaultKind.RESTART: Range(("server", "client", "netem"), (0.01, 10.0)),
    FaultKind.FREEZE: Range(HOSTS, (0.1, 5.0)),
    FaultKind.SOLVER: Range(("server",), (0.1, 10.0), SHARE),
    FaultKind.OVERLOAD: Range(("server",), (0.1, 10.0), (1.5, 20.0)),
    FaultKind.REPLAY: Range(NETWORK, (1.0, 30.0), (0.1, 30.0)),
    FaultKind.DELAY: Range(NETWORK, (0.5, 10.0), (0.1, 10.0)),
    FaultKind.CORRUPTION: Range(NETWORK, (1.0, 30.0), SHARE),
    FaultKind.FLOOD: Range(HOSTS, (0.1, 5.0), (100.0, 2_000.0)),
    FaultKind.COPY: Range(("both",), (5.0, 30.0), SHARE),
    FaultKind.KEYS: Range(("server",), (0.1, 10.0)),
    FaultKind.CROWD: Range(("netem",), (5.0, 30.0), (20.0, 1_000.0)),
    FaultKind.PORT: Range(("client",), (0.0, 0.0)),
}

EVERY_NS = 5 * SECOND_NS


@dataclass(frozen=True)
class ScheduledFault:
    kind: FaultKind
    where: str
    """Host or direction, one of those in the kind's range."""
    start_ns: Annotated[int, msgspec.Meta(ge=0)]
    """Time in the virtual world [ns]."""
    length_ns: Annotated[int, msgspec.Meta(ge=0)]
    """Duration [ns]; 0 for a permanent fault."""
    amount: float
    """Amount; `FaultKind` gives its meaning and unit."""

    @property
    def end_ns(self) -> int:
        return self.start_ns + self.length_ns

    @property
    def over_ns(self) -> int:
        """Time at which the last packet delayed by the fault arrives [ns]."""
        delays = self.kind in (FaultKind.REORDERING, FaultKind.DELAY)
        return self.end_ns + (seconds_to_ns(self.amount) if delays else 0)


def schedule(rng: np.random.Generator, duration_ns: int) -> tuple[ScheduledFault, ...]:
    """Draw the faults of a flight, at least one, in order of time. All begin and end within
    `duration_ns`.
    """
    count = 1 + rng.poisson(duration_ns / EVERY_NS)
    kinds = list(FaultKind)
    drawn = [_draw(rng, kinds[rng.integers(len(kinds))], duration_ns) for _ in range(count)]
    possible = [fault for fault in drawn if not _hides(fault, drawn)]
    return tuple(sorted(possible or drawn[:1], key=lambda fault: fault.start_ns))


def _hides(step: ScheduledFault, drawn: Sequence[ScheduledFault]) -> bool:
    """Whether a clock step falls into a freeze of its host, or shortly after another step.

    Then the host could not tell how long it was frozen. Real hosts use CLOCK_MONOTONIC, which
    cannot be set.
    """
    if step.kind is not FaultKind.STEP:
        return False
    of_host = [each for each in drawn if each.where == step.where and each is not step]
    frozen = any(
        each.kind is FaultKind.FREEZE and each.start_ns <= step.start_ns <= each.end_ns
        for each in of_host
    )
    before = any(
        each.kind is FaultKind.STEP and 0 <= step.start_ns - each.start_ns < SECOND_NS
        for each in of_host
    )
    return frozen or before


def _draw(rng: np.random.Generator, kind: FaultKind, duration_ns: int) -> ScheduledFault:
    bounds = RANGES[kind]
    where = bounds.where[rng.integers(len(bounds.where))]
    start_ns = int(rng.integers(duration_ns))
    length_ns = min(seconds_to_ns(_between(rng, bounds.length_s)), duration_ns - start_ns)
    amount = _between(rng, bounds.amount)
    negative = bounds.signed and rng.random() < 0.5
    return ScheduledFault(kind, where, start_ns, length_ns, -amount if negative else amount)


def _between(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    low, high = bounds
    return low if low == high else float(low * (high / low) ** rng.random())


@dataclass(frozen=True)
class Trial:
    """Flight under torture: its faults, and the seed of all other random numbers."""

    seed: Annotated[int, msgspec.Meta(ge=0, le=2**32 - 1)]
    faults: tuple[ScheduledFault, ...]
    two_paths: bool = False
    """Whether the vehicles have a second path, on which there is no saboteur."""
    standby: bool = False
    """Whether there is a standby server, to which no saboteur listens. Every second fault of the
    server strikes it in place of the first."""

    @property
    def end_ns(self) -> int:
        """Time after which no fault has an effect [ns]."""
        return max((fault.over_ns for fault in self.faults), default=0)


def loads(line: str) -> Trial:
    """Decode a trial from JSON.

    Raises ConfigError if the line is not a trial.
    """
    trial = engine.loads(line, Trial)
    for fault in trial.faults:
        where = RANGES[fault.kind].where
        if fault.where not in where:
            expected = " or ".join(where)
            raise ConfigError(f"schedule: {fault.kind}: got {fault.where!r}, expected {expected}")
    return trial
