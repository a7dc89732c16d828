"""Outcome of a recorded flight: which vehicles arrived, smallest separations, and what failed."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import (
    BegunAnew,
    Changed,
    ChangeRefused,
    ClockContradicted,
    Degraded,
    Event,
    Fault,
    FenceHolds,
    ModeChanged,
    NotFlown,
    RecordIncomplete,
    StateLeapt,
    SteppedLate,
)
from skytether.shared.events.ground import ServerHeard, ServerSilent
from skytether.shared.events.paths import PathDied, PathHealed
from skytether.shared.events.processes import (
    HostFound,
    HostMissing,
    NotRecalled,
    PathMissing,
    Recalled,
    TimeUnknown,
)
from skytether.shared.events.standby import LeaderChanged
from skytether.shared.law.model import Array
from skytether.shared.missions.events import LeftMotion, LeftTube
from skytether.shared.telemetry.record import Rows
from skytether.shared.telemetry.summary import (
    STOPPED,
    WORSE,
    Track,
    nearest,
    position_error,
    track,
)
from skytether.shared.wire.protocol import Mode
from skytether.view.recordings.recorded import Recorded

SHOWN = (
    *(HostMissing, HostFound, PathMissing, PathDied, PathHealed, LeaderChanged, ModeChanged),
    *(ServerSilent, ServerHeard, LeftTube, LeftMotion, SteppedLate, StateLeapt, FenceHolds),
    *(ClockContradicted, TimeUnknown, BegunAnew, Recalled, NotRecalled, NotFlown),
    *(Fault, Degraded, RecordIncomplete, Changed, ChangeRefused),
)
"""Types of events that the report shows as failures and takeovers."""
GROUND = {str(mode) for mode in (Mode.INIT, Mode.SYNC, Mode.READY)}
WITHIN_S = 2.0
"""Time within which the same event of several vehicles is shown once [s]."""
AT_ONCE_S = 0.1
"""Time within which brake events count as one [s]: `explain --at` cannot distinguish them."""
BRIEF_S = 1.0
"""Length of a path's outage below which it is not shown [s]."""
VEHICLES_MAX = 64
"""Largest number of vehicles that get a row in the table, and whose distances are computed."""


@dataclass(frozen=True, slots=True)
class Ended:
    """Vehicle at the end of its flight, and worst figures of the flight; None if unknown."""

    vehicle: int
    mode: Mode
    off_m: float | None
    """Distance from the desired position at the end [m]."""
    error_max_m: float | None
    braked_s: float
    nearest_m: float | None
    """Smallest distance to another vehicle during the mission [m]."""
    nearest: int | None
    """Number of the other vehicle at the distance `nearest_m`."""


