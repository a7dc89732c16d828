"""Conversion of an autopilot's or a robot's clock to the client's. An autopilot returns the time
since its boot in answer to TIMESYNC; for a robot see `client.ros2.odometry`.

    the client asks at t₁; the answer, at which the autopilot's clock showed b, arrives at t₂:
    offset = (t₁ + t₂) / 2 - b, with an error of at most (t₂ - t₁) / 2

Answers much slower than the fastest in the window are ignored. A line fitted to the rest gives
offset and drift. Any two answers bound the drift:

    drift = (offset₂ - offset₁) / (t₂ - t₁), with an error of at most the mean of both round trips
                                             / (t₂ - t₁)

In the first seconds, when a fit would follow the noise, the drift of smallest magnitude within
these bounds is used. The line is then shifted until it agrees with every answer. An answer bounds
the offset at the time of the answer and, by the bounds of the drift, the present offset.
"""

from collections import deque
from statistics import fmean, median
from typing import NamedTuple

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

WINDOW = 64
KNOWN = 4
"""Number of answers needed for a usable clock."""
ASKED_MAX = 16
"""Largest number of unanswered questions; older questions are discarded."""
ROUND_TRIP_MAX_NS = SECOND_NS
"""Longest usable round trip of an answer, for an autopilot aboard [ns]."""
SPREAD_NS = MILLISECOND_NS
"""Margin: a round trip is usable up to 1.5 times the shortest one plus SPREAD_NS [ns]."""
DRIFT_SPAN_NS = 10 * SECOND_NS
"""Shortest time span of the answers from which the drift is fitted."""
DRIFT_MAX = 0.02
"""Largest usable drift of the autopilot's clock. PX4's own simulator runs 0.9 % slow."""
WANDER = 500e-6
"""Largest change of the drift in the window, due to a warming crystal or a busy simulator."""
RATED = 8
"""Number of newest answers from which the rate of an unusable clock is computed."""
JUMP_NS = 100 * MILLISECOND_NS
"""Deviation of an answer from the line that suggests a jump, beyond its round trip [ns]."""
JUMPS = 3
BOOT_MAX_NS = 2**62


class Sample(NamedTuple):
    local_ns: int
    """Midpoint between question and answer [ns; the client's clock]."""
    offset_ns: int
    """The client's clock minus the autopilot's [ns]."""
    round_trip_ns: int
    """Time from question to answer [ns]."""


