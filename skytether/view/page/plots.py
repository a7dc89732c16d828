"""Plots of a page: the last minute of one vehicle per flight, and of the networks."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import viser
from viser import uplot

from skytether.figures.colours import AMBER, BLUE, GREEN, MODE_COLOURS, PALETTE, RED, VIOLET, css
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.law.model import Array
from skytether.shared.telemetry.record import DOWNLINK, UPLINK
from skytether.view.page.changes import Mark
from skytether.view.page.network import DELAY_BIN_NS, DELAY_BINS, SPAN_S, Network
from skytether.view.page.scene import FLIGHT_RGB
from skytether.view.page.state import Curves, State

POINTS = 400
SEEN = 4.0
"""Upper limit of the trigger's plot, as a multiple of the threshold."""
SPARE = 6
"""Number of zeros left at the end of a cropped plot."""
HEIGHT, BANDS_HEIGHT, AXIS = 115, 75, 35
"""Heights of a plot and of a plot of bands, without horizontal axis, and of this axis [pixels]."""
BAND_MODE, BAND_LINK, BAND_ENDS = 2.0, 1.0, (0.0, 3.0)
"""Vertical positions of the bands for mode and link in the plot `STATE`, and the range of its
vertical axis."""
GREY = "#868e96"
UP, DOWN = "#12b886", "#e64980"
"""Colours of the two directions, in plots of one flight or of data that all flights share."""
TIME, DELAY = "time of flight [s]", "delay [ms]"
MARKS: dict[Mark, str] = {
    Mark.CUT: css(PALETTE[RED]),
    Mark.HEALED: css(PALETTE[GREEN]),
    Mark.CHANGED: css(PALETTE[AMBER]),
}
"""Colours of the vertical lines at changes."""
BANDS = {GREEN: "TRACK", AMBER: "COAST", RED: "BRAKE", BLUE: "HOVER", VIOLET: "LAND"}
"""Mode shown for each colour."""
LINKS = {GREEN: "link good", AMBER: "degraded", RED: "cut"}
UNSEEN: uplot.Series = {"label": "\u00a0", "stroke": "transparent", "points": {"show": False}}
"""Invisible series that widens a plot's range, because changing the range redraws all."""


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
    """Colour of the line. If empty, or if several flights have the line: the flight's colour."""
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
    """Whether zeros at the end of the plot are left out, but for SPARE of them."""
    equal: bool = False
    """Whether the vertical range is as wide as in all other plots with `equal`."""
    bands: bool = False
    """Whether the values are places of named bands, so that the vertical axis has no numbers."""

    @property
    def timed(self) -> bool:
        return self.across != DELAY


def _axis(axis: int) -> tuple[PlotLine, ...]:
    return (
        PlotLine(
            "reference", lambda look: look.curves.reference[:, axis], GREY, dash=(4, 4), once=True
        ),
        PlotLine("", lambda look: look.curves.position[:, axis]),
    )


def _seconds(look: Look) -> Array:
    """Times of flight shown [s], one per second."""
    ages_s = np.arange(-SPAN_S, 0.0) + 0.5
    return look.state.time_s(look.now_ns) + ages_s


def _rates(direction: int) -> Values:
    def values(look: Look) -> Array:
        """Packets in each second, from 1 s before the flight on; NaN for earlier seconds."""
        rates = look.state.network.rates(direction, look.now_ns)
        return np.where(_seconds(look) > -1.0, rates, np.nan)

    return values


def _delays(direction: int) -> Values:
    def values(look: Look) -> Array:
        """Mean delays at the times of the curves [s]; NaN in seconds in which no packet arrived."""
        grid_s, seconds = look.curves.time_s, _seconds(look)
        delays_s = look.state.network.delays_s(direction, look.now_ns)
        is_finite = ~np.isnan(delays_s)
        if not is_finite.any():
            return np.full(len(grid_s), np.nan)
        nearest = np.clip(np.rint(grid_s - seconds[0]).astype(int), 0, len(seconds) - 1)
        return np.where(
            is_finite[nearest], np.interp(grid_s, seconds[is_finite], delays_s[is_finite]), np.nan
        )

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
    """Trigger's figure, cut off at SEEN times the threshold unless the threshold is 0 or NaN."""
    most = np.where(look.curves.threshold > 0, SEEN * look.curves.threshold, np.inf)
    return np.where(np.isnan(most), look.curves.figure, np.minimum(look.curves.figure, most))