class Outcome:
    """Outcome of a flight, from its recording.

    Args:
        recorded: recording with at least one flown step.
        epoch_ns: time of the first vehicle's step 0, counted from the first frame [ns].
    """

    def __init__(self, recorded: Recorded, epoch_ns: int) -> None:
        self._recorded, self._epoch_ns = recorded, epoch_ns
        self.scenario = recorded.scenario
        client = recorded.parts["client"]
        self.numbers: list[int] = np.unique(client["vehicle"]).tolist()
        self.rows: dict[int, Rows] = {}
        self.began_s: dict[int, float] = {}
        """Time of each vehicle's step 0 since step 0 of the first vehicle [s]."""
        for number in self.numbers[:VEHICLES_MAX]:
            at = np.flatnonzero(client["vehicle"] == number)
            self.rows[number] = client[at]
            first_s = (int(recorded.times_ns["client"][at[0]]) - epoch_ns) / SECOND_NS
            self.began_s[number] = first_s - float(client["step"][at[0]]) * self._dt_s

    @property
    def _dt_s(self) -> float:
        return self.scenario.control.dt

    def time_s(self, time_ns: int) -> float:
        return (time_ns - self._epoch_ns) / SECOND_NS

    def modes(self, number: int) -> Iterator[tuple[Mode, float, float]]:
        """Modes of a vehicle in order, each with its beginning and end [s]."""
        rows, began_s = self.rows[number], self.began_s[number]
        for mode, span in spans(rows):
            first, last = rows["step"][span][[0, -1]]
            yield mode, began_s + float(first) * self._dt_s, began_s + float(last) * self._dt_s

    def apart(self) -> tuple[Array, Array]:
        """Times [s], and the distance between the nearest two vehicles of the mission [m]."""
        return nearest(list(self._tracks.values()), self._dt_s)

    @cached_property
    def _tracks(self) -> dict[int, Track]:
        if not self.scenario.is_mission:
            return {}
        scale = self.scenario.mission.height_scale
        return {
            number: track(rows, self.began_s[number], self._dt_s, scale)
            for number, rows in self.rows.items()
            if (rows["mode"] == Mode.TRACK).any()
        }

    @cached_property
    def least(self) -> dict[tuple[int, int], tuple[float, float]]:
        """Smallest distance between each two vehicles of a mission [m], and its time [s]."""
        found = {}
        for pair in combinations(self._tracks, 2):
            times_s, apart_m = nearest([self._tracks[each] for each in pair], self._dt_s)
            if np.isfinite(apart_m).any():
                at = int(np.nanargmin(apart_m))
                found[pair] = float(apart_m[at]), float(times_s[at])
        return found

    @cached_property
    def ended(self) -> list[Ended]:
        server = self._recorded.parts.get("server")
        found = []
        for number, rows in self.rows.items():
            off_m = np.linalg.norm(position_error(self.scenario, rows, server), axis=1)
            has_truth = np.isfinite(off_m).any()
            near = [
                (apart_m, sum(pair) - number)
                for pair, (apart_m, _) in self.least.items()
                if number in pair
            ]
            nearest_m, other = min(near, default=(None, None))
            found.append(
                Ended(
                    number,
                    Mode(rows["mode"][-1]),
                    float(off_m[-1]) if np.isfinite(off_m[-1]) else None,
                    float(np.nanmax(off_m)) if has_truth and not self.scenario.is_mission else None,
                    float((rows["mode"] == Mode.BRAKE).sum() * self._dt_s),
                    nearest_m,
                    other,
                )
            )
        return found

    def arrived(self, each: Ended) -> bool:
        """Whether a vehicle of a mission ended at its last goal."""
        return each.off_m is not None and each.off_m <= self.scenario.mission.tube_m

    @property
    def verdict(self) -> str:
        """Sentences about a mission: which vehicles arrived, and the smallest separation."""
        late = [each.vehicle for each in self.ended if not self.arrived(each)]
        count = len(self.ended)
        first = "" if count == len(self.numbers) else f"Of the first {count} vehicles, "
        said = f"{first}{count - len(late)} of {count} recorded vehicles arrived"
        if late:
            said += f", not {listed(late)}"
        if not self.least:
            return f"{said}."
        (one, other), (apart_m, at_s) = min(self.least.items(), key=lambda each: each[1])
        required_m = self.scenario.mission.separation_m
        short = "less than" if apart_m < required_m else "of"
        return (
            f"{said}. The least separation was {apart_m:.3f} m, {short} {required_m:g} m required "
            f"(vehicles {one} and {other}, at {at_s:.1f} s)."
        )

    @cached_property
    def happened(self) -> list[tuple[float, tuple[int, ...], str]]:
        """Failures and takeovers: time [s], vehicles and sentence, in order of time.

        The same event of several vehicles is listed once. Outages of a path that are shorter than
        BRIEF_S are left out.
        """
        found: list[tuple[float, list[int], str]] = []
        newest: dict[str, list[int]] = {}
        begin_s: dict[str, float] = {}
        for time_ns, _, event in self._recorded.events():
            at_s, vehicle = self.time_s(time_ns), getattr(event, "vehicle", None)
            if not isinstance(event, SHOWN) or _is_ordinary(event) or self._is_brief(event, at_s):
                continue
            text = re.sub(r"^vehicle \d+:? ", "", str(event))
            if vehicle and text in newest and at_s - begin_s[text] < WITHIN_S:
                newest[text].append(vehicle)
                continue
            newest[text], begin_s[text] = [vehicle] if vehicle else [], at_s
            found.append((at_s, newest[text], text))
        return [(at_s, tuple(sorted(set(who))), text) for at_s, who, text in found]

    def _is_brief(self, event: Event, at_s: float) -> bool:
        """Whether an event begins or ends a path's outage that is too brief to be shown."""
        if not isinstance(event, PathDied | PathHealed):
            return False
        outages = self.dead_paths.get(event.path, [])
        return not any(
            event.vehicle == vehicle and at_s in (begin_s, end_s)
            for vehicle, begin_s, end_s in outages
        )

    @cached_property
    def dead_paths(self) -> dict[int, list[tuple[int, float, float]]]:
        """Outages of each path: vehicle, begin and end [s]; by path number."""
        begun_s: dict[tuple[int, int], float] = {}
        outages: list[tuple[int, int, float, float]] = []
        for time_ns, _, event in self._recorded.events():
            at_s = self.time_s(time_ns)
            if isinstance(event, PathDied):
                begun_s.setdefault((event.path, event.vehicle), at_s)
            elif isinstance(event, PathHealed) and (event.path, event.vehicle) in begun_s:
                which = event.path, event.vehicle
                outages.append((*which, begun_s.pop(which), at_s))
        end_s = max(
            began + float(self.rows[number]["step"][-1]) * self._dt_s
            for number, began in self.began_s.items()
        )
        outages += [(*which, begin_s, end_s) for which, begin_s in begun_s.items()]
        found: dict[int, list[tuple[int, float, float]]] = {}
        for path, vehicle, begin_s, over_s in sorted(outages):
            if over_s - begin_s >= BRIEF_S:
                found.setdefault(path, []).append((vehicle, begin_s, over_s))
        return found

    def new_leaders(self) -> list[tuple[int, float]]:
        """Vehicles, and times [s] at which another server took them over."""
        return [
            (event.vehicle, self.time_s(time_ns))
            for time_ns, _, event in self._recorded.events()
            if isinstance(event, LeaderChanged)
        ]


