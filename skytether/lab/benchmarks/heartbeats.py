"""Heartbeats: false losses of a working link, and how soon a dead link is noticed.

The model has one direction of an idle link, on which only heartbeats are sent: the sender's timer
on its grid of steps, netem's fates of packets, and the listener's `Hearing` and time-out. Nothing
is flown, so an hour takes well under a second. The silence that the listener asks for reaches the
sender without loss or delay.

    python -m skytether.lab.benchmarks.heartbeats --hours 100
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import NamedTuple

from skytether.netem.fate import Fates
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.law.heartbeat import NUMBERS, Hearing, false_per_h, silences
from skytether.shared.scenario.air.draws import SLOT_NS
from skytether.shared.scenario.schema import DirectionConfig
from skytether.shell import options

STEP_NS = 50 * MILLISECOND_NS
"""Length of a step of both ends [ns]."""
LIFE_S = 600
"""Length of a session, which begins without knowledge of the loss [s]."""
NETWORKS = (
    ("0", DirectionConfig(loss=0.0)),
    ("0.1", DirectionConfig(loss=0.1)),
    ("0.3", DirectionConfig(loss=0.3)),
    ("0.5", DirectionConfig(loss=0.5)),
    ("0.1 in bursts of 0.5 s", DirectionConfig(loss=0.1, burst_s=0.5)),
)
"""Networks by the share of packets lost; delays are the paper's."""
LINKS = ((1.0, 0.1), (2.0, 0.5), (1.5, None), (3.0, None))
"""Time-out [s], and time between heartbeats [s]; None where the time follows the loss."""


class KeptAlive(NamedTuple):
    """Results of an idle link."""

    false_per_h: float
    """False losses per hour."""
    packets_per_s: float
    """Heartbeats per second."""
    noticed_s: tuple[float, float]
    """Mean and largest time from the cut until it was noticed [s]."""


class WaitingEnd:
    """Receiving end of an idle link."""

    def __init__(self, timeout_ns: int, fixed_ns: int | None) -> None:
        self._timeout_ns = timeout_ns
        self.hearing = Hearing(timeout_ns, STEP_NS, fixed_ns)
        """Estimator of the silence that the end asks for."""
        self._under_way: list[tuple[int, int]] = []
        """Heap of packets under way: time of arrival [ns] and number."""
        self.heard_ns: int | None = None
        """Time of the newest arrival [ns]."""
        self.false = 0
        """Number of false losses: the link was taken for lost, and a packet came later."""

    def send(self, at_ns: int, number: int) -> None:
        """Send a packet that arrives at a given time."""
        heappush(self._under_way, (at_ns, number))

    def hear(self, until_ns: int) -> None:
        """Receive all packets up to a time."""
        while self._under_way and self._under_way[0][0] <= until_ns:
            at_ns, number = heappop(self._under_way)
            self.false += self.heard_ns is not None and at_ns - self.heard_ns > self._timeout_ns
            self.heard_ns = at_ns
            self.hearing.hear(number % NUMBERS, number)


def keep(
    network: DirectionConfig, timeout_s: float, heartbeat_s: float | None, lives: int
) -> KeptAlive:
    """Keep a link alive for a number of sessions of LIFE_S, and cut it at the end of each."""
    timeout_ns, end_ns = seconds_to_ns(timeout_s), LIFE_S * SECOND_NS
    fixed_ns = None if heartbeat_s is None else seconds_to_ns(heartbeat_s)
    false, sent, noticed_s = 0, 0, []
    for seed in range(1, lives + 1):
        listener, fates = WaitingEnd(timeout_ns, fixed_ns), Fates(network, seed, "uplink", 0)
        now_ns, number = 0, 0
        while now_ns < end_ns:
            listener.hear(now_ns)
            fate = fates.at(now_ns // SLOT_NS)
            if not fate.lost:
                listener.send(now_ns + fate.delay_ns, number)
            number += 1
            now_ns += -(-listener.hearing.silence_ns // STEP_NS) * STEP_NS
        listener.hear(2 * end_ns)
        false, sent = false + listener.false, sent + number
        noticed_s.append(((listener.heard_ns or 0) + timeout_ns - end_ns) / SECOND_NS)
    hours = lives * LIFE_S / 3600.0
    mean_s = sum(noticed_s) / lives
    return KeptAlive(false / hours, sent / lives / LIFE_S, (mean_s, max(noticed_s)))


def computed(loss: float, timeout_s: float, heartbeat_s: float | None) -> float:
    """Expected number of false losses per hour with independent packet losses."""
    timeout_ns = seconds_to_ns(timeout_s)
    if heartbeat_s is not None:
        return false_per_h(seconds_to_ns(heartbeat_s), timeout_ns, loss)
    table = silences(timeout_ns, STEP_NS)
    silence_ns = next((ns for most, ns in table if loss <= most), table[-1][1])
    return false_per_h(silence_ns, timeout_ns, loss)


@dataclass(frozen=True)
class HeartbeatOptions:
    """Options of this command."""

    hours: float = 1.0
    """Time for which each link is kept [h]."""


def main(argv: Sequence[str] | None = None) -> None:
    """Print false losses and detection times of each link."""
    argv = sys.argv[1:] if argv is None else argv
    given = options.read(HeartbeatOptions(), argv, "heartbeats", main.__doc__)
    lives = max(1, round(given.hours * 3600 / LIFE_S))
    print(
        "| time-out / heartbeat [s] | lost packets | computed [1/h] | kept [1/h] | heartbeats/s |"
        " noticed, mean and at most [s] |\n|---|---|---|---|---|---|"
    )
    for timeout_s, heartbeat_s in LINKS:
        for name, network in NETWORKS:
            kept = keep(network, timeout_s, heartbeat_s, lives)
            alone = not network.burst_s
            known = f"{computed(network.loss, timeout_s, heartbeat_s):.2g}" if alone else ""
            every = "auto" if heartbeat_s is None else f"{heartbeat_s:g}"
            mean_s, most_s = kept.noticed_s
            print(
                f"| {timeout_s:g} / {every} | {name} | {known} | {kept.false_per_h:.2g} |"
                f" {kept.packets_per_s:.1f} | {mean_s:.1f}, {most_s:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
