"""The explanation as text."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby

from skytether.explain.cases import Bad
from skytether.explain.causes import WHAT, Cause, Part, Rescues, lane_name, named
from skytether.explain.moments import Moment
from skytether.explain.remedies import Remedy

RESCUES_SHOWN = 8
"""Largest number of packets whose times are listed."""


def text(
    found: Sequence[Moment],
    moment: Moment | None,
    cause: Cause | None,
    rescues: Rescues | None,
    remedies: Sequence[Remedy] | None,
) -> str:
    """What is known of a moment, one of those found, in plain text; see `Explanation`."""
    if moment is None:
        return "Nothing went wrong, beside a flight in the same wind over a perfect network."
    lines = [f"{_when(moment)}: {_subject(moment)}{moment.says}{_figures(moment)}."]
    if others := [each for each in found if each != moment]:
        listed = ", ".join(f"{each.start_s:.1f} s {each.says}" for each in others)
        lines.append(f"Other moments (explained with --at): {listed}.")
    if cause is not None:
        lines += ["", *_cause(cause, moment)]
        if rescues is not None and rescues.tried:
            lines.append(_rescued(rescues))
        if cause.innocent:
            lines.append(f"Not the cause: {', '.join(map(_innocent, cause.innocent))}.")
    if remedies:
        lines += ["", *_remedies(remedies)]
    return "\n".join(lines)


def _when(moment: Moment) -> str:
    return f"{moment.start_s:.1f} s to {moment.end_s:.1f} s"


def _subject(moment: Moment) -> str:
    if moment.kind in ("failure", "packets"):
        return ""
    return f"vehicle {moment.vehicle} " if moment.vehicle else "two vehicles "


def _figures(moment: Moment) -> str:
    if moment.kind in ("brake", "error"):
        over = f"over a perfect network {moment.usual:.2f} m"
        return f", {moment.figure:.2f} m from its reference at most ({over})"
    return ""


def _cause(cause: Cause, moment: Moment) -> Iterator[str]:
    since = f"from {cause.since_s:.1f} s on" if cause.since_s else "from the beginning on"
    if not cause.parts:
        yield (
            f"Why: it is the scenario itself. With all of {_units(cause.among)} {since} taken away "
            f"it comes about all the same ({cause.error_m:.2f} m)."
        )
        return
    yield f"Why: {_joined(_counted(cause.parts))}{', together' * (len(cause.parts) > 1)}."
    rows = [_row(list(parts), moment) for _, parts in groupby(cause.parts, _kind)]
    widths = [max(len(row[column]) for row in rows) for column in range(2)]
    for first, second, rest in rows:
        yield f"  {first:{widths[0]}}  {second:{widths[1]}}  {rest}".rstrip()
    this = "This suffices" if len(cause.parts) == 1 else "These suffice"
    others = cause.among - len(cause.parts)
    yield (
        f"{this}: without {_units(others, 'other')} {since}, it comes about all the same "
        f"({cause.error_m:.2f} m)."
    )
    idle = [part for part in cause.parts if not part.is_needed]
    if idle and any(part.error_m == part.error_m for part in cause.parts):
        yield f"Not needed by itself: {_joined(_counted(idle))}; something else would do instead."


def _units(count: int, other: str = "") -> str:
    words = " ".join(["the", str(count), *[other] * bool(other)])
    return f"{words} unit{'s' * (count != 1)} (losses, late packets, wind …)"


def _counted(parts: Iterable[Part]) -> list[str]:
    """Nouns of parts with their number, such as 2 outages of the uplink."""
    nouns = Counter(
        f"{WHAT[part.unit.is_late, part.unit.is_packet]}|of the {_way(part.unit)}"
        if isinstance(part.unit, Bad)
        else f"{named(part.unit)}|"
        for part in parts
    )
    said = []
    for noun, count in nouns.items():
        what, _, where = noun.partition("|")
        many = f"{count} {what}s" if where else what
        said.append(f"{many if count > 1 else f'one {what}' if where else what} {where}".strip())
    return said


def _way(unit: Bad) -> str:
    return ("uplink", "downlink")[unit.lane[1]]


def _kind(part: Part) -> object:
    """Parts with the same kind beside each other have one row: packets lost one after another."""
    unit = part.unit
    return (unit.lane, unit.is_late) if isinstance(unit, Bad) and unit.is_packet else part


def _row(parts: Sequence[Part], moment: Moment) -> tuple[str, str, str]:
    first, last = parts[0], parts[-1]
    unit = first.unit
    if not isinstance(unit, Bad):
        when = f"{first.start_s:.1f} to {first.end_s:.1f} s" if first.end_s else ""
        return named(unit), when, _without(parts, moment)
    what = "late" if unit.is_late else "out"
    if unit.is_packet:
        packets, plans = len(parts), sum(part.plans for part in parts)
        when = (
            f"{first.start_s:.2f} to {last.start_s:.2f} s"
            if packets > 1
            else f"{first.start_s:.2f} s"
        )
        what = ""
    else:
        packets, plans = first.packets, first.plans
        when = f"{what} {first.start_s:.1f} to {first.end_s:.1f} s"
    met = f"{packets} packet{'s' * (packets != 1)} {'late' if unit.is_late else 'lost'}"
    if unit.lane[1] == 0:
        met += f", {plans} of them plans"
    long = ""
    if first.shortest_s and len(parts) == 1:
        least, most = first.shortest_s
        long = f"; {least:.2f} to {most:.2f} s of it are enough"
    return lane_name(unit.lane), when, f"{met}{long}; {_without(parts, moment)}"


def _without(parts: Sequence[Part], moment: Moment) -> str:
    needed = [part for part in parts if part.is_needed]
    if parts[0].error_m != parts[0].error_m:  # not flown yet
        return ""
    if len(parts) > 1:
        return f"{len(needed)} of {len(parts)} needed by itself"
    how = "not" if parts[0].is_needed else "all the same"
    off = f", {parts[0].error_m:.2f} m" if moment.kind in ("brake", "error") else ""
    return f"without: {how}{off}"


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


def _innocent(group: tuple[str, float]) -> str:
    name, change_m = group
    return f"{name} ({change_m:+.2f} m without)"


def _remedies(tried: Sequence[Remedy]) -> Iterator[str]:
    others = tried[0].elsewhere
    heading = ["What would have helped", "here: error", "brakes", "packets/s"]
    if others is not None:
        heading += [f"{others.flights} other seeds: error", "brakes", "packets/s"]
    rows = [heading]
    for each in tried:
        row = [each.name, f"{each.error_m:.2f} m", str(each.brakes), f"{each.packets_per_s:.1f}"]
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
