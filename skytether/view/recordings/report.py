"""Report of a recorded flight: a page that opens offline, with figures, summary and events."""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skytether.figures.colours import MODE_COLOURS, PALETTE, css
from skytether.figures.flights import draw_packets, draw_reference
from skytether.figures.page import (
    Facts,
    Folded,
    Part,
    Picture,
    Table,
    as_png,
    as_text,
    lettered,
    rendered,
)
from skytether.shared.base.errors import RecordingError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import DOES
from skytether.shared.law.model import Array
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Rows
from skytether.shared.telemetry.sent import compared
from skytether.shared.telemetry.summary import Summary, desired, position_error
from skytether.shared.wire.protocol import NO_HORIZON, Mode
from skytether.view.recordings.outcome import Outcome, brakes, listed, spans
from skytether.view.recordings.recorded import Recorded

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EVENTS_MAX = 400
HAPPENED_MAX = 20
WIDTH = 9.0
LETTERS = 9


@dataclass(frozen=True, slots=True)
class ReportedFlight:
    """Data for the figures: one vehicle's flight, and the network."""

    scenario: Scenario
    client: Rows
    server: Rows
    netem: Rows
    epoch_ns: int
    """Time of step 0 [ns; netem's clock]."""

    @property
    def time_s(self) -> Array:
        return self.time_of(self.client)

    def time_of(self, rows: Rows) -> Array:
        time_s: Array = rows["step"] * self.scenario.control.dt
        return time_s

    def spans(self) -> Iterator[tuple[Mode, slice]]:
        return spans(self.client)


def page(recorded: Recorded, figures: Sequence[tuple[str, str]], explanation: str = "") -> str:
    """Page of a recording, as HTML.

    Args:
        figures: names and values of the summary.
        explanation: text of `skytether explain`; empty for none.

    Raises:
        RecordingError: no vehicle has flown a step.
    """
    parts, scenario, about = recorded.parts, recorded.scenario, recorded.about
    client = parts.get("client")
    if client is None or not len(client) or recorded.summary is None:
        raise RecordingError(f"{recorded.path}: no vehicle has flown a step in it")
    number = client["vehicle"].min()
    epoch_ns = int(recorded.times_ns["client"][0]) - int(client["step"][0]) * scenario.dt_ns
    events = [
        (f"{round((time_ns - epoch_ns) / SECOND_NS, 2) + 0.0:.2f}", process, str(event))
        for time_ns, process, event in recorded.events()
    ]
    empty = client[:0]
    flown = ReportedFlight(
        scenario,
        client[client["vehicle"] == number],
        parts["server"][parts["server"]["vehicle"] == number] if "server" in parts else empty,
        parts.get("netem", empty),
        recorded.begin_ns + epoch_ns,
    )
    outcome = Outcome(recorded, epoch_ns)
    began = f"{about.began[:10]} {about.began[11:16]} UTC"
    where = f"over UDP, {began}" if about.began else "in virtual time"
    fleet = len(outcome.numbers)
    summary = recorded.summary
    whose = f", of vehicle {number} of {fleet}" if fleet > 1 else ""
    table = Table(
        "summary",
        "Summary",
        f"Figures of the whole flight{whose}.",
        "",
        ("figure", "value"),
        [list(row) for row in figures],
    )
    facts = {
        "scenario": about.scenario,
        "seed": str(scenario.seed),
        "flown": where,
        "with": f"Skytether {about.version}",
        "recording": recorded.path.name,
    }
    heard = "Time is that of the flight, whose first step is 0."
    if (further := len(events) - EVENTS_MAX) > 0:
        heard += f" {further} more events are in the recording."
    heading = ("time [s]", "process", "event")
    happened = Table("events", "", heard, "", heading, events[:EVENTS_MAX], is_grouped=False)
    return rendered(
        f"Flight of {about.scenario}, seed {scenario.seed}",
        f"{fleet} vehicle{'s' * (fleet != 1)}, {summary.duration_s:g} s {where}. "
        + (outcome.verdict if scenario.is_mission else _verdict(summary)),
        [
            *_why(recorded, outcome, explanation),
            *_theorem(recorded),
            *_first(outcome),
            course(outcome) if fleet > 1 else timeline(flown),
            Folded(
                f"Figures{whose}",
                [table, path(flown), *([timeline(flown)] if fleet > 1 else [])],
            ),
            Folded("All events", [happened]),
            Folded("The whole scenario", text=to_toml(scenario).decode()),
            Facts("How it was made", facts),
        ],
    )


