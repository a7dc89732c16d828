"""Recorded networks: delays of a recorded path (`recorded`), and times at which packets are
delivered.

Delivery times are read from files in mahimahi's format: each line is the millisecond at which a
packet of 1504 bytes is delivered.
"""

from functools import lru_cache
from typing import Literal

import numpy as np

from skytether.netem.impairments.distributions import interpolated
from skytether.netem.impairments.draws import Draws, Fate
from skytether.netem.impairments.impairment import Impairment, impairment
from skytether.netem.impairments.queues import (
    DELIVERY_BYTES,
    QUEUE_BYTES,
    Bytes,
    Drop,
    Queued,
    Served,
)
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.formats.recorded import Way, recorded_in, table, text_in
from skytether.shared.law.model import Array
from skytether.shared.scenario.registry import File


@impairment(name="trace")
class Trace(Impairment):
    """Delays and loses packets like a recorded path; the recording is repeated, or used once."""

    kind = "delay"

    def __init__(
        self, file: File, play: Literal["loop", "once"] = "loop", way: Way = "auto"
    ) -> None:
        try:
            recorded = recorded_in(file, way)
        except ValueError as error:
            raise ValueError(f"a file of delays ({error})") from None
        times_s, delays_s = recorded.time_s, recorded.delay_s
        last_s = float(times_s[-1])
        self._loop_s = last_s + last_s / max(len(times_s) - 1, 1) if play == "loop" else 0.0
        self._times_s: list[float] = times_s.tolist()
        self._delays_s: list[float] = delays_s.tolist()
        self._lost: list[float] = recorded.lost.astype(float).tolist()
        self._loses = bool(recorded.lost.any())
        self.least_s, self.mean_s = float(delays_s.min()), float(delays_s.mean())
        self.loss = float(recorded.lost.mean())

    def __call__(self, fate: Fate, draws: Draws) -> None:  # noqa: ARG002
        """Apply the recording: a packet is lost if, in the recording, the packet sent nearest to
        the same time was lost.
        """
        time_s = fate.time_s % self._loop_s if self._loop_s else fate.time_s
        fate.delay_ns += seconds_to_ns(interpolated(time_s, self._times_s, self._delays_s))
        if self._loses and interpolated(time_s, self._times_s, self._lost) > 0.5:
            fate.lost = True


@lru_cache(maxsize=16)
def deliveries_in(file: File) -> Array:
    """Times at which packets of DELIVERY_BYTES are delivered [s], from a mahimahi file; shape (n,).

    Raises:
        ValueError: the file has no such times.
    """
    try:
        times = table("\n".join(["ms", *text_in(file).split()]), [0])[:, 0]
        wrong = ~np.isfinite(times) | (times < 0.0) | (np.diff(times, prepend=0.0) < 0.0)
        if wrong.any():
            row = int(np.argmax(wrong))
            problem = f"row {row + 1}: got {times[row]:g}, expected milliseconds in rising order"
            raise ValueError(problem)
        if times[-1] == 0.0:
            raise ValueError("got times of 0 alone, expected milliseconds in rising order")
    except ValueError as error:
        raise ValueError(f"{file.name}: {error}") from None
    return times * 1e-3


@impairment(name="deliveries")
class Deliveries(Queued):
    """Sends queued packets at the times in a mahimahi trace file, which is repeated."""

    def __init__(
        self,
        file: File,
        queue: Bytes = QUEUE_BYTES,
        drop: Drop = "tail",
        serve: Served = "first",
    ) -> None:
        super().__init__(queue, drop, serve)
        try:
            self.times_s = self._times_s = deliveries_in(file)
        except ValueError as error:
            raise ValueError(f"a file of mahimahi ({error})") from None

    @property
    def bytes_per_s(self) -> float:
        return len(self._times_s) * DELIVERY_BYTES / float(self._times_s[-1])
