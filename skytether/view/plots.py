"""Plots of a page: the last minute of one vehicle of each flight, and of their networks."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import viser
from viser import uplot

from skytether.figures.colours import css
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.law.model import Array
from skytether.shared.telemetry.record import DOWNLINK, UPLINK
from skytether.view.network import DELAY_BIN_NS, DELAY_BINS, SPAN_S, Network
from skytether.view.scene import FLIGHT_RGB
from skytether.view.state import Curves, State

POINTS = 400
SEEN = 4.0
"""Upper limit of the trigger's plot, in thresholds."""
SPARE = 6
"""Number of zeros left at the end of a cropped plot."""
HEIGHT = 150
GREY = "#868e96"
UP, DOWN = "#12b886", "#e64980"
"""Colours of the two directions, in plots of one flight or of data that all flights share."""
TIME = "time of flight [s]"
UNSEEN: uplot.Series = {"label": "\u00a0", "stroke": "transparent", "points": {"show": False}}
"""Invisible series that widens a plot's range: changing the range itself would redraw all."""


@dataclass(frozen=True, slots=True)
class Look:
    """Data of a flight for the plots."""

    state: State
    curves: Curves
    now_ns: int
    vehicle: int = 0


Values = Callable[[Look], Array]


@dataclass(frozen=True, slots=True)
class PlotLine:
    """Line of a plot, drawn for each flight or only for the first."""

    label: str
    values: Values
    rgb: str = ""
    """Colour; the flight's if empty, or if several flights have this line."""
    dash: tuple[int, ...] = ()
    width: float = 1.5
    once: bool = False
    """Whether the line is the same for all flights."""


@dataclass(frozen=True, slots=True)
class Plot:
    title: str
    lines: tuple[PlotLine, ...]
    grid: Values = lambda look: look.curves.time_s
    across: str = TIME
    log: bool = False
    crop: bool = False
    """Whether trailing zeros are cropped."""
    equal: bool = False
    """Whether the vertical range is as wide as in all other plots with `equal`."""


def _axis(axis: int) -> tuple[PlotLine, ...]:
    return (
        PlotLine(
            "reference", lambda look: look.curves.reference[:, axis], GREY, dash=(4, 4), once=True
        ),
        PlotLine("", lambda look: look.curves.position[:, axis]),
    )


def _seconds(look: Look) -> Array:
    """Seconds of flight shown [s], one each."""
    ages_s = np.arange(-SPAN_S, 0.0) + 0.5
    return look.state.time_s(look.now_ns) + ages_s


def _rates(direction: int) -> Values:
    def values(look: Look) -> Array:
        """Packets in each second, from the last second before the flight; NaN before."""
        rates = look.state.network.rates(direction, look.now_ns)
        return np.where(_seconds(look) > -1.0, rates, np.nan)

    return values


def _delays(direction: int) -> Values:
    def values(look: Look) -> Array:
        """Mean delays on the grid; NaN in seconds in which no packet arrived."""
        grid_s, seconds = look.curves.time_s, _seconds(look)
        delays_s = look.state.network.delays_s(direction, look.now_ns)
        known = ~np.isnan(delays_s)
        if not known.any():
            return np.full(len(grid_s), np.nan)
        nearest = np.clip(np.rint(grid_s - seconds[0]).astype(int), 0, len(seconds) - 1)
        return np.where(known[nearest], np.interp(grid_s, seconds[known], delays_s[known]), np.nan)

    return values


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
    """Compared figure, limited to SEEN thresholds so that the threshold stays visible."""
    most = np.where(look.curves.threshold > 0, SEEN * look.curves.threshold, np.inf)
    return np.where(np.isnan(most), look.curves.figure, np.minimum(look.curves.figure, most))


BY_DELAY = Plot(
    "Packets by their delay [%]",
    (
        PlotLine("up", _share(UPLINK), UP),
        PlotLine("down", _share(DOWNLINK), DOWN, dash=(2, 3)),
    ),
    grid=_bins_ms,
    across="delay [ms]",
    crop=True,
)


APART = Plot(
    "Nearest other vehicle [m]",
    (
        PlotLine(
            "required",
            lambda look: np.full(POINTS, look.state.scenario.mission.separation_m),
            GREY,
            dash=(4, 4),
            once=True,
        ),
        PlotLine("nearest", lambda look: look.state.nearest_m(look.vehicle, POINTS)),
    ),
)


def of_flight(axes: int, *, mission: bool = False) -> tuple[Plot, ...]:
    return (
        *((APART,) if mission else ()),
        *(Plot(f"{name} [m]", _axis(axis), equal=True) for axis, name in enumerate("xyz"[:axes])),
        Plot(
            "Packets in a second",
            (
                PlotLine("every step", _every_step, GREY, dash=(4, 4), once=True),
                PlotLine("up", _rates(UPLINK), UP),
                PlotLine("down", _rates(DOWNLINK), DOWN, dash=(2, 3)),
            ),
            grid=_seconds,
        ),
        Plot(
            "Trigger: figure and threshold",
            (
                PlotLine("threshold", lambda look: look.curves.threshold, GREY, dash=(4, 4)),
                PlotLine("compared", _compared),
            ),
        ),
    )


