"""State of one flight on a page: its last minute, from its processes' frames.

    (process, Frame) → `State.take` → `State.vehicles`, `State.network`, `State.said`, `State.marks`

Memory is bounded: a ring buffer for each vehicle, one for the network, and the newest events. Times
are those of the frames; the drawing code passes the present time.
"""

import re
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from skytether.figures.colours import AMBER, GREEN, GREY, MODE_COLOURS, RED
from skytether.shared.base import toml
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.directions import FLIGHT, Directions
from skytether.shared.events.flight import DOES, Changed, Event
from skytether.shared.events.processes import Counted, Listening, Plaintext
from skytether.shared.law.model import Array
from skytether.shared.missions import zone_texts
from skytether.shared.missions.zones import Zones
from skytether.shared.scenario import reading
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.feed import (
    FeedError,
    Figures,
    Frame,
    Opened,
    Rows,
    Said,
    columns_of,
    table,
)
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Reason
from skytether.shared.telemetry.record import Rows as Table
from skytether.shared.telemetry.sent import SentBy, compared, sent_by
from skytether.shared.wire.framing import PATHS_MAX
from skytether.shared.wire.protocol import Mode
from skytether.view.page.changes import Mark, mark, together
from skytether.view.page.controls import WAYS
from skytether.view.page.network import BIN_NS, BINS, DIRECTIONS, SPAN_S, Network
from skytether.view.rows import check_columns, check_values, planned

SLOTS_MAX = 1200
"""Largest number of stored steps of a vehicle; if a minute has more steps, only every n-th step is
stored."""
VEHICLES_MAX = 64
ZONED, GUIDED = "mission.zones", "mission.goals"
"""Key of a mission's zones, and key of the goals that replace the mission's goals in flight."""
PLANS_MAX = 8
"""Number of stored plans of a vehicle, including retransmissions."""
SAID_MAX = 50
FOLDED_S = 10.0
"""Time within which events with the same text are shown as one, with the number of events [s]."""
AT_ONCE_S = 2.0
"""Time within which changes of one key, as by a dragged slider, count as one change [s]."""
LIVE_POINT = "reference.points_m"
"""Key that changes many times a second while a target is dragged; its changes are not logged."""
LOSS_S = 10.0
"""Time over which loss is measured [s]."""
LOSS_HIGH = 0.3
"""Loss above which a link is called degraded."""
TRAJECTORY_BYTES = 32
"""Smallest unencrypted packet that counts as a trajectory [B]; heartbeats are smaller."""

NO_SESSION = "there is no session yet"
ONLY_SERVER = "only the server has sent data of this vehicle"
VALUES = ("position", "reference", "figure", "threshold", "age_s", "solve_ms", "mode")
"""Columns of a vehicle's ring buffer; a value is NaN where it is unknown."""
ROUNDING = 1e-6
"""Rounding tolerance of times, relative to the length of a slot of the ring buffer."""


@dataclass(frozen=True, slots=True)
class Word:
    """State of a vehicle or a link, for display."""

    word: str
    text: str
    colour: str


@dataclass(frozen=True, slots=True)
class Curves:
    """Last minute of a vehicle on a time grid; NaN where unknown."""

    time_s: Array
    position: Array
    """True position [m]; shape (n, axes)."""
    reference: Array
    """Desired position known to the server at the time [m]; shape (n, axes)."""
    figure: Array
    """Figure that the trigger compares; shape (n,)."""
    threshold: Array
    """Threshold with which the trigger compares the figure; shape (n,)."""
    age_s: Array
    """Age of the observation from which the input in force was computed [s]; shape (n,)."""
    solve_ms: Array
    """Computing time of both MPC problems [ms]; shape (n,)."""
    mode: Array
    """Mode of the vehicle; shape (n,)."""

    @property
    def error_m(self) -> Array:
        """Distance to the desired position [m]; shape (n,)."""
        error: Array = np.linalg.norm(self.position - self.reference, axis=1)
        return error


@dataclass(frozen=True, slots=True)
class Heard:
    """Event of a flight, or several with the same text."""

    time_s: float
    """Time of flight of the newest of these events [s]."""
    text: str
    count: int = 1


