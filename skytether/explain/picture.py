"""Picture of an explanation: errors above, packets and outages of each path and direction below."""

from typing import TYPE_CHECKING

import numpy as np

from skytether.explain.cases import Bad, Lane
from skytether.explain.causes import CausePart, lane_name
from skytether.explain.explanation import Explanation
from skytether.explain.flying import CaseOutcome
from skytether.explain.moments import AFTER_S, Moment
from skytether.figures.page import blank
from skytether.shared.base.errors import ConfigError
from skytether.shared.law.model import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LINES = (("#8fb4d9", 4.0, "-"), ("#1f7a3a", 1.6, "-"), ("#7b2d8b", 1.4, "--"))
"""Colour, width and style of the flights drawn for comparison."""
RED, DARK, GREY, PALE = "#b2182b", "#8c1a1a", "#dadada", "#faeef0"


def drawn(known: Explanation) -> "Figure":
    """Draw an explanation, also an incomplete one; raises ConfigError if nothing went wrong."""
    moment = known.moment
    if moment is None:
        raise ConfigError(f"{known.name}: nothing went wrong in this flight, there is no picture")
    lanes = _lanes(known, moment)
    figure = blank(10.0, 4.0 + 0.45 * len(lanes))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 0.4 + 0.45 * len(lanes)))
    _draw_errors(above, known, moment)
    _draw_lanes(below, known, lanes)
    first_s = min([moment.start_s, *(part.start_s for part in _stretches(known)[0])])
    below.set_xlim(max(0.0, first_s - 2.0, moment.start_s - 20.0), moment.end_s + AFTER_S)
    below.set_xlabel(
        "time [s]      × lost      ● plan      · other packet      "
        "shaded: outage (red: the smallest set that suffices)"
    )
    return figure


def _draw_errors(axes: "Axes", known: Explanation, moment: Moment) -> None:
    axes.set_title(
        f"{known.name}, seed {known.seed}: {moment.says} at {moment.start_s:.1f} s", loc="left"
    )
    axes.axvspan(moment.start_s, moment.end_s, color=PALE)
    axes.plot(*_errors(known.flown, moment), color=RED, linewidth=2.2, label="as flown", zorder=3)
    for (name, outcome), (colour, width, style) in zip(known.curves, LINES, strict=False):
        axes.plot(
            *_errors(outcome, moment), color=colour, linewidth=width, linestyle=style, label=name
        )
    axes.set_ylabel("distance from the reference [m]")
    axes.legend(loc="upper left", frameon=False)


def _errors(outcome: CaseOutcome, moment: Moment) -> tuple[Array, Array]:
    """Times [s] and errors [m] of the moment's vehicle; without its track, of the first vehicle."""
    tracks = [each for each in outcome.tracks if each.vehicle == moment.vehicle] or outcome.tracks
    return (tracks[0].time_s, tracks[0].error_m) if tracks else (np.zeros(0), np.zeros(0))


def _lanes(known: Explanation, moment: Moment) -> list[Lane]:
    """Lanes to draw, uplinks first: lanes of the moment's vehicle, and other lanes of the cause."""
    flow = max(0, moment.vehicle - 1)
    named = {part.unit.lane for part in _stretches(known)[0] if isinstance(part.unit, Bad)}
    lanes = {each for each in known.flown.began_s if each[2] == flow} | named
    return sorted(lanes, key=lambda lane: (lane[2], lane[1], lane[0]))


def _stretches(known: Explanation) -> tuple[list[CausePart], list[CausePart]]:
    """Stretches of the cause, and other examined stretches."""
    cause = known.cause
    if cause is None:
        return [], []
    found = (*cause.parts, *cause.averting)
    return [part for part in found if isinstance(part.unit, Bad)], [*cause.others]


def _draw_lanes(axes: "Axes", known: Explanation, lanes: list[Lane]) -> None:
    axes.set_yticks(range(len(lanes)), [lane_name(lane) for lane in lanes])
    axes.set_ylim(len(lanes) - 0.5, -0.5)
    for parts, colour in zip(_stretches(known), (RED, GREY), strict=True):
        for part in parts:
            if isinstance(part.unit, Bad) and part.unit.lane in lanes:
                row, long_s = lanes.index(part.unit.lane), max(0.02, part.end_s - part.start_s)
                at, alpha = (row - 0.36, 0.72), 0.35 if colour == RED else 1.0
                axes.broken_barh([(part.start_s, long_s)], at, color=colour, alpha=alpha)
    packets = known.flown.packets
    for row, lane in enumerate(lanes):
        own = np.array([each == lane for each in packets.lane], dtype=bool)
        for which, marker, size, colour in (
            (own & packets.lost, "x", 40, DARK),
            (own & ~packets.lost & packets.is_plan, "o", 40, "black"),
            (own & ~packets.lost & ~packets.is_plan, ".", 12, "black"),
        ):
            times_s = packets.time_s[which]
            rows = np.full(len(times_s), row)
            axes.scatter(times_s, rows, s=size, c=colour, marker=marker, zorder=3)
