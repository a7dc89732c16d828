"""Merging of the recordings of one flight's processes into one.

    frames of each, by the time of day → one file → summary of the first client's flight

Each process has recorded its own part, with its own scenario. A key's value is taken from the
process that owns the key; keys that both ends use for prediction must be equal. Times are converted
to the clock of the first client, by the difference between the times of day.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from heapq import merge
from typing import BinaryIO

import msgspec
import numpy as np

from skytether.shared.base.errors import RecordingError
from skytether.shared.scenario import catalogue
from skytether.shared.scenario.catalogue import KEYS, keys_of
from skytether.shared.scenario.dotted import flat, set_keys
from skytether.shared.scenario.owners import InFlight, Owner
from skytether.shared.scenario.reading import check, to_table
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry import ends
from skytether.shared.telemetry.feed import Frame, Rows
from skytether.shared.telemetry.record import Rows as Table
from skytether.view.recordings.recorded import Recorded, summary_of
from skytether.view.recordings.recording import Recording

OWNERS = {"client": Owner.VEHICLE, "server": Owner.SERVER, "netem": Owner.NETEM}
"""Owner of keys by part of the record: a key's value is taken from the recording with that part."""

TIMES = {"netem": ["arrived_ns"], ends.PART: ["time_ns", "due_ns"]}
"""Columns with times on the process's clock."""


def join(recordings: Sequence[Recorded], file: BinaryIO) -> None:
    """Merge recordings of processes into one.

    Raises:
        OSError: the file cannot be written.
        RecordingError: the recordings are not of one flight, or one is damaged.
    """
    first = next((each for each in recordings if "client" in each.parts), recordings[0])
    about, scenario = first.about, _scenario(first, recordings)
    joined = Recording(file, scenario, about)
    names = _names(recordings)
    streams = [
        _moved(each, about.offset_ns, named) for each, named in zip(recordings, names, strict=True)
    ]
    for process, frame in merge(*streams, key=lambda each: each[1].time_ns):
        joined.add(process, frame)
    figures = {
        named[process]: counted
        for each, named in zip(recordings, names, strict=True)
        for process, counted in each.figures.items()
    }
    joined.finish(summary_of(scenario, about, _parts(recordings), figures))


def _names(recordings: Sequence[Recorded]) -> list[dict[str, str]]:
    """New names of each recording's processes: the second process with the name `server` becomes
    `server 2`, as in `skytether fly --standby`.
    """
    found, counts = [], Counter[str]()
    for recorded in recordings:
        processes = dict.fromkeys(process for _, process, _ in recorded.frames)
        counts.update(processes.keys())
        found.append(
            {each: f"{each} {counts[each]}" if counts[each] > 1 else each for each in processes}
        )
    return found


def _scenario(first: Recorded, recordings: Sequence[Recorded]) -> Scenario:
    table = to_table(first.scenario)
    # The scenario of a path's netem has only this path's network.
    impaired = keys_of(InFlight.IMPAIRMENT) if first.scenario.network.paths else ()
    for recorded in recordings:
        terms = first.scenario.terms(), recorded.scenario.terms()
        if different := catalogue.differences(*terms):
            message = f"it is of another flight than {first.path}: {different[0]}"
            raise RecordingError(f"{recorded.path}: {message}")
        owners = {OWNERS.get(part) for part in recorded.parts}
        values = flat(to_table(recorded.scenario))
        owned = {key: value for key, value in values if KEYS[key].owner in owners}
        set_keys({key: value for key, value in owned.items() if key not in impaired}, table)
    return check(table, "the scenarios together")


def _moved(
    recorded: Recorded, offset_ns: int, named: Mapping[str, str]
) -> Iterator[tuple[str, Frame]]:
    """Frames of a recording, with their processes' new names, and times on the clock with the given
    offset.
    """
    late_ns = recorded.about.offset_ns - offset_ns
    for _, process, frame in recorded.frames:
        moved = msgspec.structs.replace(frame, time_ns=frame.time_ns + late_ns)
        if isinstance(moved, Rows) and (times := TIMES.get(moved.part)):
            rows = np.frombuffer(moved.rows, recorded.parts[moved.part].dtype).copy()
            for name in times:
                rows[name] += late_ns
            moved = msgspec.structs.replace(moved, rows=rows.tobytes())
        yield named[process], moved


def _parts(recordings: Sequence[Recorded]) -> dict[str, Table]:
    pieces: dict[str, list[Table]] = {}
    for recorded in recordings:
        for part, rows in recorded.parts.items():
            pieces.setdefault(part, []).append(rows)
    for part, tables in pieces.items():
        if len({table.dtype for table in tables}) > 1:
            raise RecordingError(f"the part {part} has different columns in the recordings")
    return {part: np.concatenate(tables) for part, tables in pieces.items()}