class VehicleTrack:
    """Steps of the last minute, newest rows and plans of one vehicle."""

    def __init__(self, number: int, scenario: Scenario) -> None:
        self.number = number
        self.client = self.server = ""
        """Names of the client and the server that sent the newest rows; empty before any rows."""
        self._scenario = scenario
        steps = max(1, round(SPAN_S / scenario.control.dt))
        self._stride = -(-steps // SLOTS_MAX)
        """Number of steps from one stored step to the next."""
        self._slot_s = self._stride * scenario.control.dt
        self._slots = -(-steps // self._stride)
        axes = scenario.model.axes
        self._ring = np.zeros(
            self._slots,
            [
                ("slot", "i8"),
                ("position", "f8", (axes,)),
                ("reference", "f8", (axes,)),
                ("figure", "f8"),
                ("threshold", "f8"),
                ("age_s", "f8"),
                ("solve_ms", "f8"),
                ("mode", "f8"),
            ],
        )
        self._empty = np.zeros(1, self._ring.dtype)
        for name in VALUES:
            self._empty[name] = np.nan
        self._ring["slot"] = -1
        self.row: np.void | None = None
        """Newest row of the client's part; None before any."""
        self.planned = 0
        self.sent = SentBy(0, 0)
        """Number of plans that the server sent at the steps received so far."""
        self._plans: deque[np.void] = deque(maxlen=PLANS_MAX)
        """Newest plans sent to the vehicle, the newest last."""
        self._seen: np.void | None = None
        """Newest row of the server's part; None before any."""

    # -- incoming frames ---------------------------------------------------------------------

    def fly(self, rows: Table) -> None:
        at = self._at(rows["step"])
        is_kept = at >= 0
        ring, at = self._ring, at[is_kept]
        ring["position"][at] = rows["state"][is_kept, :, 0]
        ring["mode"][at] = rows["mode"][is_kept]
        age_ns = rows["age_ns"][is_kept]
        ring["age_s"][at] = np.where(age_ns >= 0, age_ns / SECOND_NS, np.nan)
        self.row = rows[-1].copy()

    def plan(self, rows: Table) -> None:
        at = self._at(rows["step"])
        is_kept = at >= 0
        ring, at, rows = self._ring, at[is_kept], rows[is_kept]
        ring["reference"][at] = rows["reference"][:, :, 0]
        ring["figure"][at] = compared(rows)
        ring["threshold"][at] = rows["threshold"]
        ring["solve_ms"][at] = np.where(
            rows["solve_ns"] >= 0, rows["solve_ns"] / MILLISECOND_NS, np.nan
        )
        self.planned += len(rows)
        more = sent_by(rows)
        self.sent = SentBy(self.sent.above + more.above, self.sent.due + more.due)
        if len(rows):
            self._seen = rows[-1].copy()

    def lead(self, rows: Table) -> None:
        self._plans.extend(row.copy() for row in rows[-PLANS_MAX:])

    def _at(self, steps: NDArray[np.int64]) -> NDArray[np.int64]:
        """Ring index of each step; the slot of a new step is emptied; -1 for a step not kept."""
        slots = steps // self._stride
        at = slots % self._slots
        newest = np.maximum(self._ring["slot"][at], self._ring["slot"].max() - self._slots)
        new = slots > newest
        self._ring[at[new]] = self._empty
        self._ring["slot"][at[new]] = slots[new]
        return np.where(slots == self._ring["slot"][at], at, -1)

    # -- display ----------------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        return max(0.0, float(self._ring["slot"].max()) * self._slot_s)

    @property
    def mode(self) -> Mode:
        return Mode.INIT if self.row is None else Mode(self.row["mode"])

    @property
    def does(self) -> Word:
        mode = self.mode
        if self.row is None:
            return Word("INIT", "no data yet", GREY)
        does, why = DOES[str(mode)], Reason(self.row["reason"])
        if mode is Mode.COAST and self.row["covered"]:
            does = "flies on along its plan"
        if mode is Mode.TRACK:
            why = Reason.HORIZON
        return Word(mode.name, f"{does}: {why}", MODE_COLOURS[mode])

    @property
    def age_s(self) -> float:
        """Age of the observation from which the newest input was computed [s]; NaN if there is
        none.
        """
        if self.row is None or self.row["age_ns"] < 0:
            return np.nan
        return float(self.row["age_ns"]) / SECOND_NS

    @property
    def known_s(self) -> float:
        """Age of the newest observation at the server's last planning [s]; NaN if there is none."""
        if self._seen is None or self._seen["observed_step"] < 0:
            return np.nan
        behind = int(self._seen["step"] - self._seen["observed_step"])
        return behind * self._scenario.control.dt

    def trail(self, seconds: float = SPAN_S) -> Array:
        """True positions of the last seconds, oldest first [m]; NaN in gaps; shape (n, axes)."""
        position: Array = self._kept(seconds)["position"]
        return position

    def goals(self, seconds: float = SPAN_S) -> Array:
        """Desired positions of the last seconds [m], in the form of `trail`."""
        reference: Array = self._kept(seconds)["reference"]
        return reference

    def goal(self, seconds: float) -> Array | None:
        """Newest desired position of the last seconds [m]; None if there is none."""
        goals = self.goals(seconds)
        goals = goals[~np.isnan(goals[:, 0])]
        return goals[-1] if len(goals) else None

    def ahead(self) -> Array:
        """Positions along the newest plan from the present step on [m]; shape (n, axes).

        Empty if no plan is flown.
        """
        axes = self._scenario.model.axes
        if not self._plans or (self.row is not None and not self.row["covered"]):
            return np.empty((0, axes))
        return self._along(self._plans[-1])

    def motions(self) -> list[Array]:
        """Positions along each plan that the vehicle may fly [m], each as in `ahead`.

        On a mission: the plan in force and those that the vehicle may still accept.
        """
        if not self._scenario.is_mission or self.row is None:
            return [self.ahead()]
        in_force, now = self.row["in_force"], self.row["step"]
        least = now - round(self._scenario.link.join_s / self._scenario.control.dt)
        begins = {int(plan["begins"]): plan for plan in self._plans}
        return [
            self._along(plan)
            for step, plan in begins.items()
            if step == in_force or step > max(in_force, least - 1)
        ]

    def _along(self, plan: np.void) -> Array:
        positions = planned(self._scenario, plan)
        steps_flown = 0 if self.row is None else int(self.row["step"] - plan["begins"])
        return positions[min(max(steps_flown, 0), len(positions)) :]

    def path(self, points: int) -> Array:
        """Positions at evenly spaced times of the last minute [m]; shape (points, axes).

        The last position is the newest known position; unknown positions are NaN.
        """
        is_known = ~np.isnan(self._ring["position"][:, 0])
        last = int(self._ring["slot"].max(where=is_known, initial=-1))
        slots = last - np.arange(points)[::-1] * (self._slots / points)
        position: Array = self._at_slots(np.maximum(slots, -1).astype(np.int64))["position"]
        return position

    def curves(self, points: int, end_s: float | None = None) -> Curves:
        """Last minute on a time grid.

        Args:
            points: number of times.
            end_s: time of flight at which the minute ends [s]; by default that of the newest step.
        """
        end_s = self.time_s if end_s is None else end_s
        grid_s = end_s + np.linspace(-SPAN_S, 0.0, points)
        on_grid = self._at_slots(np.floor(grid_s / self._slot_s + ROUNDING).astype(np.int64))
        return Curves(time_s=grid_s, **{name: on_grid[name] for name in VALUES})

    def error_m(self, seconds: float) -> float:
        """Root mean square distance to the reference in the last seconds [m]; NaN if unknown."""
        slots = self._kept(seconds)
        away = slots["position"] - slots["reference"]
        squares = (away**2).sum(axis=1)
        squares = squares[~np.isnan(squares)]
        return float(np.sqrt(squares.mean())) if len(squares) else np.nan

    def _kept(self, seconds: float) -> NDArray[np.void]:
        """Slots of the last seconds, oldest first, without empty slots at the start."""
        slots = self._ring["slot"]
        recent = slots[(slots >= 0) & (slots > slots.max() - seconds / self._slot_s)]
        return self._at_slots(np.arange(recent.min(), recent.max() + 1) if len(recent) else recent)

    def _at_slots(self, slots: NDArray[np.int64]) -> NDArray[np.void]:
        """Slots of the ring buffer, by number; a slot that is no longer kept is returned empty."""
        rows = self._ring[slots % self._slots]
        rows[(rows["slot"] != slots) | (slots < 0)] = self._empty
        return rows


def group(figures: dict[str, Any], *names: str) -> dict[str, Any]:
    """Group of figures within nested groups; empty if missing."""
    for name in names:
        value = figures.get(name)
        figures = value if isinstance(value, dict) else {}
    return figures


def _groups(value: Any) -> list[dict[str, Any]]:
    """Groups in a list of figures; empty if the value is not a list."""
    return [each for each in value if isinstance(each, dict)] if isinstance(value, list) else []


def figure(figures: dict[str, Any], *names: str) -> float:
    """Figure within nested groups; NaN if missing."""
    value = group(figures, *names[:-1]).get(names[-1])
    return float(value) if isinstance(value, int | float) else np.nan


ENDS = "server", "client"
"""Roles of processes that each flight has; a netem is optional."""


@dataclass(slots=True)
class _Process:
    opened: Opened
    role: str
    """Role: server, netem or client; several processes may have the same role."""
    columns: dict[str, np.dtype[np.void]]
    newest_ns: int = 0
    seen_ns: int = -1
    """Time of the newest frame received before a reconnection [ns]; older frames are repeats."""
    figures: dict[str, Any] = field(default_factory=dict)


class State:
    def __init__(self) -> None:
        self._processes: dict[str, _Process] = {}
        self._lost: set[str] = set()
        self.flights = 0
        self._begin()

    def _begin(self) -> None:
        self.name = ""
        self.scenario = Scenario()
        """Scenario of the first process that sent frames; the client's once it sends frames."""
        self.duration_s = 0.0
        """Length of the flight [s], from the client if it sends frames."""
        self.vehicles: dict[int, VehicleTrack] = {}
        self.omitted = 0
        """Number of rows dropped because there are more than VEHICLES_MAX vehicles."""
        self._zones: str | None = None
        """Zones as changed in flight; None before a change."""
        self.network = Network(0)
        self.said: deque[Heard] = deque(maxlen=SAID_MAX)
        """Newest events, oldest first."""
        self.marks: deque[tuple[float, Mark]] = deque(maxlen=SAID_MAX)
        """Newest changes, oldest first, with their times of flight [s]."""
        self.changed: dict[tuple[str, str], Changed] = {}
        """Newest change, by process and key; several entries if several changes were merged."""
        self.newest_ns = 0
        self.begin_ns: int | None = None
        """Start of the flight's step 0 [ns]; None before any step."""

    # -- incoming frames ---------------------------------------------------------------------

    def take(self, process: str, frame: Frame) -> None:
        """Apply a frame of a process; frames that belong to no flight are dropped.

        Raises:
            ValueError: the frame is invalid: it comes from another version or another program.
        """
        if isinstance(frame, Opened):
            self._open(process, frame)
            return
        process_state = self._processes.get(process)
        if process_state is None or frame.time_ns <= process_state.seen_ns:
            return
        process_state.newest_ns = max(process_state.newest_ns, frame.time_ns)
        self.newest_ns = max(self.newest_ns, frame.time_ns)
        if isinstance(frame, Rows):
            self._rows(process, process_state, frame)
        elif isinstance(frame, Said):
            self._said(process, frame.event, frame.time_ns)
        elif isinstance(frame, Figures):
            process_state.figures = frame.figures
            if process_state.role == "netem":
                queues = [
                    [figure(each.figures, way, "queue") for way in each.opened.directions]
                    for each in self._processes.values()
                    if each.role == "netem"
                ]
                self.network.wait(np.nan_to_num(queues).sum(axis=0), time_ns=frame.time_ns)

    def lose(self, process: str) -> None:
        self._lost.add(process)

    def _open(self, process: str, opened: Opened) -> None:
        self._lost.discard(process)
        process_state = self._processes.get(process)
        if process_state and process_state.opened.time_ns == opened.time_ns:
            # after a reconnection the feed repeats its newest frames
            process_state.seen_ns = process_state.newest_ns
            return
        try:
            scenario = msgspec.convert(toml.loads(opened.scenario), Scenario)
        except ValueError as error:
            raise FeedError(f"got no scenario: {error}") from None
        with suppress(ConfigError):  # a file named in the scenario is on another machine
            scenario = reading.check(reading.to_table(scenario))
        role = re.split("[ .]", opened.process)[0]
        if process_state and role == "client" and not self._others_fly(process):
            self._begin()  # a new flight
        if role == "client" or not self.name:
            self.duration_s = scenario.duration
        if not self.name:
            self.flights += 1
            self.name = opened.name
            self.scenario = scenario
            control, axes = self.scenario.control, self.scenario.model.axes
            follows = control.properties.splines
            self.network = Network(TRAJECTORY_BYTES if follows else 4 * axes * control.horizon)
        columns: dict[str, np.dtype[np.void]] = {}
        for part, described in opened.parts.items():
            with suppress(ValueError):
                found = columns_of(described)
                check_columns(part, found, self.scenario)
                columns[part] = found
        self._processes[process] = _Process(opened, role, columns)

    def _others_fly(self, client: str) -> bool:
        """Whether another client sends frames, so that the flight goes on without this one."""
        return any(
            each.role == "client" and name != client and name not in self._lost
            for name, each in self._processes.items()
        )

    def _rows(self, name: str, process: _Process, frame: Rows) -> None:
        columns = process.columns.get(frame.part)
        if columns is None:
            return
        rows = table(frame.rows, columns)
        check_values(frame.part, rows, self.scenario)
        if not len(rows):
            return
        if frame.part == "netem":
            self.network.take(rows, time_ns=frame.time_ns)
            return
        if self.begin_ns is None:
            self.begin_ns = frame.time_ns - int(rows["step"][-1]) * self.scenario.dt_ns
        for number in np.unique(rows["vehicle"]).tolist():
            track = self._track(number)
            if track is None:
                self.omitted += 1
                continue
            own = rows[rows["vehicle"] == number]
            match frame.part:
                case "client":
                    track.client = name
                    track.fly(own)
                case "server":
                    track.server = name
                    track.plan(own)
                case "plan":
                    track.lead(own)

    def _track(self, number: int) -> VehicleTrack | None:
        track = self.vehicles.get(number)
        if track is None and len(self.vehicles) < VEHICLES_MAX:
            track = self.vehicles[number] = VehicleTrack(number, self.scenario)
        return track

    def _said(self, process: str, event: Event, time_ns: int) -> None:
        time_s = self.time_s(time_ns)
        if isinstance(event, Counted | Listening | Plaintext):
            return
        if isinstance(event, Changed):
            if event.key != LIVE_POINT:
                self._change(process, event, time_s)
            return
        text, count = str(event).splitlines()[0], 1
        for heard in list(self.said):
            if heard.text == text and time_s - heard.time_s < FOLDED_S:
                self.said.remove(heard)
                count += heard.count
        self.said.append(Heard(time_s, text, count))

    def _change(self, process: str, event: Changed, time_s: float) -> None:
        """Record a change, or merge it with the newest: same key, or uplink with downlink."""
        if event.key == ZONED:
            self._zones = msgspec.json.decode(event.after)
        marked, before = mark(event), self.changed.get((process, event.key))
        netems = sum(each.role == "netem" for each in self._processes.values())
        if (
            self.changed
            and self.said[-1].text == together(self.changed, netems)
            and time_s - self.said[-1].time_s < AT_ONCE_S
            and all(key == event.key or {key, event.key} <= {*WAYS} for _, key in self.changed)
            and marked is self.marks[-1][1]
            # A change that undoes the newest one is not merged with it.
            and (before is None or before.before != event.after)
        ):
            self.said.pop()
            if before:
                event = Changed(key=event.key, before=before.before, after=event.after)
            self.changed = {**self.changed, (process, event.key): event}
        else:
            self.changed = {(process, event.key): event}
            self.marks.append((time_s, marked))
        self.said.append(Heard(time_s, together(self.changed, netems)))

    # -- display ----------------------------------------------------------------------------

    @property
    def flies(self) -> bool:
        """Whether a vehicle or server has sent frames; netem alone may carry any protocol."""
        return any(each.role != "netem" for each in self._processes.values())

    @property
    def ways(self) -> Directions:
        """Names of both directions of the network in netem's figures."""
        directions = (each.opened.directions for each in self._processes.values())
        return next((ways for ways in directions if ways != FLIGHT), FLIGHT)

    @property
    def directions(self) -> dict[int, str]:
        """Names of both directions as the page shows them, by `UPLINK` and `DOWNLINK`."""
        if self.ways == FLIGHT:
            return DIRECTIONS
        return {way: name.replace("_", " ") for way, name in enumerate(self.ways)}

    def time_s(self, time_ns: int) -> float:
        """Time of flight [s], 0 before step 0; for netem alone, the time since netem's start."""
        begin_ns = self.begin_ns
        if begin_ns is None and not self.flies:
            begin_ns = min((each.opened.time_ns for each in self._processes.values()), default=None)
        return 0.0 if begin_ns is None else (time_ns - begin_ns) / SECOND_NS

    @property
    def title(self) -> str:
        return self.scenario.title or self.name

    @property
    def zones(self) -> str:
        """Zones of a mission, in the form of the key `mission.zones`."""
        return self.scenario.mission.zones if self._zones is None else self._zones

    @property
    def has_zones(self) -> bool:
        """Whether the flight has a fence, or is a mission, which may have zones."""
        return self.scenario.fence.is_there or self.scenario.is_mission

    @property
    def kept(self) -> Zones:
        """Zones of a mission; empty if the file of the zones is on another machine."""
        try:
            return zone_texts.parse(
                self.zones, self.scenario.model.axes, reading.files_of("mission.zones", self.zones)
            )
        except (ConfigError, GrammarError):
            return Zones()

    def waits(self, number: int) -> str:
        """Reason that the server gives why a vehicle of a mission waits; empty without a wait."""
        reason = self.of_vehicle("server", number).get("waits", "")
        return reason if isinstance(reason, str) else ""

    def clock(self, number: int) -> tuple[float, float]:
        """Clock uncertainty of a mission vehicle [ms], and resulting position uncertainty [m].

        NaN if the server reports neither.
        """
        figures = self.of_vehicle("server", number)
        return figure(figures, "clock_bound_ms"), figure(figures, "clock_m")

    def paths(self, number: int) -> list[tuple[dict[str, Any], dict[str, Any]]]:
        """Figures that server and vehicle have of each path of the vehicle's session; empty for a
        single path.
        """
        nothing: dict[str, Any] = {}
        up, down = (self.of_vehicle(role, number).get("paths") for role in ("server", "client"))
        pairs = zip_longest(_groups(up), _groups(down), fillvalue=nothing)
        return list(pairs)[:PATHS_MAX]

    def nearest_m(self, number: int, points: int = 1) -> Array:
        """Distance from a vehicle to the nearest other vehicle in the last minute [m].

        Args:
            points: number of times, of which the last is the present.

        Returns:
            distances, NaN where unknown; shape (points,).
        """
        nearest = np.full(points, np.nan)
        own = self.vehicles[number].path(points) if number in self.vehicles else None
        for other, track in self.vehicles.items():
            if own is not None and other != number:
                np.fmin(nearest, np.linalg.norm(track.path(points) - own, axis=1), out=nearest)
        return nearest

    @property
    def lost(self) -> tuple[str, ...]:
        return tuple(sorted(self._lost))

    @property
    def missing(self) -> tuple[str, ...]:
        """Roles that no process has, and clients of vehicles that only a server reports."""
        if not self.flies:
            return ()
        roles = {each.role for each in self._processes.values()}
        absent = [f"a {role}" for role in ENDS if role not in roles]
        if "client" in roles:
            silent = [number for number, each in self.vehicles.items() if not each.client]
            absent += [f"vehicle {number}'s client" for number in sorted(silent)]
        return tuple(absent)

    def role(self, process: str) -> str:
        """Role of a process: server, netem or client; empty before its first frame."""
        heard = self._processes.get(process)
        return heard.role if heard else ""

    def figures(self, role: str) -> dict[str, Any]:
        """Figures of the first process of a role that has sent figures; empty if none has."""
        all_figures = (each.figures for each in self._processes.values() if each.role == role)
        return next(filter(None, all_figures), {})

    def of_vehicle(self, role: str, number: int) -> dict[str, Any]:
        """Figures of a vehicle from its client or from the server that plans for it, otherwise from
        any process of the role that has them.
        """
        track = self.vehicles.get(number)
        own = {"client": track.client, "server": track.server}.get(role) if track else None
        by_process = {
            name: group(each.figures, "by_vehicle", str(number))
            for name, each in self._processes.items()
            if each.role == role
        }
        return by_process.get(own or "") or next(filter(None, by_process.values()), {})

    @property
    def every_step(self) -> float:
        """Packet rate of one direction if each vehicle had a packet at every step [1/s]."""
        return max(1, len(self.vehicles)) / self.scenario.control.dt

    @property
    def _silence_ns(self) -> dict[int, int]:
        """Time without a packet after which a direction counts as cut [ns], by direction."""
        link = self.scenario.link
        return {UPLINK: seconds_to_ns(link.timeout_s), DOWNLINK: link.patience_ns}

    def links(self, curves: Curves, now_ns: int) -> NDArray[np.str_]:
        """Colour of a vehicle's link at each time of its curves, see `link`; empty if unknown."""
        shape = curves.time_s.shape
        cut, degraded = np.zeros(shape, bool), curves.age_s > self.scenario.link.age_max_s / 2
        is_flown = ~np.isnan(curves.mode) & (curves.mode != Mode.INIT)
        ago_ns = (self.time_s(now_ns) - curves.time_s) * SECOND_NS
        at = BINS - 1 - np.clip(np.nan_to_num(ago_ns) // BIN_NS, 0, BINS - 1).astype(int)
        numbers = np.arange(BINS)
        for direction, longest_ns in self._silence_ns.items():
            packets, lost = self.network.bins(direction, now_ns)
            heard = np.maximum.accumulate(np.where(packets > lost, numbers, -1))
            cut |= ((heard >= 0) & ((numbers - heard) * BIN_NS > longest_ns))[at]
            recent = np.ones(round(LOSS_S * SECOND_NS / BIN_NS))
            sums = [np.convolve(counts, recent)[:BINS] for counts in (packets, lost)]
            degraded |= (sums[1] > LOSS_HIGH * sums[0])[at]
        return np.select([~is_flown, cut, degraded], ["", RED, AMBER], GREEN)

    def link(self, number: int, now_ns: int) -> Word:
        """State of a vehicle's link for display: word, explanation and colour."""
        track = self.vehicles.get(number)
        if track is None or track.row is None or track.mode is Mode.INIT:
            is_seen = track is not None and track.server and not track.client
            return Word("UNKNOWN", ONLY_SERVER, GREY) if is_seen else Word("NONE", NO_SESSION, GREY)
        for direction, name in DIRECTIONS.items():
            heard_ns = self.network.heard_ns.get(direction)
            if heard_ns is not None and now_ns - heard_ns > self._silence_ns[direction]:
                ago_s = (now_ns - heard_ns) / SECOND_NS
                return Word("CUT", f"no packet has got through {name} for {ago_s:.0f} s", RED)
        if track.row["reason"] == Reason.LOST:
            return Word("CUT", str(Reason.LOST), RED)
        for direction, name in DIRECTIONS.items():
            traffic = self.network.traffic(direction, LOSS_S, now_ns)
            if traffic.loss > LOSS_HIGH:
                return Word("DEGRADED", f"{traffic.loss:.0%} of the packets {name} are lost", AMBER)
        if track.age_s > self.scenario.link.age_max_s / 2:
            return Word("DEGRADED", f"the observation in use is {track.age_s:.1f} s old", AMBER)
        return Word("GOOD", "packets come through both ways", GREEN)
