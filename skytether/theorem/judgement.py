"""Judgement of a mission's flight: whether the theorem's assumptions held, and who waited."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.theorem.hypotheses import Hypothesis, hypotheses
from skytether.theorem.waits import Reason, Wait, waits

WAITS_SHOWN = 6
"""Largest number of waits of a kind that are listed."""
SHORT_S = 1.0
"""Longest usual wait for an acknowledgement if no packet is lost [s]."""

TITLE = "What the theorem of separation assumes"
HEADING = "condition", "", "held", "margin", "of vehicle", "at step", "checked"


@dataclass(frozen=True, slots=True)
class Judgement:
    """Hypotheses of the theorem, and waits, of a mission's flight; `str` makes a text of both."""

    hypotheses: tuple[Hypothesis, ...]
    waits: tuple[Wait, ...] = ()
    """Waits, the longest first; empty for a flight over UDP."""

    @property
    def rows(self) -> list[Sequence[str]]:
        """Rows of the table of hypotheses, as text; HEADING has the column names."""
        return [_row(each) for each in self.hypotheses]

    def __str__(self) -> str:
        return "\n".join([*_hypotheses(self.hypotheses), *_waits(self.waits)])


def judged(record: Record, scenario: Scenario, reasons: Sequence[Reason] = ()) -> Judgement:
    """Judgement of a mission's flight; over UDP it has no waits. `reasons`: see `waits`."""
    return Judgement(hypotheses(record, scenario), waits(record, scenario, reasons))


def _hypotheses(found: Sequence[Hypothesis]) -> Iterator[str]:
    if not found:
        return
    yield f"{TITLE} (docs/together-proof.md), and its least margin:"
    rows = [HEADING, *(_row(each) for each in found)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield ("  " + "  ".join(map(str.ljust, row, widths))).rstrip()
    if any(0.0 < each.checked < 1.0 for each in found):
        yield "  A motion is recorded for control.horizon steps; later ones are not checked."


def _row(each: Hypothesis) -> Sequence[str]:
    held = {True: "yes", False: "NO", None: "?"}[each.is_held]
    margin = f"{each.margin:.3g} {each.unit}" if math.isfinite(each.margin) else "-"
    vehicles = " and ".join(map(str, each.vehicles))
    step = "" if each.step is None else str(each.step)
    number = str(each.condition or "promise")
    checked = f"{each.checked:.0%}" if each.checked or each.is_held is None else "counts"
    return number, each.name, held, margin, vehicles, step, checked


def _waits(waited: Sequence[Wait]) -> Iterator[str]:
    begun = [each for each in waited if each.kind == "to begin"]
    heard = [each for each in waited if each.kind == "acknowledgement"]
    late = [each for each in heard if each.lost and each.for_s > SHORT_S]
    ways = [each for each in waited if each.kind == "way"]
    if not waited:
        return
    yield "Who waited for whom:"
    if begun:
        yield f"  all for vehicle {begun[0].other} to begin, up to {begun[0].for_s:.2f} s"
    for each in ways[:WAITS_SHOWN]:
        whom = f"vehicle {each.other}" if each.other else "a zone"
        own = f", {_packets(each, 'whose')}" if not math.isnan(each.motion_s) else ""
        yield f"  vehicle {each.vehicle} for {whom}, {_when(each)}{own}"
    for each in late[:WAITS_SHOWN]:
        yield f"  vehicle {each.vehicle}, {_when(each)}: {_packets(each, 'its')}"
    hidden = len(ways[WAITS_SHOWN:]) + len(late[WAITS_SHOWN:])
    if hidden:
        yield f"  and {hidden} shorter waits"
    if heard:
        usual = sorted(each.for_s for each in heard)[len(heard) // 2]
        yield f"  {len(heard)} motions were acknowledged or lost, at the median in {usual:.2f} s"


def _when(each: Wait) -> str:
    return f"{each.start_s:.2f} to {each.end_s:.2f} s"


def _packets(each: Wait, whose: str) -> str:
    """Text about the motion that was not acknowledged, and its lost packets."""
    lost = [
        f"{count[1]} of {count[0]} {what}{'s' * (count[0] != 1)} lost"
        for count, what in ((each.plans, "packet"), (each.reports, "answer"))
        if count[1]
    ]
    return f"{whose} motion of {each.motion_s:.2f} s was not acknowledged: {', '.join(lost)}"
