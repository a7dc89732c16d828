"""The plots of a page: the last minute of one vehicle of each flight, and of their networks."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from shared.endpoint import MILLISECOND_NS
from shared.record import DOWNLINK, UPLINK
from view.scene import FLIGHT_RGB, Rgb
from view.state import DELAY_BIN_NS, DELAY_BINS, SPAN_S, Curves, State

Array = NDArray[np.float64]

POINTS = 400
"""Number of points of a line."""
SEEN = 4.0
"""Thresholds above which what the trigger compares is cut off."""
SPARE = 6
"""Number of zeros that are left at the end where they are cropped."""
HEIGHT = 150
"""Height of a plot [pixels]."""
GREY = "#868e96"
MARK = "rgba(240, 62, 62, 0.6)"


@dataclass(frozen=True, slots=True)
class Look:
    """What the plots show of a flight at a time."""

    state: State
    curves: Curves
    now_ns: int


Values = Callable[[Look], Array]


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a plot, drawn for each flight or for the first alone."""

    label: str
    values: Values
    rgb: str = ""
    """Its colour; that of the flight unless given."""
    dash: tuple[int, ...] = ()
    width: float = 1.5
    marks: bool = False
    """Whether it is 1 where a mark across the whole plot stands, and 0 elsewhere."""
    once: bool = False
    """Whether it is the same of all flights."""


@dataclass(frozen=True, slots=True)
class Plot:
    """One plot."""

    title: str
    lines: tuple[Line, ...]
    grid: Values = lambda look: look.curves.time_s
    log: bool = False
    crop: bool = False
    """Whether it ends where nothing but zeros follows."""


def hex_of(rgb: Rgb) -> str:
    """A colour as a page writes it."""
    return "#{:02x}{:02x}{:02x}".format(*rgb)


def _axis(axis: int) -> tuple[Line, ...]:
    return (
        Line(
            "reference", lambda look: look.curves.reference[:, axis], GREY, dash=(4, 4), once=True
        ),
        Line("", lambda look: look.curves.position[:, axis]),
    )


def _seconds(look: Look) -> Array:
    """Times of flight of the last seconds, one each [s]."""
    ages_s = np.arange(-SPAN_S, 0.0) + 0.5
    return look.state.time_s(look.now_ns) + ages_s


def _delays(direction: int) -> Values:
    return lambda look: np.interp(
        look.curves.time_s, _seconds(look), look.state.network.delays_s(direction, look.now_ns)
    )


def _bins_ms(_: Look) -> Array:
    return (np.arange(DELAY_BINS) + 0.5) * DELAY_BIN_NS / MILLISECOND_NS


def _share(direction: int) -> Values:
    def values(look: Look) -> Array:
        counts = look.state.network.histogram(direction, look.now_ns)
        return 100.0 * counts / max(1.0, counts.sum())

    return values


def _every_step(look: Look) -> Array:
    return np.full(int(SPAN_S), look.state.every_step)


def _deadline_ms(look: Look) -> Array:
    return np.full(POINTS, look.state.scenario.dt_ns / MILLISECOND_NS)


def _compared(look: Look) -> Array:
    """What the trigger compares, as far as it can be seen beside its threshold."""
    most = np.where(look.curves.threshold > 0, SEEN * look.curves.threshold, np.inf)
    return np.where(np.isnan(most), look.curves.figure, np.minimum(look.curves.figure, most))


def of_flight(axes: int) -> tuple[Plot, ...]:
    """Plots of a vehicle with so many axes."""
    return (
        *(Plot(f"{name} [m]", _axis(axis)) for axis, name in enumerate("xyz"[:axes])),
        Plot(
            "What the trigger compares, and packets",
            (
                Line("threshold", lambda look: look.curves.threshold, GREY, dash=(4, 4)),
                Line("compared", _compared),
                Line(
                    "sent", lambda look: look.curves.event, MARK, marks=True, width=1.0, once=True
                ),
            ),
        ),
        Plot(
            "Age of what is flown by [s]",
            (
                Line("age", lambda look: look.curves.age_s),
                Line("delay up", _delays(UPLINK), GREY, once=True, width=1.0),
                Line("delay down", _delays(DOWNLINK), GREY, dash=(2, 3), once=True, width=1.0),
            ),
        ),
    )