def of_network(*, solves: bool) -> tuple[Plot, ...]:
    packets = (
        Plot(
            "Age of the observation in use, and delays [s]",
            (
                PlotLine("age", lambda look: look.curves.age_s),
                PlotLine("delay up", _delays(UPLINK), UP, once=True, width=1.0),
                PlotLine("delay down", _delays(DOWNLINK), DOWN, dash=(2, 3), once=True, width=1.0),
            ),
        ),
        BY_DELAY,
    )
    solving = Plot(
        "Computing time, and its deadline [ms]",
        (
            PlotLine("deadline", _deadline_ms, GREY, dash=(4, 4), once=True),
            PlotLine("solving", lambda look: look.curves.solve_ms),
        ),
        log=True,
    )
    return (*packets, solving) if solves else packets


def of_link(names: Sequence[str] = ("up", "down")) -> tuple[Plot, ...]:
    """Plots of netem alone, whose directions have these names."""
    plots = (
        _ways("Packets in a second", Network.rates),
        _ways("Payload in a second [kB]", Network.loads, 1e-3),
        _ways("Lost [%]", Network.losses, 100.0),
        _ways("Delay, mean [ms]", Network.delays_s, 1e3),
        _ways("Packets under way", Network.waiting),
        BY_DELAY,
    )

    def named(plot: Plot) -> Plot:
        lines = zip(plot.lines, names, strict=True)
        return replace(plot, lines=tuple(replace(line, label=name) for line, name in lines))

    return tuple(map(named, plots))


def _ways(title: str, values: Callable[[Network, int, int], Array], scale: float = 1.0) -> Plot:
    """Plot of a figure of both directions over the last seconds, scaled."""

    def line(direction: int) -> Values:
        return lambda look: scale * values(look.state.network, direction, look.now_ns)

    down = PlotLine("down", line(DOWNLINK), DOWN, dash=(2, 3))
    return Plot(title, (PlotLine("up", line(UPLINK), UP), down), grid=_seconds, across="time [s]")


class Plots:
    """Plots of one browser.

    Args:
        titles: titles of the flights; empty for a single flight.
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
                colour = css(FLIGHT_RGB[place % len(FLIGHT_RGB)])
                rgb = line.rgb if line.rgb and (line.once or len(titles) == 1) else colour
                label = " ".join(filter(None, ("" if line.once else title, line.label)))
                shown: uplot.Series = {
                    "label": label or "flown",
                    "stroke": rgb,
                    "width": line.width,
                    "dash": line.dash,
                    "points": {"show": False},
                }
                series.append(shown)
        if plot.equal:
            series.append(UNSEEN)
        scales: dict[str, uplot.Scale] = {"x": {"time": False}}
        if plot.log:
            scales["y"] = {"distr": 3}
        upright: uplot.Axis = {"ticks": {"show": False}}
        across: uplot.Axis = {
            "label": plot.across,
            "labelSize": 16,
            "labelFont": "11px sans-serif",
            "size": 26,
            **upright,
        }
        nothing = (np.array([0.0, 1.0]),) * len(series)
        return gui.add_uplot(
            nothing,
            tuple(series),
            title=plot.title,
            scales=scales,
            axes=(across, upright),
            legend={"show": len(series) > 2, "live": False},
            cursor={"drag": {"x": False, "y": False, "setScale": False}},
            height=HEIGHT,
            padding=(2, 8, 0, 0),
        )

    def draw(self, looks: Sequence[Look]) -> None:
        """Draw the plots of all flights; the first flight determines the times."""
        drawn = []
        for plot in self._plots:
            data = [plot.grid(looks[0])]
            for place, look in enumerate(looks):
                data.extend(line.values(look) for line in plot.lines if not (line.once and place))
            drawn.append(begun(cropped(data) if plot.crop else data))
        equal = [data for plot, data in zip(self._plots, drawn, strict=True) if plot.equal]
        for data, ends in zip(equal, spans([data[1:] for data in equal]), strict=True):
            data.append(np.resize(ends, len(data[0])))
        for handle, data in zip(self._handles, drawn, strict=True):
            shown: Any = drawable(data)
            handle.data = shown


def spans(plots: Sequence[Sequence[Array]]) -> list[tuple[float, float]]:
    """Ranges of the same width that contain the values of each plot, around their middles."""
    together = [np.concatenate(lines) for lines in plots]
    known = [values[~np.isnan(values)] for values in together]
    known = [values if len(values) else np.zeros(1) for values in known]
    half = max((float(np.ptp(values)) / 2 for values in known), default=0.0)
    middles = [float(values.min() + values.max()) / 2 for values in known]
    return [(middle - half, middle + half) for middle in middles]


def cropped(data: Sequence[Array]) -> list[Array]:
    used = [int(np.flatnonzero(values).max(initial=0)) for values in data[1:]]
    return [values[: max(used) + SPARE] for values in data]


def begun(data: Sequence[Array]) -> list[Array]:
    """Data from the first known value on."""
    missing = [np.isnan(values) for values in data[1:]]
    begin = [int(np.argmin(unknown)) for unknown in missing if unknown.any() and not unknown.all()]
    first = min(min(begin, default=0), len(data[0]) - 2)
    return [values[first:] for values in data]


def drawable(data: Sequence[Array]) -> list[Any]:
    """Data for uPlot: None in gaps, because uPlot draws no line that contains NaN.

    A list, because viser converts everything in a tuple to numbers.
    """
    return [_with_gaps(values) if np.isnan(values).any() else values for values in data]


def _with_gaps(values: Array) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]
