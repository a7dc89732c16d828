"""Explanation of the gaps in the calls of a robot program: times without a row of the policy.

Each call before and in a gap whose chunk is missing, late or refused is a *unit*, and so is each
long pause of the program. A unit is repaired in a replay (`calls.Replay`): its chunk then arrives
after the usual delay, with the usual number of rows, and a pause is as long as usual. The cause of
a gap is the kind of units whose repair averts the gap.

| report | chunk | number of a chunk | cause |
|---|---|---|---|
| incomplete | none | | loss on the way to the policy end |
| none | none | none is missing | loss on the way to the policy end |
| complete or none | none | one is missing | loss on the way to the robot end |
| complete | late or none | none is missing | the policy was slow |
| none | none, and no later one | | loss in either direction, or the policy end stopped |

The policy end numbers its chunks, so a missing number is a chunk that was sent and lost. If numbers
are missing for only some calls of a run, the majority decides.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from enum import StrEnum
from functools import cached_property
from statistics import median
from typing import NamedTuple

import msgspec

from skytether.explain.calls import NO_ROW, Arrival, Call, Program, Replay, Reply, recorded
from skytether.explain.smallest import smallest
from skytether.policy.schedule import ROWS_MAX, Kind
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

GAPS_MAX, SHOWN_MAX = 50, 10
"""Largest number of explained gaps of a recording, and of gaps whose explanation is printed."""
BEFORE, LENGTH_MAX = 64, 50
"""Number of replayed calls before a gap, and largest number of explained calls of a gap."""
FEW = 8
"""Smallest number of chunks before a gap whose medians are the usual ones."""
LONG = 2
"""Multiple of the usual pause or delay above which it is long."""
RUNS_MAX = 8
"""Largest number of runs of calls that are listed."""
ROWS_FACTOR, TIME_NS_MAX = 8, 10 * SECOND_NS
"""Largest multiple of the usual number of rows, and longest deadline, that are tried [ns]."""


class Cause(StrEnum):
    RESTART = "the policy end was restarted"
    REFUSED = "the robot end refused observations"
    SEND_RATE = "observations waited for the send rate"
    TO_POLICY = "loss on the way to the policy end"
    TO_ROBOT = "loss on the way to the robot end"
    EITHER = "loss in either direction, or the policy end stopped"
    DELAY = "delay of the network"
    SLOW = "the policy was slow"
    ERROR = "the policy raised errors"
    CHUNK_REFUSED = "the robot end refused chunks"
    PAUSE = "the program paused"
    USUAL = "chunks are too short for their usual delay"


class Unit(NamedTuple):
    place: int
    """Index of its call in the replay."""
    cause: Cause


class Part(msgspec.Struct, frozen=True):
    """Cause, or part of a cause, of a gap."""

    cause: Cause
    evidence: str
    calls: tuple[int, ...]
    """Calls of these units: the repaired ones, those after, and those directly before."""
    repaired: tuple[int, ...]
    """Smallest set of calls whose repair averts the gap, together with the other parts."""


class Gap(msgspec.Struct, frozen=True):
    """Explained gap."""

    start_s: float
    """Time from the first message of the recording [s]."""
    length_s: float
    holds: tuple[int, ...]
    """Numbers of the calls answered with the hold action."""
    errors: tuple[int, ...]
    parts: tuple[Part, ...]
    """Parts of the cause; if `is_any`, the repair of one of them averts the gap."""
    is_any: bool
    averting: tuple[str, ...]
    """Further changes with which there is no gap."""
    equal: int
    """Number of answers of the replay that are as recorded, of `replayed` answers."""
    replayed: int

    def __str__(self) -> str:
        kinds = (self.holds, "hold"), (self.errors, "error")
        said = [f"{len(each)} {kind}{'s' * (len(each) > 1)}" for each, kind in kinds if each]
        numbers = sorted((*self.holds, *self.errors))
        times = f"{self.start_s:.2f} s to {self.start_s + self.length_s:.2f} s"
        length = f"no row for {self.length_s:.2f} s"
        lines = [f"{times}: {length}, {' and '.join(said)} ({_calls(numbers)})."]
        which = "or" if self.is_any else "and"
        lines.append(f"Why: {f', {which} '.join(each.cause for each in self.parts)}.")
        for each in self.parts:
            lines.append(f"  {each.evidence}")
            if each.repaired and (self.is_any or each is self.parts[-1]):
                parts = [each] if self.is_any else self.parts
                lines.append(f"  It is averted {_repair(parts)}.")
        if self.averting:
            lines.append(f"It is also averted by {', or by '.join(self.averting)}.")
        if self.equal < self.replayed:
            lines.append(
                f"Only {self.equal} of {self.replayed} answers of the replay are as recorded."
            )
        return "\n".join(lines)


def _repair(parts: Sequence[Part]) -> str:
    pauses = [each for each in parts if each.cause is Cause.PAUSE]
    chunks = sorted(call for each in parts if each not in pauses for call in each.repaired)
    arrive = "chunks of {} arrive" if len(chunks) > 1 else "chunk of {} arrives"
    said = [f"if the {arrive.format(_calls(chunks))} as usual"] * bool(chunks)
    said += ["if the program does not pause"] * bool(pauses)
    return " and ".join(said)


def _calls(numbers: Sequence[int]) -> str:
    """Numbers of calls as text, such as "calls 3, 5 to 8"."""
    runs: list[list[int]] = []
    for each in numbers:
        if runs and each == runs[-1][-1] + 1:
            runs[-1].append(each)
        else:
            runs.append([each])
    if len(runs) > RUNS_MAX:
        return f"{len(numbers)} calls from {numbers[0]} to {numbers[-1]}"
    said = [f"{run[0]} to {run[-1]}" if len(run) > 1 else str(run[0]) for run in runs]
    return f"call{'s' * (len(numbers) != 1)} {', '.join(said)}"


def gaps(programs: Sequence[Program], at_s: float | None = None) -> Iterator[Gap]:
    """Explained gaps of a recording, at most GAPS_MAX.

    Args:
        at_s: time from the first message [s]; only gaps at this time are explained. None: all.
    """
    count = 0
    for program in programs:
        calls, first = program.calls, 0
        while first < len(calls):
            end = first
            while end < len(calls) and calls[end].kind in NO_ROW:
                end += 1
            if end > first and count < GAPS_MAX:
                start_s = (calls[first].answered_ns - program.begin_ns) / SECOND_NS
                until_ns = calls[min(end, len(calls) - 1)].answered_ns
                length_s = (until_ns - calls[first].answered_ns) / SECOND_NS
                if at_s is None or start_s - 0.01 <= at_s <= start_s + length_s + 0.01:
                    count += 1
                    yield _Window(program, first, end).explained(start_s, length_s)
            first = end + 1


def text(programs: Sequence[Program], found: Sequence[Gap]) -> str:
    """Explanation of the gaps of a recording; of more than SHOWN_MAX the causes are counted."""
    calls = sum(len(each.calls) for each in programs)
    lines = [f"{len(found) or 'No'} gap{'s' * (len(found) > 1)} in {calls} calls."]
    lines += [f"\n{each}" for each in found[:SHOWN_MAX]]
    if further := Counter(each.parts[0].cause for each in found[SHOWN_MAX:]):
        counts = ", ".join(f"{cause} ({count})" for cause, count in further.items())
        lines.append(f"\nCauses of further gaps, which --at T explains: {counts}.")
    return "\n".join(lines)


class _Window:
    """Calls around a gap.

    Args:
        first: index of the first call of the gap in the program.
        end: index of the call after the gap.
    """

    def __init__(self, program: Program, first: int, end: int) -> None:
        calls = program.calls
        start = next((i for i in range(first - BEFORE, 0, -1) if calls[i].rows), 0)
        self._program, self._gap = program, calls[first:end]
        self._calls = calls[start : min(end, first + LENGTH_MAX)]
        self._places = range(first - start, len(self._calls))
        """Indices of the gap's calls in the replay."""
        self.replay = recorded(program, self._calls)
        end_of_usual = self._places.start if self._places.start >= FEW else None
        self._pause_ns = int(median(self.replay.pauses_ns[1:end_of_usual] or [0]))
        options = program.options
        self._step_ns = options.step_ns or max(self._pause_ns // options.rows, MILLISECOND_NS)
        self._near = calls[start : end + BEFORE]
        self._arrivals = [arrival for each in self._near for arrival in each.arrivals]
        good = [each for each in self._calls[: self._places.start] if each.rows]
        self._good = good if len(good) >= FEW else [each for each in self._near if each.rows]
        """Calls whose chunks are usual: those before the gap or, if these are few, near it."""

    def _usual(self, time_ns: Callable[[Call, Arrival], int | None]) -> int:
        """Median of a time over the usual chunks [ns]; 0 if there is none."""
        times = [time_ns(each, each.chunk) for each in self._good if each.chunk]
        return int(median([each for each in times if each is not None] or [0]))

    @cached_property
    def usual(self) -> Reply | None:
        """Usual reply; None if no chunk has arrived."""
        if not self._good:
            return None
        rows = Counter(each.rows for each in self._good).most_common(1)[0][0]
        return Reply(self._usual(lambda call, chunk: chunk.time_ns - call.began_ns), rows)

    def explained(self, start_s: float, length_s: float) -> Gap:
        kinds = self.replay.answers()
        equal = sum(each.kind is kind for each, kind in zip(self._calls, kinds, strict=True))
        numbers = {
            kind: tuple(each.number for each in self._gap if each.kind is kind) for kind in NO_ROW
        }
        parts, is_any = self._cause()
        return Gap(
            *(start_s, length_s, numbers[Kind.HOLD], numbers[Kind.ERROR], parts, is_any),
            *(tuple(self._averting(kinds)), equal, len(kinds)),
        )

    # -- units -------------------------------------------------------------------------------------

    @cached_property
    def units(self) -> tuple[Unit, ...]:
        found = list[Unit]()
        for place, call in enumerate(self._calls):
            pause_ns = self.replay.pauses_ns[place]
            if place and pause_ns > LONG * self._pause_ns + self._step_ns:
                found.append(Unit(place, Cause.PAUSE))
            if cause := self._cause_of(call):
                found.append(Unit(place, cause))
        return tuple(found)

    def _cause_of(self, call: Call) -> Cause | None:
        """Reason why the chunk of a call is missing, late or refused; None if it is as usual."""
        chunk = call.chunk
        if call.is_refused:
            return Cause.REFUSED
        if not call.is_asked:
            return None
        if chunk is None:
            return self._why_missing(call)
        if chunk.step.kind == "error":
            return Cause.ERROR
        late = self._why_late(call, chunk)
        return late or (Cause.CHUNK_REFUSED if chunk.step.kind == "refused" else None)

    def _why_late(self, call: Call, chunk: Arrival) -> Cause | None:
        late_ns = chunk.time_ns - call.began_ns - (self.usual.delay_ns if self.usual else 0)
        if not self.usual or late_ns <= self._step_ns:
            return None
        after_ns = _after_report(call, chunk)
        is_late = after_ns is not None and after_ns - self._usual(_after_report) > late_ns // 2
        # Reports on calls nearby show whether the network was as late as the chunk.
        near = [each for each in self._calls if abs(each.number - call.number) <= 8]
        trips_ns = [trip for each in near if (trip := _trip(each)) is not None]
        varies_ns = max(trips_ns, default=0) - self._usual(lambda each, _: _trip(each))
        return Cause.SLOW if is_late and varies_ns < late_ns // 2 else Cause.DELAY

    def _why_missing(self, call: Call) -> Cause:
        before, after = self._around(call)
        begun = [each for each in self._program.sessions if each[0] > call.began_ns]
        is_complete = call.came >= call.needed
        if begun and begun[0][1] and (after is None or begun[0][0] < after.time_ns):
            return Cause.RESTART
        if call.sent_ns is None:
            return Cause.SEND_RATE if len(begun) < len(self._program.sessions) else Cause.EITHER
        if call.came and not is_complete:
            return Cause.TO_POLICY
        if after is None or (before and before.session != after.session):
            heard_ns = max(each.reported_ns or 0 for each in self._near)
            is_heard = self.usual and heard_ns > call.began_ns + LONG * self.usual.delay_ns
            return Cause.SLOW if is_complete and is_heard else Cause.EITHER
        return self._way(call, before, after)

    def _way(self, call: Call, before: Arrival | None, after: Arrival) -> Cause:
        """Cause of a missing chunk between two arrivals of one session."""
        first, missing = before.step.call if before else 0, self._missing(before, after)
        between = [each for each in self._near if first < each.number < after.step.call]
        between = [each for each in between if each.sent_ns is not None and not each.arrivals]
        complete = sum(each.came >= each.needed for each in between)
        if call.came < call.needed:
            is_majority = 2 * (missing - complete) > len(between) - complete
            return Cause.TO_ROBOT if is_majority else Cause.TO_POLICY
        if 2 * missing > complete:
            return Cause.TO_ROBOT
        # While the policy computes, the policy end keeps only the newest observation.
        return Cause.SLOW

    def _around(self, call: Call) -> tuple[Arrival | None, Arrival | None]:
        """Last arrival for an earlier call, and first for a later call."""
        before = [each for each in self._arrivals if each.step.call < call.number]
        after = [each for each in self._arrivals if each.step.call > call.number]
        return (
            max(before, key=lambda each: each.step.call, default=None),
            min(after, key=lambda each: each.step.call, default=None),
        )

    def _missing(self, before: Arrival | None, after: Arrival) -> int:
        """Number of chunks that were sent between two arrivals, and have not arrived."""
        first = before.message if before else -1
        came = {each.message for each in self._arrivals if each.session == after.session}
        sent = range(first + 1, after.message)
        return len(sent) - sum(each in sent for each in came)

    # -- repairs -----------------------------------------------------------------------------------

    def _repaired(self, units: Sequence[Unit]) -> Replay:
        pauses_ns, replies = [*self.replay.pauses_ns], [*self.replay.replies]
        refused = self.replay.refused - {place for place, _ in units}
        for place, cause in units:
            if cause is Cause.PAUSE:
                pauses_ns[place] = self._pause_ns
            else:
                replies[place] = self.usual
        return replace(self.replay, pauses_ns=pauses_ns, replies=replies, refused=refused)

    def _averts(self, replay: Replay) -> bool:
        """Whether there is no gap in a replay."""
        kinds = replay.answers()
        return not any(kinds[place] in NO_ROW for place in self._places)

    def _cause(self) -> tuple[tuple[Part, ...], bool]:
        """Parts of the cause, and whether the repair of any one of them averts the gap."""

        def suffice(sets: Sequence[tuple[Cause, ...]]) -> list[bool]:
            return [self._averts(self._repaired(self._of(each))) for each in sets]

        kinds = tuple(dict.fromkeys(each.cause for each in self.units))
        if kinds and self.usual is None:
            return tuple(self._part(each, self._of((each,)), ()) for each in kinds), False
        if self.usual is None or not self._averts(self._repaired(self.units)):
            return (Part(Cause.USUAL, self._evidence(Cause.USUAL, ()), (), ()),), False
        averts = suffice([(each,) for each in kinds])
        alone: list[tuple[Cause, ...]] = [
            (each,) for each, good in zip(kinds, averts, strict=True) if good
        ]
        parts = list[Part]()
        for together in alone or [smallest(kinds, suffice)]:
            needed = smallest(
                self._of(together),
                lambda sets: [self._averts(self._repaired(each)) for each in sets],
            )
            parts += [self._part(each, self._of((each,)), needed) for each in together]
        return tuple(parts), len(alone) > 1

    def _of(self, causes: Sequence[Cause]) -> tuple[Unit, ...]:
        return tuple(each for each in self.units if each.cause in causes)

    def _part(self, cause: Cause, units: Sequence[Unit], needed: Sequence[Unit]) -> Part:
        repaired = [self._calls[each.place].number for each in needed if each.cause is cause]
        shown = [self._calls[each.place] for each in units]
        first = min(repaired, default=shown[0].number)
        numbers = {each.number for each in shown}
        while first - 1 in numbers:
            first -= 1
        shown = [each for each in shown if each.number >= first]
        evidence = self._evidence(cause, shown)
        return Part(cause, evidence, tuple(each.number for each in shown), tuple(repaired))

    # -- evidence ----------------------------------------------------------------------------------

    def _evidence(self, cause: Cause, calls: Sequence[Call]) -> str:
        delay_ns, rows = self.usual or (0, 0)
        usually = f"{delay_ns / SECOND_NS:.3f} s"
        if cause is Cause.USUAL:
            return f"Chunks have {rows} rows and arrive {usually} after their calls."
        said = _calls([each.number for each in calls])
        chunks = [each.chunk for each in calls if each.chunk]
        faults = dict.fromkeys(each.step.fault for each in chunks if each.step.fault)
        if cause is Cause.PAUSE:
            places = [i for i, each in enumerate(self._calls) if each in calls]
            longest_s = max(self.replay.pauses_ns[i] for i in places) / SECOND_NS
            usual_s = self._pause_ns / SECOND_NS
            paused = f"made no call for {longest_s:.2f} s, usually {usual_s:.2f} s"
            return f"Before {said} the program {paused}."
        if cause is Cause.REFUSED:
            return f"Observations of {said}: the reasons are in /events."
        if faults and cause in (Cause.ERROR, Cause.CHUNK_REFUSED):
            return f"{said.capitalize()}: {'; '.join([*faults][:2])}."
        if chunks:
            late_ns = max(each.chunk.time_ns - each.began_ns for each in calls if each.chunk)
            when = f"up to {late_ns / SECOND_NS:.3f} s after their calls, usually {usually}"
            return f"{said.capitalize()}: {len(chunks)} of {len(calls)} chunks arrived, {when}."
        sent = [each for each in calls if each.sent_ns is not None]
        whole = sum(each.came >= each.needed for each in sent)
        partly = sum(0 < each.came < each.needed for each in sent)
        counts = f"{len(sent)} of {len(calls)} observations sent, {whole} of them reported complete"
        counts += f" and {partly} incomplete" * bool(partly)
        before, after = self._around(calls[0])[0], self._around(calls[-1])[1]
        chunks_sent = "no later chunk has arrived"
        if after and before and before.session != after.session:
            chunks_sent = "the next chunk is of a new session"
        elif after:
            missing = self._missing(before, after)
            chunks_sent = f"{missing or 'no'} chunk{'s' * (missing != 1)} missing by number"
        return f"{said.capitalize()}: {counts}; {chunks_sent}."

    # -- options -----------------------------------------------------------------------------------

    def _averting(self, kinds: Sequence[Kind]) -> Iterator[str]:
        """Options, and numbers of rows, with which there is no gap."""
        options, usual = self.replay.options, self.usual
        if usual is None or kinds[self._places.start] not in NO_ROW:
            return

        def with_rows(rows: int) -> bool:
            replies = [
                each and each._replace(rows=rows if each.rows else 0)
                for each in self.replay.replies
            ]
            return self._averts(replace(self.replay, replies=replies))

        def with_deadline(deadline_ns: int) -> bool:
            changed = replace(options, deadline_ns=deadline_ns)
            return self._averts(replace(self.replay, options=changed))

        most = min(ROWS_FACTOR * usual.rows, ROWS_MAX)
        if rows := _least(range(usual.rows + 1, most + 1), with_rows):
            yield f"chunks of {rows} rows instead of {usual.rows}"
        delays_ns = {
            -(-each.delay_ns // (10 * MILLISECOND_NS)) * 10 * MILLISECOND_NS
            for each in self.replay.replies
            if each and options.deadline_ns < each.delay_ns < TIME_NS_MAX
        }
        if deadline_ns := _least(sorted(delays_ns), with_deadline):
            yield f"--deadline {deadline_ns // MILLISECOND_NS}ms"


def _after_report(call: Call, chunk: Arrival) -> int | None:
    """Time from the complete report on an observation to its chunk [ns]."""
    if call.reported_ns is None or call.came < call.parts:
        return None
    return chunk.time_ns - call.reported_ns


def _trip(call: Call) -> int | None:
    """Time from sending an observation to its complete report [ns]."""
    if call.reported_ns is None or call.sent_ns is None or call.came < call.parts:
        return None
    return call.reported_ns - call.sent_ns


def _least(values: Sequence[int], suffices: Callable[[int], bool]) -> int | None:
    """Least of increasing values that suffices, assuming that larger ones do, too; None: none."""
    low, high = 0, len(values)
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if suffices(values[middle]) else (middle + 1, high)
    return values[low] if low < len(values) else None