BY_DELAY = Plot(
    "Packets by their delay [%]",
    (
        PlotLine("up", _share(UPLINK), UP),
        PlotLine("down", _share(DOWNLINK), DOWN, dash=(2, 3)),
    ),
    grid=_bins_ms,
    across=DELAY,
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


ERROR = Plot("Error [m]", (PlotLine("", lambda look: look.curves.error_m),))


SOLVING = Plot(
    "Computing time, and its deadline [ms]",
    (
        PlotLine("deadline", _deadline_ms, GREY, dash=(4, 4), once=True),
        PlotLine("solving", lambda look: look.curves.solve_ms),
    ),
    log=True,
)


def _mode(colour: str) -> Values:
    modes = [mode for mode, its in MODE_COLOURS.items() if its == colour]
    return lambda look: np.where(np.isin(look.curves.mode, modes), BAND_MODE, np.nan)


def _link(colour: str) -> Values:
    return lambda look: np.where(
        look.state.links(look.curves, look.now_ns) == colour, BAND_LINK, np.nan
    )


STATE = Plot(
    "State, and link below",
    tuple(
        PlotLine(name, values(colour), css(PALETTE[colour]), width=10.0, once=True)
        for names, values in ((BANDS, _mode), (LINKS, _link))
        for colour, name in names.items()
    ),
    bands=True,
)


def of_flight(*, mission: bool = False) -> tuple[Plot, ...]:
    """Plots for an operator's decisions; the state is that of the first flight."""
    return (
        ERROR,
        *((APART,) if mission else ()),
        STATE,
        Plot(
            "Packets in a second",
            (
                PlotLine("every step", _every_step, GREY, dash=(4, 4), once=True),
                PlotLine("up", _rates(UPLINK), UP),
                PlotLine("down", _rates(DOWNLINK), DOWN, dash=(2, 3)),
            ),
            grid=_seconds,
        ),
    )


def more(axes: int, *, solves: bool) -> tuple[Plot, ...]:
    return (
        *(Plot(f"{name} [m]", _axis(axis), equal=True) for axis, name in enumerate("xyz"[:axes])),
        Plot(
            "Trigger: figure and threshold",
            (
                PlotLine("threshold", lambda look: look.curves.threshold, GREY, dash=(4, 4)),
                PlotLine("compared", _compared),
            ),
        ),
        Plot(
            "Age of the observation in use, and delays [s]",
            (
                PlotLine("age", lambda look: look.curves.age_s),
                PlotLine("delay up", _delays(UPLINK), UP, once=True, width=1.0),
                PlotLine("delay down", _delays(DOWNLINK), DOWN, dash=(2, 3), once=True, width=1.0),
            ),
        ),
        *((SOLVING,) if solves else ()),
        BY_DELAY,
    )


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
    """Plot of a figure of both directions over the last seconds, multiplied by `scale`."""

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
        last = max((at for at, plot in enumerate(plots) if plot.timed), default=-1)
        self._handles = [
            self._make(gui, plot, titles, first=not at, axis=at == last or not plot.timed)
            for at, plot in enumerate(plots)
        ]

    @staticmethod
    def _make(
        gui: viser.GuiApi, plot: Plot, titles: Sequence[str], *, first: bool, axis: bool
    ) -> viser.GuiUplotHandle:
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
        own = len(series)
        if plot.timed:
            series += [
                {
                    "label": mark.value,
                    "stroke": rgb,
                    "width": 1.5,
                    "points": {"show": False},
                    "class": "skytether-first" if first else "skytether-mark",
                }
                for mark, rgb in MARKS.items()
            ]
        if plot.equal or plot.bands:
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
        hidden: uplot.Axis = {**upright, "values": (), "size": 0}
        numbers: uplot.Axis = {**upright, "values": ()} if plot.bands else upright
        nothing = (np.array([0.0, 1.0]),) * len(series)
        return gui.add_uplot(
            nothing,
            tuple(series),
            title=plot.title,
            scales=scales,
            axes=(across if axis else hidden, numbers),
            legend={"show": first or own > 2, "live": False},
            cursor={"drag": {"x": False, "y": False, "setScale": False}},
            height=(BANDS_HEIGHT if plot.bands else HEIGHT) + (AXIS if axis else 0),
            padding=(2, 8, 0 if axis else 8, 0),
        )

    def draw(self, looks: Sequence[Look]) -> None:
        """Draw the plots of all flights; the first flight determines the times."""
        drawn = []
        for plot in self._plots:
            data = [plot.grid(looks[0])]
            for place, look in enumerate(looks):
                data.extend(line.values(look) for line in plot.lines if not (line.once and place))
            drawn.append(cropped(data) if plot.crop else data)
        timed = [data for plot, data in zip(self._plots, drawn, strict=True) if plot.timed]
        for data, same in zip(timed, on_one_axis(timed), strict=True):
            data[:] = same + marked(same, looks[0].state.marks)
        equal = [data for plot, data in zip(self._plots, drawn, strict=True) if plot.equal]
        own = [data[1 : len(data) - len(MARKS)] for data in equal]
        for data, ends in zip(equal, spans(own), strict=True):
            data.append(np.resize(ends, len(data[0])))
        for plot, data in zip(self._plots, drawn, strict=True):
            if plot.bands:
                data.append(np.resize(BAND_ENDS, len(data[0])))
        for handle, data in zip(self._handles, drawn, strict=True):
            shown: Any = drawable(data)
            handle.data = shown


def on_one_axis(plots: Sequence[Sequence[Array]]) -> list[list[Array]]:
    """Data of plots on the finest of their time grids, from the first value in any plot on.

    Args:
        plots: times of each plot, and the plot's values at these times.
    """
    if not plots:
        return []
    grid_s = max((data[0] for data in plots), key=len)
    together = []
    for time_s, *lines in plots:
        nearest = np.searchsorted((time_s[:-1] + time_s[1:]) / 2, grid_s)
        together.append([grid_s, *(line[nearest] for line in lines)])
    are_finite = [~np.isnan(line) for _, *lines in together for line in lines]
    begin = [int(np.argmax(each)) for each in are_finite if each.any() and not each.all()]
    first = min(min(begin, default=0), len(grid_s) - 2)
    return [[line[first:] for line in data] for data in together]


def marked(data: Sequence[Array], marks: Iterable[tuple[float, Mark]]) -> list[Array]:
    """Vertical lines at changes, for each of MARKS, between a plot's extreme values."""
    time_s, *lines = data
    finite = np.concatenate([line[~np.isnan(line)] for line in lines])
    low, high = (finite.min(), finite.max()) if len(finite) else (0.0, 1.0)
    found = {mark: np.full(len(time_s), np.nan) for mark in MARKS}
    for at_s, mark in marks:
        at = int(np.searchsorted(time_s, at_s))
        if time_s[0] <= at_s and 0 < at < len(time_s):
            found[mark][at - 1 : at + 1] = low, high
    return list(found.values())


def spans(plots: Sequence[Sequence[Array]]) -> list[tuple[float, float]]:
    """Vertical ranges, equally wide in all plots, centred on the values of each plot."""
    together = [np.concatenate(lines) for lines in plots]
    finite = [values[~np.isnan(values)] for values in together]
    finite = [values if len(values) else np.zeros(1) for values in finite]
    half = max((float(np.ptp(values)) / 2 for values in finite), default=0.0)
    middles = [float(values.min() + values.max()) / 2 for values in finite]
    return [(middle - half, middle + half) for middle in middles]


def cropped(data: Sequence[Array]) -> list[Array]:
    used = [int(np.flatnonzero(values).max(initial=0)) for values in data[1:]]
    return [values[: max(used) + SPARE] for values in data]


def drawable(data: Sequence[Array]) -> list[Any]:
    """Data for uPlot: None in gaps, because uPlot draws no line that contains NaN.

    The result is a list, because viser converts all items of a tuple to numbers.
    """
    return [_with_gaps(values) if np.isnan(values).any() else values for values in data]


def _with_gaps(values: Array) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]