def of_network() -> tuple[Plot, ...]:
    """Plots of packets, and of what plans cost."""
    return (
        Plot(
            "Packets up in a second",
            (
                Line("every step", _every_step, GREY, dash=(4, 4), once=True),
                Line("up", lambda look: look.state.network.rates(UPLINK, look.now_ns)),
            ),
            grid=_seconds,
        ),
        Plot(
            "Packets by their delay [ms], %",
            (
                Line("up", _share(UPLINK)),
                Line("down", _share(DOWNLINK), GREY, dash=(2, 3), once=True),
            ),
            grid=_bins_ms,
            crop=True,
        ),
        Plot(
            "Solving, against the deadline [ms]",
            (
                Line("deadline", _deadline_ms, GREY, dash=(4, 4), once=True),
                Line("solving", lambda look: look.curves.solve_ms),
            ),
            log=True,
        ),
    )


class Plots:
    """The plots of one browser.

    Args:
        gui: where they are made.
        titles: what the flights are called; empty for a flight that is alone.
        plots: what is plotted.
    """

    def __init__(self, gui: viser.GuiApi, titles: Sequence[str], plots: Sequence[Plot]) -> None:
        self._plots = plots
        self._handles = [self._make(gui, plot, titles) for plot in self._plots]

    @staticmethod
    def _make(gui: viser.GuiApi, plot: Plot, titles: Sequence[str]) -> viser.GuiUplotHandle:
        series: list[uplot.Series] = [{"label": "t"}]
        for place, title in enumerate(titles):
            for line in plot.lines:
                if line.once and place:
                    continue
                rgb = line.rgb or hex_of(FLIGHT_RGB[place % len(FLIGHT_RGB)])
                label = " ".join(filter(None, ("" if line.once else title, line.label)))
                shown: uplot.Series = {
                    "label": label or "flown",
                    "stroke": rgb,
                    "width": line.width,
                    "dash": line.dash,
                    "points": {"show": False},
                    "scale": "marks" if line.marks else "y",
                }
                series.append(shown)
        # What is no mark lies below the scale, and is not seen.
        marks: uplot.Scale = {"auto": False, "range": (0.5, 1.0)}
        scales: dict[str, uplot.Scale] = {"x": {"time": False}, "marks": marks}
        if plot.log:
            scales["y"] = {"distr": 3}
        nothing = (np.array([0.0, 1.0]),) * len(series)
        return gui.add_uplot(
            nothing,
            tuple(series),
            title=plot.title,
            scales=scales,
            legend={"show": len(series) > 2, "live": False},
            cursor={"drag": {"x": False, "y": False, "setScale": False}},
            height=HEIGHT,
            padding=(2, 8, 0, 0),
        )

    def draw(self, looks: Sequence[Look]) -> None:
        """Show flights as they are now; the first gives the times."""
        for plot, handle in zip(self._plots, self._handles, strict=True):
            data = [plot.grid(looks[0])]
            for place, look in enumerate(looks):
                data.extend(line.values(look) for line in plot.lines if not (line.once and place))
            handle.data = known(cropped(data) if plot.crop else data)


def cropped(data: Sequence[Array]) -> list[Array]:
    """Data without the zeros that end all of it, but for a few."""
    used = [int(np.flatnonzero(values).max(initial=0)) for values in data[1:]]
    return [values[: max(used) + SPARE] for values in data]


def known(data: Sequence[Array]) -> tuple[Array, ...]:
    """Data from where on anything is known: uPlot draws no line that has a NaN in it.

    A line that begins later, or of which nothing is known, is drawn with its first number, or 0,
    until then.
    """
    missing = [np.isnan(values) for values in data[1:]]
    begin = [int(np.argmin(gone)) for gone in missing if gone.any() and not gone.all()]
    begins = min(min(begin, default=0), len(data[0]) - 2)
    filled = [data[0][begins:]]
    for values, gone in zip(data[1:], missing, strict=True):
        rest, nothing = values[begins:], gone[begins:]
        first = rest[int(np.argmin(nothing))] if not nothing.all() else 0.0
        filled.append(np.where(nothing, first, rest))
    return tuple(filled)