def _verdict(summary: Summary) -> str:
    sent = "–" if summary.event_ratio is None else f"{summary.event_ratio:.1%}"
    rmse = summary.rmse_xy
    off = "" if rmse is None else f"The vehicle was {rmse:.3f} m off (RMSE xy); "
    return f"{off}a horizon was sent at {sent} of the steps."


def _first(outcome: Outcome) -> list[Table]:
    """First tables of the page: the vehicles, and the failures and takeovers."""
    found = []
    if len(outcome.ended) > 1:
        is_mission = outcome.scenario.is_mission
        heading = ["vehicle", "at the end", "off [m]", *["largest error [m]"] * (not is_mission)]
        heading += ["braked [s]", *["nearest other [m]"] * is_mission]
        rows = []
        for each in outcome.ended:
            row = [
                str(each.vehicle),
                DOES.get(str(each.mode), str(each.mode)),
                as_text(each.off_m, ".3f"),
            ]
            row += [] if is_mission else [as_text(each.error_max_m, ".3f")]
            row += [f"{each.braked_s:.1f}" if each.braked_s else "–"]
            if is_mission:
                near = f"{as_text(each.nearest_m, '.3f')} ({each.nearest})" if each.nearest else "–"
                row += [near]
            rows.append(row)
        says = "Off: distance from the desired position at the last step."
        if len(outcome.numbers) > len(rows):
            says += f" The first {len(rows)} of {len(outcome.numbers)}."
        found.append(Table("vehicles", "Vehicles", says, "", heading, rows))
    events = [
        [f"{at_s:.1f}", listed(who) if who else "–", text] for at_s, who, text in outcome.happened
    ]
    says = "" if events else "Nothing failed."
    if len(events) > HAPPENED_MAX:
        says = f"The first {HAPPENED_MAX} of {len(events)}; all events are below."
    heading = ["time [s]", "vehicles", "event"] if events else []
    table = Table(
        "happened", "What failed, and what took over", says, "", heading, events[:HAPPENED_MAX]
    )
    return [table, *found] if events else [*found, table]


def _why(recorded: Recorded, outcome: Outcome, explanation: str) -> list[Part]:
    """Explanation, and a command that explains each brake event; empty if the flight cannot be
    flown again.
    """
    parts: list[Part] = []
    if explanation:
        parts.append(Folded("Why", text=explanation, is_open=True))
    explain = f"skytether explain {shlex.quote(recorded.path.name)} --at"
    rows = [
        [f"{at_s + outcome.time_s(0):.1f}", text, f"{explain} {at_s:.2f}"]
        for at_s, text in brakes(recorded)
    ]
    if rows and recorded.can_be_explained:
        says = (
            "Each command flies the flight again, until the smallest set of losses is found. Times "
            f"of an explanation begin {-outcome.time_s(0):.1f} s before the first step."
        )
        if len(rows) > HAPPENED_MAX:
            says += f" The first {HAPPENED_MAX} of {len(rows)}."
        heading = ("time [s]", "event", "why it did")
        title = "Why it braked"
        parts.append(Table("why", title, says, "", heading, rows[:HAPPENED_MAX], is_grouped=False))
    return parts


def _theorem(recorded: Recorded) -> list[Part]:
    """The theorem's assumptions; empty unless server and plans of a mission are recorded."""
    if not recorded.scenario.keeps_apart or not {"server", "plan"} <= recorded.parts.keys():
        return []
    from skytether.theorem.judgement import HEADING, TITLE, judged

    rows = judged(recorded.record, recorded.scenario).rows
    says = "Least margin of each condition, and of what is promised; see docs/together-proof.md."
    return [Table("theorem", TITLE, says, "", HEADING, rows, is_grouped=False)]


