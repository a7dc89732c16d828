"""Number of packets dropped in a flight, by process and reason, from the figures of the processes.

`docs/operating.md` explains the reasons. Figures may come from a file, so their types are checked.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import msgspec


class DirectionCounts(msgspec.Struct, frozen=True):
    """Numbers of packets that netem did not forward in one direction, see `netem.link.Counts`."""

    undelivered: int = 0
    lost: int = 0
    oversized: int = 0
    overflowed: int = 0
    dropped: int = 0


class VehicleCounts(msgspec.Struct, frozen=True):
    dropped: dict[str, int] = {}


class ProcessCounts(msgspec.Struct, frozen=True):
    """Counts of dropped packets among the figures of a process."""

    dropped: dict[str, int] = {}
    by_vehicle: dict[str, VehicleCounts] = {}
    others_dropped: dict[str, int] = {}
    """A client's counts for the vehicles that are missing in `by_vehicle`."""
    uplink: DirectionCounts = DirectionCounts()
    downlink: DirectionCounts = DirectionCounts()
    refused: int | dict[str, int] = 0
    """In netem's figures, packets without a flow. In a server's figures, refused HELLOs; the server
    answers them, so they do not count as dropped."""
    kernel_drops: int = 0


def counted(figures: Mapping[str, Any]) -> ProcessCounts:
    """Counts of dropped packets among the figures of a process.

    Raises:
        ValueError: a count has a wrong type.
    """
    return msgspec.convert(figures, ProcessCounts)


def drops(
    figures: Mapping[str, Mapping[str, Any]], vehicle: int | None = None
) -> dict[str, dict[str, int]]:
    """Number of packets that each process dropped, by reason; only reasons that occurred.

    Args:
        figures: figures of each process, by its name. Figures of a server's workers are added up,
            as are figures of the netems of several paths.
        vehicle: number of the vehicle to count in a client; None: all of its vehicles.
    """
    totals: dict[str, Counter[str]] = {}
    for name, each in figures.items():
        process = counted(each)
        total = totals.setdefault(name.partition(" ")[0].partition(".")[0], Counter())
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
    ordered = {end: {why: n for why, n in totals[end].most_common() if n} for end in sorted(totals)}
    return {end: reasons for end, reasons in ordered.items() if reasons}
