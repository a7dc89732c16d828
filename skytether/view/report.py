"""Report of a recorded flight: a page that opens offline, with figures, summary and events."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skytether.figures.colours import MODE_COLOURS, PALETTE, css
from skytether.figures.flights import draw_packets, draw_reference
from skytether.figures.page import Picture, Table, as_png, lettered, rendered
from skytether.shared.base.errors import RecordingError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Rows, compared
from skytether.shared.telemetry.summary import desired, position_error
from skytether.shared.wire.protocol import NO_HORIZON, Mode
from skytether.view.recorded import Recorded

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EVENTS_MAX = 400
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
        """Modes in succession, each with the slice of its rows and the first row after it."""
        modes = self.client["mode"]
        begins = np.flatnonzero(np.diff(modes, prepend=-1))
        for begin, end in zip(begins, [*begins[1:], len(modes)], strict=True):
            yield Mode(modes[begin]), slice(begin, end + 1)


def page(recorded: Recorded, figures: Sequence[tuple[str, str]]) -> str:
    """Page of a recording, as HTML.

    Args:
        figures: names and values of its summary.

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
    began = f"{about.began[:10]} {about.began[11:16]} UTC"
    where = f"over UDP, {began}" if about.began else "in virtual time"
    fleet = len(np.unique(client["vehicle"]))
    others = f" The figures show vehicle {number} of {fleet}." if fleet > 1 else ""
    summary = recorded.summary
    sent = "–" if summary.event_ratio is None else f"{summary.event_ratio:.1%}"
    rmse = summary.rmse_xy
    off = "" if rmse is None else f"The vehicle was {rmse:.3f} m off (RMSE xy); "
    rows = [list(row) for row in figures]
    table = Table(
        "summary", "Summary", "Figures of the whole flight.", "", ("figure", "value"), rows
    )
    facts = {
        "scenario": about.scenario,
        "seed": str(scenario.seed),
        "flown": where,
        "with": f"Skytether {about.version}",
        "recording": recorded.path.name,
    }
    drawn = {
        "title": f"Flight of {about.scenario}, seed {scenario.seed}",
        "about": f"{summary.duration_s:g} s {where}.{others}",
        "verdict": f"{off}a horizon was sent at {sent} of the steps.",
        "tables": [table],
        "pictures": [path(flown), timeline(flown)],
        "events": events[:EVENTS_MAX],
        "untold": max(0, len(events) - EVENTS_MAX),
        "made": facts,
        "toml": to_toml(scenario).decode(),
    }
    return rendered("view/report.html.jinja", drawn=drawn)


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
        _name_modes(figure, flown)
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
        _name_modes(figure, flown)
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
    # The compared figure spans decades while nothing can be sent; only the threshold matters.
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
    # In seconds: a damaged file may have an epoch that fits no 64-bit integer.
    arrived_s = flown.netem["arrived_ns"] / SECOND_NS - flown.epoch_ns / SECOND_NS
    flying = arrived_s < flown.time_s[-1] + 1.0
    draw_packets(below, flown.scenario, flown.netem["direction"][flying], arrived_s[flying])


def _name_modes(figure: "Figure", flown: ReportedFlight) -> None:
    from matplotlib.patches import Patch

    names: dict[str, list[str]] = {}
    for mode in sorted({mode for mode, _ in flown.spans()}):
        names.setdefault(_colour(mode), []).append(str(mode))
    patches = [Patch(color=color, label=", ".join(each)) for color, each in names.items()]
    figure.legend(handles=patches, loc="outside upper center", ncols=len(patches), frameon=False)
