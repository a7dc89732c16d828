"""Figures of a report for print, each with a caption and its numbers as CSV.

Figures are as wide as a journal's column or page, with text of 8 points. The reference is red and
dashed, the vehicle black, as in the paper.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from skytether.figures.flights import draw_reference
from skytether.figures.page import Picture, as_png, lettered
from skytether.figures.tables import rows_csv, to_csv
from skytether.lab.engine.studies import (
    EVENT,
    EVERY,
    NONE,
    PERIODIC,
    Cells,
    CellSummaries,
    Study,
    periodic_wins,
)
from skytether.lab.engine.sweep import by_name, estimate
from skytether.shared.law.model import Array, Indices
from skytether.shared.scenario.registry import IMPAIRMENTS, TRIGGERS
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import Summary, desired, summarise

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMN, PAGE = 3.5, 7.16
"""Width of a figure over one column and over the page [inch]."""
LETTERS = 8
STYLES: Mapping[str, Mapping[str, Any]] = {
    NONE: {"color": "0.5", "linestyle": ":", "marker": "s"},
    EVERY: {"color": "black", "linestyle": "-", "marker": "o"},
    EVENT: {"color": "#c1272d", "linestyle": "-", "marker": "^"},
    PERIODIC: {"color": "#0072b2", "linestyle": "--", "marker": "v"},
}
"""Line style of each method; methods can be distinguished without colour."""
RATIO_LOG = 20.0
"""An axis is logarithmic if the largest value is more than this multiple of the smallest."""

Samples = Mapping[str, tuple[Scenario, Sequence[Record]]]


@dataclass(frozen=True, slots=True)
class Plate(Picture):
    pdf: bytes
    csv: str
    """Numbers in the figure, as CSV."""

    def files(self) -> dict[str, bytes]:
        return {".png": self.png, ".pdf": self.pdf, ".csv": self.csv.encode()}


def picture(figure: "Figure", name: str, title: str, says: str, csv: str) -> Plate:
    png, pdf = as_png(figure, 220), io.BytesIO()
    figure.set_layout_engine("none")  # keep the figure's exact size
    figure.savefig(pdf, format="pdf", metadata={"CreationDate": None})
    return Plate(name, title, says, png, pdf.getvalue(), csv)


def delay(direction: str, delay_ms: Array) -> Plate:
    """Fig. 2: distribution of the delay, eq. (17), drawn and measured.

    `delay_ms` has the measured delay of each packet over UDP, and the delay that netem drew [ms];
    shape (packets, 2).
    """
    from scipy import stats  # takes a second to import

    took_ms, late_ms = delay_ms[:, 0], delay_ms[:, 0] - delay_ms[:, 1]
    least_s, slot_s, slots_mean, *_ = map(float, IMPAIRMENTS.calls(direction)[0].values)
    first_ms, slot_ms = least_s * 1e3, slot_s * 1e3
    count = int(stats.poisson.ppf(0.9999, slots_mean)) + 2
    slots = np.arange(count)
    lattice_ms, pdf = first_ms + slot_ms * slots, stats.poisson.pmf(slots, slots_mean)
    # Packets are late, never early: up to one slot late counts as the drawn slot.
    nearest = np.floor((took_ms - first_ms) / slot_ms + 0.1)
    share = np.array([np.mean(nearest == slot) for slot in slots])
    fine_ms = np.arange(first_ms - slot_ms, lattice_ms[-1] + 1.0)
    cdf = stats.poisson.cdf(np.floor((fine_ms - first_ms) / slot_ms + 1e-9), slots_mean)
    took_cdf = np.searchsorted(np.sort(took_ms), fine_ms, side="right") / len(took_ms)
    with lettered(PAGE, 2.4, LETTERS) as figure:
        left, right = figure.subplots(1, 2)
        left.bar(lattice_ms, share, 0.7 * slot_ms, color="0.75", label="over UDP")
        left.plot(lattice_ms, pdf, "r_", markersize=10, markeredgewidth=1.5, label="(17)")
        left.set_ylabel("probability")
        right.plot(fine_ms, took_cdf, "k-", linewidth=1.2, label="over UDP")
        right.plot(fine_ms, cdf, "r--", linewidth=1.0, label="(17)")
        right.set_ylabel("cumulative probability")
        for axes in (left, right):
            axes.set_xlabel("delay [ms]")
            axes.legend()
    p50, p99 = np.quantile(late_ms, (0.5, 0.99))
    worst = np.max(np.abs(share - pdf))
    says = (
        f"The delay (17), as corrected (E1, E2), and the measured delay of {len(took_ms)} packets "
        f"through netem over UDP on loopback. They arrived {p50:.2f} ms (median) and {p99:.2f} ms "
        f"(p99) later than drawn, and the largest error of a probability is {worst:.3f}."
    )
    at = dict(zip(lattice_ms.round(6).tolist(), zip(pdf, share, strict=True), strict=True))
    rows = [
        (ms, *at.get(round(ms, 6), (None, None)), theory, real)
        for ms, theory, real in zip(fine_ms.tolist(), cdf, took_cdf, strict=True)
    ]
    header = ("delay_ms", "probability", "probability_udp", "cumulative", "cumulative_udp")
    return picture(figure, "fig2", "Fig. 2: network delay", says, to_csv(header, rows))


def paths(samples: Samples) -> Plate:
    rmse, positions = [], []
    with lettered(PAGE, 3.9, LETTERS) as figure:
        planes = figure.subplots(1, 2, sharex=True, sharey=True)
        for plane, letter, method in zip(planes, "ab", (NONE, EVERY), strict=True):
            scenario, flights = samples[method]
            rmse.append(summarise(scenario, method, flights[0].client).rmse_xy)
            step, wanted, position = _path(scenario, flights[0])
            _draw_path(plane, scenario, flights[0])
            plane.set_title(f"({letter}) {method}, a packet at every step")
            positions.append(position)
        planes[0].legend(loc="center")
    says = (
        f"One flight each, with the same seed. RMSE xy is {rmse[0]:.3f} m without compensation and "
        f"{rmse[1]:.3f} m with both compensators."
    )
    header = ("step", "reference_x_m", "reference_y_m", "a_x_m", "a_y_m", "b_x_m", "b_y_m")
    rows = np.column_stack([step, wanted, *positions]).tolist()
    title = "Fig. 3: position without and with delay compensation"
    return picture(figure, "fig3", title, says, to_csv(header, rows))


def events(samples: Samples) -> Plate:
    scenario, flights = samples[EVENT]
    flight, dt = flights[0], scenario.control.dt
    step, wanted, position = _path(scenario, flight)
    sent = np.isin(step, flight.server["step"][flight.server["event"]])
    with lettered(COLUMN, 4.4, LETTERS) as figure:
        plane, below = figure.subplots(2, 1, height_ratios=(5, 1))
        _draw_path(plane, scenario, flight)
        plane.legend(loc="center")
        below.vlines(step[sent] * dt, 0.0, 1.0, color="k", linewidth=0.5)
        below.set_xlim(0.0, scenario.duration)
        below.set_yticks([])
        below.set_xlabel("time [s]")
        below.set_ylabel("event")
    rmse = summarise(scenario, EVENT, flight.client).rmse_xy
    says = (
        f"One flight with the event trigger (16), with the same seed: RMSE xy is {rmse:.3f} m with "
        f"packets at {np.mean(flight.server['event']):.1%} of the steps."
    )
    header = ("step", "reference_x_m", "reference_y_m", "x_m", "y_m", "event")
    rows = np.column_stack([step, wanted, position, sent]).tolist()
    title = "Fig. 4: position with the event trigger, and its events"
    return picture(figure, "fig4", title, says, to_csv(header, rows))


def _path(scenario: Scenario, flight: Record) -> tuple[Indices, Array, Array]:
    """Steps, reference and position [m] of a flight; shapes (steps,), (steps, 2), (steps, 2)."""
    client = flight.client
    wanted = desired(scenario, client, flight.server)[:, :2]
    return client["step"], wanted, client["state"][:, :2, 0]


def _draw_path(plane: Any, scenario: Scenario, flight: Record) -> None:
    draw_reference(plane, scenario, flight.client, flight.server)
    position = flight.client["state"][:, :2, 0]
    plane.plot(position[:, 0], position[:, 1], "k-", linewidth=0.8, label="UAV")
    plane.plot(position[0, 0], position[0, 1], "ko", markersize=3, label="start")
    plane.set_aspect("equal", adjustable="box")
    plane.set_xlabel("x [m]")
    plane.set_ylabel("y [m]")


DECAY, EPSILON = "decay rate λ [1/s]", "tolerance ε"


def maps(flown: CellSummaries, here: ControlConfig) -> Plate:
    """Fig. 5: RMSE and event ratio over the decay rate λ and the tolerance ε.

    A cross marks the paper's λ and ε, taken from the scenario `here`.
    """
    from scipy import stats  # takes a second to import

    decay, epsilon, rmse, ratio = _grid(flown)
    here_epsilon, here_decay = TRIGGERS.one(here.trigger).values
    with lettered(PAGE, 2.8, LETTERS) as figure:
        panes = figure.subplots(1, 2)
        names = ("RMSE xy [m]", "event ratio")
        for plane, values, name in zip(panes, (rmse, ratio), names, strict=True):
            mesh = plane.pcolormesh(decay, epsilon, values.T, shading="nearest")
            plane.grid(visible=False)
            plane.plot(here_decay, here_epsilon, "wx", markeredgewidth=1.5)
            plane.set_xlabel(DECAY)
            plane.set_ylabel(EPSILON)
            figure.colorbar(mesh, label=name)
    ranks = stats.spearmanr(rmse.ravel(), ratio.ravel()).statistic
    says = (
        f"{len(flown)} cells; the cross is the paper's. The event ratio rises with λ, on average "
        f"from {ratio[0].mean():.3f} at {decay[0]:g} to {ratio[-1].mean():.3f} at {decay[-1]:g}, "
        f"and falls with ε, from {ratio[:, 0].mean():.3f} to {ratio[:, -1].mean():.3f}. RMSE and "
        f"event ratio have a rank correlation of {ranks:.2f}; the paper calls them inversely "
        "related."
    )
    rows = [
        {"decay_rate": decay, "epsilon": epsilon} | by_name(DRAWN, partial(estimate, runs))
        for (decay, epsilon), runs in flown.items()
    ]
    title = "Fig. 5: control performance and event ratio over λ and ε"
    return picture(figure, "fig5", title, says, rows_csv(rows))


DRAWN = ("rmse_xy", "event_ratio")


def _grid(flown: CellSummaries) -> tuple[Array, Array, Array, Array]:
    """Values of λ and of ε, and mean RMSE xy [m] and event ratio over both; shapes (λ,), (ε,), (λ,
    ε).
    """
    decay, epsilon = (np.unique([values[axis] for values in flown]) for axis in (0, 1))
    shape = (len(decay), len(epsilon))
    rmse, ratio = (
        np.array([estimate(runs, name)[0] for runs in flown.values()], dtype=np.float64)
        for name in DRAWN
    )
    return decay, epsilon, rmse.reshape(shape), ratio.reshape(shape)


def pareto(flown: CellSummaries, periodic: CellSummaries) -> Plate:
    """Fig. 5 as curves: RMSE over event ratio, with periodic sending for comparison."""
    decay, _, rmse, ratio = _grid(flown)
    rates, errors = (
        np.array([estimate(runs, name)[0] for runs in periodic.values()], dtype=np.float64)
        for name in ("event_ratio", "rmse_xy")
    )
    with lettered(COLUMN, 3.0, LETTERS) as figure:
        from matplotlib import colormaps

        plane = figure.subplots()
        colours = colormaps["autumn"](np.linspace(0.0, 0.7, len(decay)))
        for value, x, y, colour in zip(decay, ratio, rmse, colours, strict=True):
            ends = value in (decay[0], decay[-1])
            label = f"(16), λ = {value:g} /s" if ends else None
            plane.plot(x, y, "^-", color=colour, linewidth=0.8, markersize=3, label=label)
        plane.plot(rates, errors, "v--", color="#0072b2", markersize=4, label="periodic")
        plane.set_xscale("log")
        plane.set_yscale("log")
        plane.set_xlabel("event ratio")
        plane.set_ylabel("RMSE xy [m]")
        plane.legend()
    order = np.argsort(rates)
    within = (ratio >= rates.min()) & (ratio <= rates.max())
    at_rate = np.interp(np.log(ratio), np.log(rates[order]), errors[order])
    worse, compared = int(np.sum(within & (at_rate < rmse))), int(within.sum())
    says = (
        f"Below and to the left is better. At the same rate (interpolated), periodic sending has "
        f"the smaller RMSE in {worse} of {compared} cells; the trigger's is "
        f"{np.mean(rmse[within] / at_rate[within]):.2f} times it on average."
    )

    def row(method: str, values: Sequence[Any], runs: Sequence[Summary]) -> dict[str, Any]:
        names = ("decay_rate", "epsilon", "period")
        means = by_name(DRAWN, partial(estimate, runs))
        return {"method": method} | dict(zip(names, values, strict=True)) | means

    rows = [row(EVENT, (*values, None), runs) for values, runs in flown.items()]
    rows += [row("periodic", (None, None, *values), runs) for values, runs in periodic.items()]
    title = "Fig. 5 as curves: RMSE over event ratio"
    return picture(figure, "fig5-pareto", title, says, rows_csv(rows))


def curve(study: Study, cells: Cells) -> Plate:
    """RMSE of all methods over the parameter of a study, with 95 % bands."""
    methods = list(STYLES)
    table = {
        method: np.array(
            [cells[value, method].estimate("rmse_xy") for value in study.axis.values], np.float64
        )
        for method in methods
    }
    places = np.array(study.axis.values)
    with lettered(COLUMN, 3.2, LETTERS) as figure:
        plane = figure.subplots()
        for method in methods:
            means, halves = table[method].T
            halves = np.nan_to_num(halves)
            plane.plot(places, means, **STYLES[method], linewidth=1.0, markersize=3.5, label=method)
            colour = STYLES[method]["color"]
            low = np.maximum(means - halves, 0.5 * means)  # a logarithmic axis cannot show 0
            plane.fill_between(places, low, means + halves, color=colour, alpha=0.2, linewidth=0)
        plane.axvline(study.here, color="0.6", linewidth=0.8)
        means = np.concatenate([table[method][:, 0] for method in methods])
        if np.nanmax(means) > RATIO_LOG * np.nanmin(means):
            plane.set_yscale("log")
        plane.set_xlabel(study.label)
        plane.set_ylabel("RMSE xy [m]")
        figure.legend(loc="outside upper center", ncols=2)
    better, worse = against_periodic(study, cells)
    n = len(study.axis.values)
    failed = sum(not run.steps for cell in cells.values() for run in cell.runs)
    says = (
        f"The vertical line is the paper's network and vehicle; {study.runs} runs a point. "
        f"Periodic sending at the event trigger's own rate has a smaller RMSE than the trigger at "
        f"{better} of {n} values, and a larger one at {worse} (95 % intervals do not overlap)."
    )
    if failed:
        says += f" {failed} runs without a session are left out of the means."
    rows = [
        {
            study.name: value,
            "method": method,
            "period": cell.period,
            "runs": len(cell.runs),
            "flown": sum(run.steps > 0 for run in cell.runs),
        }
        | by_name(DRAWN, cell.estimate)
        for (value, method), cell in cells.items()
    ]
    title = f"RMSE against {study.label.partition(' [')[0]}"
    return picture(figure, f"rmse-{study.name}", title, says, rows_csv(rows))


def against_periodic(study: Study, cells: Cells) -> tuple[int, int]:
    """Number of values of the parameter at which periodic sending is better than the event trigger,
    and number of values at which periodic sending is worse.
    """
    signs = [
        periodic_wins(cells[value, EVENT], cells[value, PERIODIC]) for value in study.axis.values
    ]
    return signs.count(1), signs.count(-1)


def estimates(samples: Samples) -> Plate:
    """Distribution of the error of the server's state estimate, eq. (13)."""
    shares = np.linspace(0.0, 1.0, 201)
    errors = {
        method: np.concatenate([_estimate_error(flight) for flight in flights])
        for method, (_, flights) in samples.items()
    }
    quantiles = {method: np.quantile(error, shares, axis=0) for method, error in errors.items()}
    with lettered(PAGE, 2.6, LETTERS) as figure:
        panes = figure.subplots(1, 2, sharey=True)
        for part, (plane, unit) in enumerate(zip(panes, ("m", "m/s"), strict=True)):
            for method, values in quantiles.items():
                style = {key: STYLES[method][key] for key in ("color", "linestyle")}
                plane.plot(values[:, part], shares, **style, linewidth=1.2, label=method)
            plane.set_xscale("log")
            plane.set_xlabel(f"error of the estimated {('position', 'velocity')[part]} [{unit}]")
        panes[0].set_ylabel("share of steps")
        panes[1].legend()
    medians = ", ".join(f"{np.median(error[:, 0]):.3f} m {name}" for name, error in errors.items())
    says = (
        f"‖x̂ − x‖ over {len(samples[EVENT][1])} flights each; median error of position: {medians}."
    )
    parts = ("position_m", "velocity_mps")
    header = ("share", *(f"{method}: {part}" for method in quantiles for part in parts))
    rows = np.column_stack([shares, *quantiles.values()]).tolist()
    return picture(figure, "estimate-error", "Error of the estimate", says, to_csv(header, rows))


def _estimate_error(flight: Record) -> Array:
    """‖x̂ − x‖ of position [m] and velocity [m/s] at steps for which both are recorded; shape
    (steps, 2).
    """
    _, ours, theirs = np.intersect1d(
        flight.server["step"], flight.client["step"], return_indices=True
    )
    error = flight.server["estimate"][ours] - flight.client["state"][theirs]
    norms: Array = np.linalg.norm(error, axis=1)
    return norms