def course(outcome: Outcome) -> Picture:
    """Draw over time each vehicle's mode, new leaders, path outages, and the separation."""
    numbers, paths, is_apart = list(outcome.rows), outcome.dead_paths, bool(outcome.least)
    lanes = len(numbers) + len(paths)
    heights = [0.3 + 0.18 * lanes, *[1.8] * is_apart]
    with lettered(WIDTH, 0.8 + sum(heights), LETTERS) as figure:
        above, *rest = figure.subplots(
            len(heights), 1, sharex=True, height_ratios=heights, squeeze=False
        )[:, 0]
        modes = set()
        for lane, number in enumerate(numbers):
            for mode, begin_s, end_s in outcome.modes(number):
                modes.add(mode)
                at = (lane - 0.4, 0.8)
                above.broken_barh([(begin_s, end_s - begin_s)], at, color=_colour(mode))
        for lane, dead in enumerate(paths.values(), start=len(numbers)):
            spans_s = [(begin_s, end_s - begin_s) for _, begin_s, end_s in dead]
            above.broken_barh(spans_s, (lane - 0.4, 0.8), color="k", alpha=0.5)
        leads = [each for each in outcome.new_leaders() if each[0] in numbers]
        above.plot([at_s for _, at_s in leads], [numbers.index(each) for each, _ in leads], "kv")
        names = [f"vehicle {number}" for number in numbers] + [f"path {path}" for path in paths]
        above.set_yticks(range(lanes), names)
        above.invert_yaxis()
        above.grid(visible=False, axis="y")
        for below in rest:
            below.plot(*outcome.apart(), "k-", linewidth=1.0)
            below.axhline(outcome.scenario.mission.separation_m, color="r", linestyle="--")
            below.set_ylim(bottom=0.0)
            below.set_ylabel("nearest two [m]")
        [above, *rest][-1].set_xlabel("time [s]")
        _name_modes(figure, modes)
        says = "Modes of the vehicles."
        says += " Triangles: another server leads." * bool(leads)
        says += " Black: nothing came over the path." * bool(paths)
        says += " Below: distance between the nearest two, and the required distance." * is_apart
        return Picture("course", "What happened", says, as_png(figure, 140))


def _colour(mode: Mode) -> str:
    return css(PALETTE[MODE_COLOURS[mode]])


def path(flown: ReportedFlight) -> Picture:
    with lettered(WIDTH, 6.0, LETTERS) as figure:
        plane = figure.subplots()
        draw_reference(plane, flown.scenario, flown.client, flown.server)
        position = flown.client["state"][:, :2, 0]
        for mode, span in flown.spans():
            x, y = with_gaps(flown.client["step"][span], position[span]).T
            plane.plot(x, y, color=_colour(mode), linewidth=1.4)
        plane.plot(*position[0], "ko", markersize=4, label="start")
        plane.set_aspect("equal", adjustable="datalim")
        plane.set_xlabel("x [m]")
        plane.set_ylabel("y [m]")
        plane.legend(loc="upper right")
        _name_modes(figure, {mode for mode, _ in flown.spans()})
        says = "Dashed red: desired positions. Coloured: the vehicle's positions, by mode."
        return Picture("path", "Path from above", says, as_png(figure, 140))


def timeline(flown: ReportedFlight) -> Picture:
    with lettered(WIDTH, 10.5, LETTERS) as figure:
        axes = figure.subplots(5, 1, sharex=True)
        for draw, below in zip((_positions, _error, _trigger, _ages, _packets), axes, strict=True):
            draw(below, flown)
            for mode, span in flown.spans():
                time_s = flown.time_s[span]
                end_s = time_s[-1] + (
                    flown.scenario.control.dt if span.stop > len(flown.client) else 0
                )
                below.axvspan(time_s[0], end_s, color=_colour(mode), alpha=0.13, linewidth=0)
            if below.get_legend_handles_labels()[0]:
                below.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(0.0, flown.time_s[-1] + flown.scenario.control.dt)
        figure.align_ylabels(axes)
        _name_modes(figure, {mode for mode, _ in flown.spans()})
        says = (
            "From top to bottom: position, with the desired one dashed; distance between them; the "
            "figure that the trigger compares with its threshold, linear up to it and logarithmic "
            "above, and when a horizon was sent; age of the observation behind the input, and of "
            "the plan; packets in each second, by their time of entry into the network, without "
            "those still under way at the end. The background shows the vehicle's mode."
        )
        return Picture("timeline", "What happened", says, as_png(figure, 140))


