"""Impairments that depend on other packets: finite rates with queues, and order.

These classes only describe queues; `netem.bottleneck` implements them.
"""

from typing import Annotated, Literal

from msgspec import Meta

from skytether.netem.impairments.impairment import Impairment, impairment
from skytether.shared.law.model import Array

QUEUE_BYTES = 64_000
"""Default capacity of a queue [B]."""

DELIVERY_BYTES = 1504
"""Bytes delivered at each time of a mahimahi file."""

Bytes = Annotated[int, Meta(ge=1, le=67_108_864)]
Drop = Literal["tail", "codel"]
"""Drop policy of a queue: tail drop, or CoDel, which keeps queues short (RFC 8289)."""
Served = Literal["first", "fair"]
"""Order of service: first in, first out; or fair: flows in turn, with equal shares of bytes."""


@impairment(name="ordered")
class Ordered(Impairment):
    """Keeps packets of a flow in order: each packet waits for all earlier packets."""

    is_ordered = True


class Queued(Impairment):
    """Finite rate with a queue that packets of all flows share."""

    is_queue = True
    times_s: Array | None = None
    """Times at which DELIVERY_BYTES may leave the queue [s]; the last time is also the period.
    None: packets leave at any time."""
    keeps_all = False
    """Whether nothing is dropped, because senders wait for space in the queue."""

    def __init__(self, queue: int, drop: Drop, serve: Served) -> None:
        self.room_bytes = queue
        self.drop: Drop = drop
        self.serve: Served = serve

    @property
    def bytes_per_s(self) -> float:
        raise NotImplementedError


@impairment(name="rate")
class Rate(Queued):
    """Limits the rate to bytes_per_s, IP and UDP headers included; excess packets queue."""

    def __init__(
        self,
        bytes_per_s: Annotated[float, Meta(ge=1, le=1e10)],
        queue: Bytes = QUEUE_BYTES,
        drop: Drop = "tail",
        serve: Served = "first",
    ) -> None:
        super().__init__(queue, drop, serve)
        self._bytes_per_s = bytes_per_s

    @property
    def bytes_per_s(self) -> float:
        return self._bytes_per_s
