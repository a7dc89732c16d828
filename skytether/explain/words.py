"""Text of an explanation."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby

from skytether.explain.cases import Bad, Unit
from skytether.explain.causes import WHAT, Cause, CausePart, Rescues, lane_name, named
from skytether.explain.moments import Moment
from skytether.explain.remedies import Remedy
from skytether.shared.endpoints.directions import FLIGHT
from skytether.shared.telemetry.record import UPLINK

RESCUES_SHOWN = 8
"""Largest number of packets whose times are listed."""


def text(
    found: Sequence[Moment],
    moment: Moment | None,
    cause: Cause | None,
    rescues: Rescues | None,
    remedies: Sequence[Remedy] | None,
) -> str:
    """Explanation so far of one of the found moments, in plain text; see `Explanation`."""
    if moment is None:
        return "Nothing went wrong, compared with a flight in the same wind over a perfect network."
    lines = [f"{_when(moment)}: {_subject(moment)}{moment.says}{_figures(moment)}."]
    if others := [each for each in found if each != moment]:
        listed = ", ".join(f"{each.start_s:.1f} s {each.says}" for each in others)
        lines.append(f"Other moments (explained with --at): {listed}.")
    if cause is not None:
        lines += ["", *_cause(cause, moment)]
        if rescues is not None and rescues.tried:
            lines.append(_rescued(rescues))
        if cause.innocent:
            changes = (f"{name}{_off(change_m, '+')}" for name, change_m in cause.innocent)
            lines.append(f"Not the cause (change of the error without it): {', '.join(changes)}.")
    if remedies:
        lines += ["", *_remedies(remedies)]
    return "\n".join(lines)


def _when(moment: Moment) -> str:
    return f"{moment.start_s:.1f} s to {moment.end_s:.1f} s"


def _subject(moment: Moment) -> str:
    if moment.kind in ("failure", "packets", "path"):
        return ""
    return f"vehicle {moment.vehicle} " if moment.vehicle else "two vehicles "


def _figures(moment: Moment) -> str:
    if moment.kind in ("brake", "error"):
        return f", {moment.figure:.2f} m from its reference at most, else {moment.usual:.2f} m"
    return ""


def _cause(cause: Cause, moment: Moment) -> Iterator[str]:
    since = f"from {cause.since_s:.1f} s on" if cause.since_s else "from the beginning on"
    if not cause.parts:
        yield (
            f"Why: it is the scenario itself. With all of {_units(cause.among)} {since} taken away "
            f"it comes about all the same{_off(cause.error_m)}."
        )
        return
    yield f"Why: {_joined(_counted(cause.parts))}{', together' * (len(cause.parts) > 1)}."
    yield from _table(cause.parts, moment)
    this = "This suffices" if len(cause.parts) == 1 else "These suffice"
    others = cause.among - len(cause.parts)
    yield (
        f"{this}: without {_units(others, 'other')} {since}, it comes about all the same"
        f"{_off(cause.error_m)}."
    )
    if cause.averting:
        its = "it" if len(cause.parts) == 1 else "them"
        yield (
            f"Without {its}, other units suffice. It is averted without "
            f"{_joined(_counted(cause.averting))}:"
        )
        yield from _table(cause.averting, moment)


def _table(parts: Sequence[CausePart], moment: Moment) -> Iterator[str]:
    rows = [_row(list(some), moment) for _, some in groupby(parts, _kind)]
    shown = [column for column in zip(*rows, strict=True) if any(column)]
    widths = [max(map(len, column)) for column in shown]
    for row in zip(*shown, strict=True):
        yield "  ".join(["", *map(str.ljust, row, widths)]).rstrip()


def _units(count: int, other: str = "") -> str:
    words = " ".join(["the", str(count), *[other] * bool(other)])
    return f"{words} unit{'s' * (count != 1)} (losses, late packets, wind …)"


def _counted(parts: Iterable[CausePart]) -> list[str]:
    """Nouns of parts with their number, such as "2 outages of the uplink"."""
    nouns = Counter(_noun(part.unit) for part in parts)
    return [
        " ".join([_several(count, what) if where or count > 1 else what, where]).strip()
        for (what, where), count in nouns.items()
    ]


def _several(count: int, noun: str) -> str:
    """Number and noun, such as "2 periods of late packets"."""
    head, of, rest = noun.partition(" of ")
    return f"{count} {head}s{of}{rest}" if count > 1 else f"one {noun}"


def _noun(unit: Unit) -> tuple[str, str]:
    """Noun of a unit, and its direction in words. A unit such as wind has an empty direction."""
    if not isinstance(unit, Bad):
        return named(unit), ""
    return WHAT[unit.is_late, unit.is_packet], f"of the {FLIGHT[unit.lane[1]]}"


def _kind(part: CausePart) -> object:
    """Kind of a part; neighbouring parts of one kind, such as lost packets, share a row."""
    unit = part.unit
    return (unit.lane, unit.is_late) if isinstance(unit, Bad) and unit.is_packet else part


def _row(parts: Sequence[CausePart], moment: Moment) -> list[str]:
    """Cells of a row: lane, time, lost packets, sufficient length, result without the part."""
    first, last = parts[0], parts[-1]
    unit, plans = first.unit, sum(part.plans for part in parts)
    times = dict.fromkeys(f"{each:.1f}" for each in (first.start_s, first.end_s))
    when = f"{' to '.join(times)} s" if first.end_s else ""
    if math.isinf(first.end_s):
        when = f"at {first.start_s:.1f} s"
    if not isinstance(unit, Bad):
        return [named(unit), when, "", "", _without(parts, moment)]
    verb, packets = "late" if unit.is_late else "lost", first.packets
    if unit.is_packet:
        packets = len(parts)
        when = f"{first.start_s:.2f} s" + f" to {last.start_s:.2f} s" * (packets > 1)
    met = f"{packets} packet{'s' * (packets != 1)} {verb}"
    if unit.lane[1] == UPLINK:
        met += f", {plans} of them plans" if packets > 1 else ", a plan" * plans
    enough = ""
    if first.shortest_s:
        least, most = (f"{each:.2f}" for each in first.shortest_s)
        enough = f"{least if least == most else f'{least} to {most}'} s of it are enough"
    return [lane_name(unit.lane), when, met, enough, _without(parts, moment)]


def _without(parts: Sequence[CausePart], moment: Moment) -> str:
    needed = sum(part.is_needed for part in parts)
    if math.isnan(parts[0].error_m) and not needed:  # the flight without this part is not flown yet
        return ""
    if len(parts) > 1:
        return f"{needed} of {len(parts)} needed by itself"
    part = parts[0]
    off = _off(part.error_m) if moment.kind in ("brake", "error") else ""
    if off and not math.isnan(part.calm_m):
        least, most = sorted((part.calm_m, part.error_m))
        off = f" ({least:.2f} to {most:.2f} m, without and with the push)"
    return f"without: {'does not' if needed else 'all the same'}{off}"


def _rescued(rescues: Rescues) -> str:
    count, tried = len(rescues.packets), rescues.tried
    if not count:
        return f"No single packet that was sent before would have helped: 0 of {tried}."
    times = [
        f"{each.time_s:.2f} s ({'plan' if each.is_plan else 'no plan'})"
        for each in rescues.packets[:RESCUES_SHOWN]
    ]
    more = " …" if count > RESCUES_SHOWN else ""
    return f"A single packet would have averted it, {count} of {tried}: {', '.join(times)}{more}."


def _off(error_m: float, sign: str = "") -> str:
    """Error in brackets [m]; empty for NaN, which means that no step was flown."""
    return "" if math.isnan(error_m) else f" ({error_m:{sign}.2f} m)"


def _remedies(tried: Sequence[Remedy]) -> Iterator[str]:
    others = tried[0].elsewhere
    heading = ["What would have helped", "here: error", "brakes", "packets/s"]
    if others is not None:
        heading += [f"{others.flights} other seeds: error", "brakes", "packets/s"]
    rows = [heading]
    for each in tried:
        row = [
            each.name,
            _off(each.error_m).strip(" ()"),
            str(each.brakes),
            f"{each.packets_per_s:.1f}",
        ]
        if (over := each.elsewhere) is not None:
            row += [f"{over.error_m:.2f} m", f"{over.brakes:.2f}", f"{over.packets_per_s:.1f}"]
        rows.append(row + [""] * (len(heading) - len(row)))
    widths = [max(len(row[column]) for row in rows) for column in range(len(heading))]
    for first, *rest in rows:
        cells = (f"{cell:>{width}}" for cell, width in zip(rest, widths[1:], strict=True))
        yield f"  {first:{widths[0]}}  {'  '.join(cells)}".rstrip()
    helps = [each.name for each in tried[1:] if each.averts]
    said = f"in this flight it is averted by {_joined(helps)}" if helps else "nothing tried helps"
    one = "" if others else "; one flight proves no remedy: add --seeds 20"
    yield f"  → {said}{one}"


def _joined(words: Sequence[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} and {last}" if most else last