class BootClock:
    """Converts the time since the autopilot's boot to the client's clock."""

    def __init__(self, round_trip_max_ns: int = ROUND_TRIP_MAX_NS) -> None:
        self._round_trip_max_ns = round_trip_max_ns
        self._questions: deque[int] = deque(maxlen=ASKED_MAX)
        self._samples: deque[Sample] = deque(maxlen=WINDOW)
        self._taken = 0
        """Number of answers used since the clock began or last jumped."""
        self._deviating: list[Sample] = []
        self._line = (0, 0.0, 0.0)
        """Reference time [ns; the client's clock], offset at that time [ns], and drift."""
        self.round_trip_ns: int | None = None
        self.drift = 0.0
        """Rate at which the client's clock gains on the autopilot's."""
        self._answers: deque[tuple[int, int]] = deque(maxlen=RATED)
        """Newest answers, used or not: time on the client's clock, and time since boot [ns]."""
        self.jumps = 0
        """Number of jumps of the autopilot's clock, mostly reboots."""

    @property
    def is_known(self) -> bool:
        return self._taken >= KNOWN

    @property
    def heard_ns(self) -> int:
        """Time of the newest answer [ns; the client's clock]; needs `is_known`."""
        return self._answers[-1][0]

    @property
    def wrong_rate(self) -> float | None:
        """Rate of the autopilot's clock relative to the client's; None if close to 1 or unknown."""
        if len(self._answers) < KNOWN:
            return None
        (local_ns, boot_ns), (local_after_ns, boot_after_ns) = self._answers[0], self._answers[-1]
        passed_ns, boot_passed_ns = local_after_ns - local_ns, boot_after_ns - boot_ns
        # Sum of the errors of both answers. A negative interval means a reboot, not a wrong rate.
        error_ns = 2 * (self.round_trip_ns or 0) + SPREAD_NS
        if (
            boot_passed_ns <= 0
            or abs(boot_passed_ns - passed_ns) <= DRIFT_MAX * passed_ns + error_ns
        ):
            return None
        return boot_passed_ns / passed_ns

    @property
    def rate_fault(self) -> str:
        """Message about the rate of an unusable clock; empty if the clock is usable."""
        rate = self.wrong_rate
        return "" if rate is None else f"{rate:.3g}, expected 1 within {DRIFT_MAX:.0%}"

    def ask(self, *, now_ns: int) -> int:
        self._questions.append(now_ns)
        return now_ns

    def hear(self, boot_ns: int, stamp_ns: int, *, now_ns: int) -> bool:
        """Process an answer. Return False if the answer is unrequested, a duplicate, late or
        impossible.

        Args:
            boot_ns: time since boot in the answer.
            stamp_ns: time stamp of the question.
        """
        if stamp_ns not in self._questions:
            return False
        self._questions.remove(stamp_ns)
        round_trip_ns = now_ns - stamp_ns
        if not (0 <= round_trip_ns <= self._round_trip_max_ns and 0 < boot_ns < BOOT_MAX_NS):
            return False
        local_ns = stamp_ns + round_trip_ns // 2
        sample = Sample(local_ns, local_ns - boot_ns, round_trip_ns)
        self._answers.append((local_ns, boot_ns))
        if self._samples and abs(sample.offset_ns - self._offset(local_ns)) > (
            JUMP_NS + round_trip_ns
        ):
            self._deviating.append(sample)
            if len(self._deviating) < JUMPS:
                return False
            self._samples.clear()
            self._samples.extend(self._deviating[:-1])
            self._taken = len(self._samples)
            self.jumps += 1
        self._deviating.clear()
        self._samples.append(sample)
        self._taken += 1
        self._fit()
        return True

    def _fit(self) -> None:
        """Fit a line to the quick answers that agree with the newest quick answer."""
        least = min(sample.round_trip_ns for sample in self._samples)
        most = least + least // 2 + SPREAD_NS
        quick = [sample for sample in self._samples if sample.round_trip_ns <= most]
        self.round_trip_ns = least
        agreeing, least_drift, most_drift = _agreeing(quick)
        if len(agreeing) < len(quick):
            while self._samples[0] != agreeing[0]:
                self._samples.popleft()
        newest = self._samples[-1].local_ns
        span_ns = agreeing[-1].local_ns - agreeing[0].local_ns
        slope = _slope(agreeing) if span_ns >= DRIFT_SPAN_NS else 0.0
        self.drift = max(least_drift, min(most_drift, slope))
        base = agreeing[-1].offset_ns
        offset = median(
            sample.offset_ns - base - self.drift * (sample.local_ns - newest) for sample in agreeing
        )
        bounds = least_drift - WANDER, most_drift + WANDER
        self._line = newest, self._within(base + offset, *bounds), self.drift

    def _within(self, offset_ns: float, least_drift: float, most_drift: float) -> float:
        """Offset at the newest answer, moved as little as needed to agree with all answers [ns]."""
        newest = self._samples[-1].local_ns
        least = max(
            sample.offset_ns - sample.round_trip_ns / 2 + least_drift * (newest - sample.local_ns)
            for sample in self._samples
        )
        most = min(
            sample.offset_ns + sample.round_trip_ns / 2 + most_drift * (newest - sample.local_ns)
            for sample in self._samples
        )
        return max(least, min(most, offset_ns)) if least <= most else offset_ns

    def _offset(self, local_ns: int) -> float:
        origin_ns, offset_ns, drift = self._line
        return offset_ns + drift * (local_ns - origin_ns)

    def local_ns(self, boot_ns: int) -> int:
        """Time on the client's clock at a time since boot [ns]; needs `is_known`."""
        origin_ns, offset_ns, drift = self._line
        # local = boot + offset + drift * (local - origin), solved for local
        since_ns = boot_ns + int(offset_ns) - origin_ns
        return origin_ns + round(since_ns / (1.0 - drift))

    def boot_ns(self, local_ns: int) -> int:
        """Time since boot at a time on the client's clock [ns]; needs `is_known`."""
        return local_ns - round(self._offset(local_ns))


def _agreeing(samples: list[Sample]) -> tuple[list[Sample], float, float]:
    """Newest answers that agree with one another, and the smallest and largest drift they allow.

    Older answers disagree if the drift has changed since, or the clock stood still for a while.
    """
    least, most = -DRIFT_MAX, DRIFT_MAX
    newest = samples[-1]
    for count, other in enumerate(reversed(samples)):
        span_ns = newest.local_ns - other.local_ns
        if span_ns <= 0:
            continue
        drift = (newest.offset_ns - other.offset_ns) / span_ns
        wrong = (newest.round_trip_ns + other.round_trip_ns) / 2 / span_ns
        lower, upper = max(least, drift - wrong), min(most, drift + wrong)
        if lower > upper + WANDER:
            return samples[-count:], least, most
        least, most = min(lower, upper), max(lower, upper)
    return samples, least, most


def _slope(quick: list[Sample]) -> float:
    newest = quick[-1]
    times = [float(sample.local_ns - newest.local_ns) for sample in quick]
    offsets = [float(sample.offset_ns - newest.offset_ns) for sample in quick]
    middle, mean = fmean(times), fmean(offsets)
    spread = sum((time - middle) ** 2 for time in times)
    pairs = zip(times, offsets, strict=True)
    return sum((time - middle) * (offset - mean) for time, offset in pairs) / spread