def with_gaps(steps: NDArray[np.int64], values: Array) -> Array:
    """Values of rows, with NaN inserted for missing steps, so that lines have gaps there."""
    gaps = np.flatnonzero(np.diff(steps) > 1) + 1
    return np.insert(values.astype(np.float64), gaps, np.nan, axis=0)


def _over_time(
    below: "Axes", flown: ReportedFlight, rows: Rows, values: Array, *form: str, **style: Any
) -> None:
    time_s = with_gaps(rows["step"], flown.time_of(rows))
    below.plot(time_s, with_gaps(rows["step"], values), *form, **style)


def _positions(below: "Axes", flown: ReportedFlight) -> None:
    position = flown.client["state"][..., 0]
    wanted = desired(flown.scenario, flown.client, flown.server)
    for axis, (color, name) in enumerate(zip(("k", "0.45", "#0072b2"), "xyz", strict=True)):
        if axis < position.shape[1]:
            _over_time(below, flown, flown.client, position[:, axis], color=color, label=name)
            _over_time(below, flown, flown.client, wanted[:, axis], "r--", linewidth=0.8)
    below.set_ylabel("position [m]")


def _error(below: "Axes", flown: ReportedFlight) -> None:
    error = np.linalg.norm(position_error(flown.scenario, flown.client, flown.server), axis=1)
    _over_time(below, flown, flown.client, error, "k-", linewidth=1.0)
    below.set_ylim(bottom=0.0)
    below.set_ylabel("distance [m]")


def _trigger(below: "Axes", flown: ReportedFlight) -> None:
    server = flown.server
    below.set_ylabel(flown.scenario.control.trigger.replace("_", " "))
    if not len(server):
        return
    time_s = flown.time_of(server)
    _over_time(below, flown, server, compared(server), "k-", linewidth=0.9, label="figure")
    _over_time(below, flown, server, server["threshold"], "r--", linewidth=0.9, label="threshold")
    sent, bottom = time_s[server["event"]], below.get_xaxis_transform()
    style: Any = {"color": "#0072b2", "linewidth": 0.8, "transform": bottom, "label": "sent"}
    below.vlines(sent, 0.0, 0.12, **style)
    threshold = server["threshold"][np.isfinite(server["threshold"])]
    # Logarithmic above the threshold: while nothing can be sent, the figure grows by decades.
    below.set_yscale("symlog", linthresh=max(threshold.max(initial=0.0), 1e-6))
    below.set_ylim(bottom=0.0)


def _ages(below: "Axes", flown: ReportedFlight) -> None:
    client = flown.client
    observed_s = np.where(client["age_ns"] >= 0, client["age_ns"] / SECOND_NS, np.nan)
    planned_s = (client["step"] - client["in_force"]) * flown.scenario.control.dt
    planned_s = np.where(client["in_force"] != NO_HORIZON, planned_s, np.nan)
    _over_time(below, flown, client, observed_s, "k-", linewidth=0.9, label="observation")
    _over_time(below, flown, client, planned_s, color="#0072b2", linewidth=0.9, label="plan")
    below.set_ylim(bottom=0.0)
    below.set_ylabel("age [s]")


def _packets(below: "Axes", flown: ReportedFlight) -> None:
    below.set_ylabel("packets per s")
    if not len(flown.netem):
        return
    # In seconds, because the epoch in a damaged file may exceed a 64-bit integer.
    arrived_s = flown.netem["arrived_ns"] / SECOND_NS - flown.epoch_ns / SECOND_NS
    flying = arrived_s < flown.time_s[-1] + 1.0
    draw_packets(below, flown.scenario, flown.netem["direction"][flying], arrived_s[flying])


def _name_modes(figure: "Figure", modes: set[Mode]) -> None:
    from matplotlib.patches import Patch

    names: dict[str, list[str]] = {}
    for mode in sorted(modes):
        names.setdefault(_colour(mode), []).append(str(mode))
    patches = [Patch(color=color, label=", ".join(each)) for color, each in names.items()]
    figure.legend(handles=patches, loc="outside upper center", ncols=len(patches), frameon=False)
