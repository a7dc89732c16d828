"""The autopilot's clock, as TIMESYNC shows it: time since its boot, mapped to the client's own.

    the client asks at t₁ and hears at t₂ that the autopilot's clock showed b in between:
    offset = (t₁ + t₂) / 2 - b, wrong by no more than (t₂ - t₁) / 2

Answers that took much longer than the quickest of the window are left out; a line through the rest
has offset and drift. It is moved to where no answer contradicts it: each says between which two
numbers the offset was, and since then the clocks have drifted by no more than `DRIFT_MAX`.
"""

from collections import deque
from statistics import fmean, median
from typing import NamedTuple

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

WINDOW = 64
"""Answers that are kept."""
KNOWN = 4
"""Answers from which on the clock is known."""
ASKED_MAX = 16
"""Questions that wait for their answer; older ones are given up."""
ROUND_TRIP_MAX_NS = SECOND_NS
"""Longest round trip of an answer that is used, of an autopilot aboard [ns]."""
SPREAD_NS = MILLISECOND_NS
"""Time beyond the least round trip, and half of that, up to which an answer counts [ns]."""
DRIFT_SPAN_NS = 10 * SECOND_NS
"""Time between the first and the last answer from which on drift is fitted [ns]."""
DRIFT_MAX = 500e-6
"""Largest drift that two clocks have."""
JUMP_NS = 100 * MILLISECOND_NS
"""Time beyond the round trip by which an answer is off where a clock has jumped [ns]."""
JUMPS = 3
"""Answers in a row that are off by which a jump is believed."""
BOOT_MAX_NS = 2**62
"""Largest time since boot that is believed [ns]."""


class Sample(NamedTuple):
    """Answer to a question for the time."""

    local_ns: int
    """Middle between question and answer [ns; the client's clock]."""
    offset_ns: int
    """The client's clock less the autopilot's [ns]."""
    round_trip_ns: int
    """Time from question to answer [ns]."""


class BootClock:
    """Maps the time since the autopilot's boot to the client's clock.

    Args:
        round_trip_max_ns: longest round trip of an answer that is used [ns].
    """

    def __init__(self, round_trip_max_ns: int = ROUND_TRIP_MAX_NS) -> None:
        self._round_trip_max_ns = round_trip_max_ns
        self._asked: deque[int] = deque(maxlen=ASKED_MAX)
        self._samples: deque[Sample] = deque(maxlen=WINDOW)
        self._odd: list[Sample] = []
        """Newest answers in a row that are off."""
        self._line = (0, 0.0, 0.0)
        """Time of the client's clock [ns], offset then [ns], and drift."""
        self.round_trip_ns: int | None = None
        """Least round trip of the window [ns]."""
        self.drift = 0.0
        """Rate at which the client's clock gains on the autopilot's."""
        self.jumps = 0
        """Times that the autopilot's clock was begun anew, as after a reboot."""

    @property
    def is_known(self) -> bool:
        """Whether enough answers have come."""
        return len(self._samples) >= KNOWN

    def ask(self, *, now_ns: int) -> int:
        """Stamp of a question that is sent now."""
        self._asked.append(now_ns)
        return now_ns

    def hear(self, boot_ns: int, stamp_ns: int, *, now_ns: int) -> bool:
        """Take an answer; False of one that was not asked for, came twice, late, or is impossible.

        Args:
            boot_ns: time since boot that the autopilot tells.
            stamp_ns: stamp of the question.
            now_ns: time now.
        """
        if stamp_ns not in self._asked:
            return False
        self._asked.remove(stamp_ns)
        round_trip_ns = now_ns - stamp_ns
        if not (0 <= round_trip_ns <= self._round_trip_max_ns and 0 < boot_ns < BOOT_MAX_NS):
            return False
        local_ns = stamp_ns + round_trip_ns // 2
        sample = Sample(local_ns, local_ns - boot_ns, round_trip_ns)
        if self._samples and abs(sample.offset_ns - self._offset(local_ns)) > (
            JUMP_NS + round_trip_ns
        ):
            self._odd.append(sample)
            if len(self._odd) < JUMPS:
                return False
            self._samples.clear()
            self._samples.extend(self._odd[:-1])
            self.jumps += 1
        self._odd.clear()
        self._samples.append(sample)
        self._fit()
        return True

    def _fit(self) -> None:
        """Put a line through the answers that came quickly."""
        least = min(sample.round_trip_ns for sample in self._samples)
        most = least + least // 2 + SPREAD_NS
        quick = [sample for sample in self._samples if sample.round_trip_ns <= most]
        self.round_trip_ns = least
        newest = self._samples[-1].local_ns
        times = [float(sample.local_ns - newest) for sample in quick]
        base = quick[-1].offset_ns
        offsets = [float(sample.offset_ns - base) for sample in quick]
        if times[-1] - times[0] < DRIFT_SPAN_NS:
            offset, self.drift = median(offsets), 0.0
        else:
            middle, mean = fmean(times), fmean(offsets)
            spread = sum((time - middle) ** 2 for time in times)
            pairs = zip(times, offsets, strict=True)
            slope = sum((time - middle) * (offset - mean) for time, offset in pairs) / spread
            self.drift = max(-DRIFT_MAX, min(DRIFT_MAX, slope))
            offset = mean - self.drift * middle
        self._line = newest, self._within(base + offset), self.drift

    def _within(self, offset_ns: float) -> float:
        """Offset at the newest answer, the nearest to this one that no answer contradicts [ns]."""
        newest = self._samples[-1].local_ns
        reach = [
            sample.round_trip_ns / 2 + DRIFT_MAX * (newest - sample.local_ns)
            for sample in self._samples
        ]
        pairs = list(zip(self._samples, reach, strict=True))
        least = max(sample.offset_ns - wrong for sample, wrong in pairs)
        most = min(sample.offset_ns + wrong for sample, wrong in pairs)
        return max(least, min(most, offset_ns)) if least <= most else offset_ns

    def _offset(self, local_ns: int) -> float:
        origin_ns, offset_ns, drift = self._line
        return offset_ns + drift * (local_ns - origin_ns)

    def local_ns(self, boot_ns: int) -> int:
        """Time of the client's clock at a time since boot; the clock must be known."""
        origin_ns, offset_ns, drift = self._line
        # local = boot + offset(local), and the drift is too small to ask twice for it
        near = boot_ns + int(offset_ns)
        return near + int(drift * (near - origin_ns))
