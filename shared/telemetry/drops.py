"""Packets dropped in a flight by each process, by reason, from the figures that it counted.

`docs/operating.md` says what each reason means. Figures may come from a file, so their types are
checked.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import msgspec


class DirectionCounts(msgspec.Struct, frozen=True):
    """Packets that netem did not forward in one direction, see `netem.link.Counts`."""

    undelivered: int = 0
    lost: int = 0
    oversized: int = 0
    overflowed: int = 0
    dropped: int = 0


class VehicleCounts(msgspec.Struct, frozen=True):
    """What a client counted of one vehicle."""

    dropped: dict[str, int] = {}


class ProcessCounts(msgspec.Struct, frozen=True):
    """What a process counted, of all that `Endpoint.figures` and the process itself have."""

    dropped: dict[str, int] = {}
    by_vehicle: dict[str, VehicleCounts] = {}
    others_dropped: dict[str, int] = {}
    """A client's, of the vehicles that `by_vehicle` leaves out."""
    uplink: DirectionCounts = DirectionCounts()
    downlink: DirectionCounts = DirectionCounts()
    refused: int | dict[str, int] = 0
    """netem's packets without a flow; a server counts HELLOs here, which it answers."""
    kernel_drops: int = 0


def counted(figures: Mapping[str, Any]) -> ProcessCounts:
    """What the figures of a process say about dropped packets.

    Raises:
        ValueError: a count is of another type.
    """
    return msgspec.convert(figures, ProcessCounts)


def drops(
    figures: Mapping[str, Mapping[str, Any]], vehicle: int | None = None
) -> dict[str, dict[str, int]]:
    """Number of packets that each process dropped, by reason; only reasons that occurred.

    Args:
        figures: of each process, by its name; those of a server's workers are added up.
        vehicle: number of the vehicle, of all that a client flies; None: all of them.
    """
    totals: dict[str, Counter[str]] = {}
    for name, each in figures.items():
        process = counted(each)
        total = totals.setdefault(name.partition(".")[0], Counter())
        total.update(process.dropped)
        for number, counts in process.by_vehicle.items():
            total.update(counts.dropped if vehicle in (None, int(number)) else {})
        total.update(process.others_dropped if vehicle is None else {})
        for direction in ("uplink", "downlink"):
            lost = msgspec.structs.asdict(getattr(process, direction))
            total.update({f"{direction} {reason}": count for reason, count in lost.items()})
        if isinstance(process.refused, int):
            total["refused"] += process.refused
        total["kernel"] += process.kernel_drops
    known = {end: {why: n for why, n in totals[end].most_common() if n} for end in sorted(totals)}
    return {end: reasons for end, reasons in known.items() if reasons}