def brakes(recorded: Recorded) -> list[tuple[float, str]]:
    """Times of flight [s] at which a vehicle brakes, lands or has a fault, and the event as a
    sentence. Of several vehicles that brake at once, only the first is listed.
    """
    worse, stopped = ([str(mode) for mode in modes] for modes in (WORSE, STOPPED))
    found: list[tuple[float, str]] = []
    braking = set[int]()
    for time_ns, _, event in recorded.events():
        if not isinstance(event, ModeChanged):
            continue
        if event.after not in stopped:
            braking.discard(event.vehicle)
        elif event.after in worse and event.vehicle not in braking:
            braking.add(event.vehicle)
            at_s = time_ns / SECOND_NS
            if not found or at_s - found[-1][0] > AT_ONCE_S:
                found.append((at_s, str(event)))
    return found


def spans(rows: Rows) -> Iterator[tuple[Mode, slice]]:
    """Modes in order, each with the slice of its rows and the first row after them."""
    begins = np.flatnonzero(np.diff(rows["mode"], prepend=-1))
    for begin, end in zip(begins, [*begins[1:], len(rows)], strict=True):
        yield Mode(rows["mode"][begin]), slice(begin, end + 1)


def _is_ordinary(event: Event) -> bool:
    """Whether an event belongs to the normal start of a flight."""
    return isinstance(event, ModeChanged) and event.before in GROUND


def listed(numbers: list[int] | tuple[int, ...]) -> str:
    """Text of numbers, with ranges of three or more: "1, 3 to 6, 9"."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    words = [f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs]
    return ", ".join(words)
