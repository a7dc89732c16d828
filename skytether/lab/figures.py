"""Pictures of sweeps, envelopes and crowds."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from skytether.figures.flights import save
from skytether.figures.page import blank
from skytether.lab.crowd import TITLES, CrowdPoint, FlownScheme, Scheme
from skytether.lab.envelope import WRONG, Envelope, EnvelopePoint, Outcome
from skytether.lab.sweep import GridAxis
from skytether.netem.impairments.direction import impairments
from skytether.shared.law.model import Array, Flags

OUTCOMES: Mapping[Outcome, Mapping[str, Any]] = {
    "refused": {"color": "0.82", "marker": "."},
    "unanswered": {"color": "0.55", "marker": "."},
    "flown": {"color": "#0072b2", "marker": "o"},
    "interrupted": {"color": "#56b4e9", "marker": "s"},
    "hovering": {"color": "#e69f00", "marker": "D"},
    "astray": {"color": "#cc79a7", "marker": "^"},
    "flyaway": {"color": "#c1272d", "marker": "X"},
    "crashed": {"color": "black", "marker": "P"},
}
RATIOS = np.geomspace(1 / 16, 16, 17)
"""Bin edges of `envelope`: length of a horizon in round trips."""


def envelope(path: Path, title: str, plan: Envelope, points: Sequence[EnvelopePoint]) -> None:
    from matplotlib.patches import Patch

    keys = list(map(plan.keys, range(len(points))))

    def column(key: str) -> Array:
        return np.array([each[key] for each in keys])

    outcomes = np.array([point.outcome for point in points])
    ways = [
        [impairments(each[f"network.{way}"]) for each in keys] for way in ("uplink", "downlink")
    ]
    up_s, down_s = (np.array([each.mean_s for each in paths]) for paths in ways)
    loss = np.max([[each.loss for each in paths] for paths in ways], axis=0)
    trip_s, covers_s = up_s + down_s, column("control.horizon") * column("control.dt")
    figure = blank(10.0, 9.0)
    (cover, bars), (delays, losses) = figure.subplots(2, 2)
    shown = {outcome: outcomes == outcome for outcome in OUTCOMES if outcome in outcomes}
    for outcome, has_outcome in shown.items():
        style: Any = {**OUTCOMES[outcome], "s": _size(outcome, len(points)), "linewidths": 0.0}
        cover.scatter(trip_s[has_outcome], covers_s[has_outcome], **style)
        long = has_outcome & (covers_s >= trip_s)
        delays.scatter(up_s[long], down_s[long], **style)
        losses.scatter(trip_s[long], loss[long], **style)
    line_s = np.geomspace(0.01, float(trip_s.max()), 100)
    cover.plot(line_s, line_s, "k-", linewidth=1.0)
    cover.set_yscale("log")
    cover.set_ylabel("length of a horizon, H · Δt [s]")
    cover.set_title("all points; above the line horizons are longer than a round trip", fontsize=10)
    losses.set_ylabel("loss, the larger of both ways")
    for plane in (delays, losses):
        plane.set_title("points with horizons longer than a round trip", fontsize=10)
    for plane in (cover, losses):
        plane.set_xlabel("mean round trip [s]")
    delays.set_xlabel("mean delay to the vehicle [s]")
    delays.set_ylabel("mean delay to the server [s]")
    delays.set_aspect("equal", adjustable="box")
    _stack(bars, covers_s / trip_s, shown)
    for plane in (cover, delays, losses):
        plane.grid(alpha=0.3)
    patches = [
        Patch(color=OUTCOMES[outcome]["color"], label=f"{outcome} {has_outcome.sum()}")
        for outcome, has_outcome in shown.items()
    ]
    figure.suptitle(title, fontsize=11)
    figure.legend(
        handles=patches,
        loc="outside lower center",
        ncols=len(patches),
        fontsize=9,
        handlelength=1.0,
    )
    save(figure, path, dpi=100)


def _size(outcome: Outcome, points: int) -> float:
    """Marker area of an outcome in a picture with `points` points [pt²]; failures stay visible."""
    area = float(np.clip(20_000.0 / points, 5.0, 30.0))
    return max(25.0, area) if outcome in WRONG else area


def _stack(plane: Any, ratios: Array, shown: Mapping[Outcome, Flags]) -> None:
    bins = np.digitize(np.clip(ratios, RATIOS[0], RATIOS[-1] * (1.0 - 1e-9)), RATIOS) - 1
    total = np.maximum(1, np.bincount(bins, minlength=len(RATIOS) - 1))
    below = np.zeros(len(total))
    for outcome, has_outcome in shown.items():
        share = np.bincount(bins[has_outcome], minlength=len(total)) / total
        style = {"color": OUTCOMES[outcome]["color"], "edgecolor": "white", "linewidth": 0.5}
        plane.bar(RATIOS[:-1], share, np.diff(RATIOS), bottom=below, align="edge", **style)
        below += share
    plane.set_xscale("log", base=2)
    plane.set_xticks(RATIOS[::4], ["1/16", "1/4", "1", "4", "16"])
    plane.set_xlim(RATIOS[0], RATIOS[-1])
    plane.set_ylim(0.0, 1.0)
    plane.axvline(1.0, color="k", linewidth=1.0)
    plane.set_xlabel("length of a horizon in round trips; the outer bars include all beyond")
    plane.set_ylabel("share of points")
    plane.set_title(
        "all points; right of the line horizons are longer than a round trip", fontsize=9
    )


UNITS = {"s": "s", "m": "m", "mps": "m/s", "mps2": "m/s²", "ppm": "ppm"}
OTHER_UNITS = {
    "duration": "s",
    "settle": "s",
    "control.dt": "s",
    "control.horizon": "steps",
    "control.delay_bound": "s",
    "control.trigger.periodic": "steps",
    "control.trigger.state_gap.decay_rate": "1/s",
    "model.u_max": "m/s",
    "vehicle.wind": "m/s per √s",
}
"""Units of the keys whose names do not end in a unit."""


def label(key: str) -> str:
    unit = OTHER_UNITS.get(key) or ("_" in key and UNITS.get(key.rsplit("_", 1)[1]))
    return f"{key} [{unit}]" if unit else key


def curve(
    path: Path, title: str, axis: GridAxis, name: str, *, means: Array, halves: Array
) -> None:
    """Draw the means of a sweep over one key, with their intervals.

    Args:
        name: label of the measured figure, with its unit.
        means: mean at each value, NaN without a value; shape (values,).
        halves: half the width of each mean's interval; shape (values,).
    """
    figure = blank(6.4, 4.4)
    plane = figure.subplots()
    places = _places(axis)
    if _is_scale(axis):
        plane.plot(places, means, "k.-")
        plane.fill_between(places, means - halves, means + halves, color="0.8", label="95 %")
    else:
        plane.errorbar(places, means, halves, fmt="ko", capsize=4, label="95 %")
        plane.set_xticks(places, list(map(str, axis.values)))
        plane.margins(x=0.2)
    plane.set_xlabel(label(axis.key))
    plane.set_ylabel(name)
    plane.legend(fontsize=8)
    plane.grid(alpha=0.3)
    plane.set_title(title, fontsize=10)
    save(figure, path, dpi=130)


def heat_map(
    path: Path, title: str, axes: tuple[GridAxis, GridAxis], name: str, *, means: Array
) -> None:
    """Draw the means of a sweep over two keys.

    Args:
        axes: horizontal axis, and vertical axis.
        name: label of the measured figure, with its unit.
        means: mean in each cell, NaN without a value; shape (values across, values up).
    """
    figure = blank(6.4, 5.0)
    plane = figure.subplots()
    across, up = axes
    mesh = plane.pcolormesh(_places(across), _places(up), means.T, shading="nearest")
    for axis, set_ticks in ((across, plane.set_xticks), (up, plane.set_yticks)):
        if not _is_scale(axis):
            set_ticks(_places(axis), list(map(str, axis.values)))
    plane.set_xlabel(label(across.key))
    plane.set_ylabel(label(up.key))
    figure.colorbar(mesh, label=name)
    plane.set_title(title, fontsize=10)
    save(figure, path, dpi=130)


SCHEME_COLOURS: Mapping[Scheme, str] = {
    "paper": "#c1272d",
    "threshold": "#e69f00",
    "budget": "#0072b2",
}


def crowd(path: Path, title: str, flown: Mapping[Scheme, FlownScheme], limit_m: float) -> None:
    """Draw error, queueing delay and loss over the number of vehicles, for each scheme.

    `limit_m` is the RMSE above which vehicles count as failed [m].
    """
    figure = blank(7.0, 8.0)
    panes = figure.subplots(3, 1, sharex=True)
    values: Sequence[tuple[str, Callable[[CrowdPoint], float | None]]] = (
        ("RMSE of all vehicles [m]", lambda p: p.rmse_m),
        ("queueing delay to a vehicle [ms]", lambda p: p.up_queueing_ms_p50),
        ("share lost on the way to a vehicle", lambda p: p.up_lost),
    )
    for pane, (label, value) in zip(panes, values, strict=True):
        for scheme, each in flown.items():
            points = [point for point in each.points if value(point) is not None]
            numbers = [point.vehicles for point in points]
            colour = SCHEME_COLOURS[scheme]
            drawn = np.array([value(point) for point in points], dtype=np.float64)
            if numbers:
                pane.plot(numbers, drawn, color=colour, linewidth=1.0, label=TITLES[scheme])
            for flies, marker in ((True, "o"), (False, "X")):
                has_outcome = [point.flies(limit_m) == flies for point in points]
                pane.scatter(
                    np.array(numbers)[has_outcome], drawn[has_outcome], color=colour, marker=marker
                )
            if pane is panes[1]:
                rare = [point.up_queueing_ms_p99 for point in points]
                pane.plot(numbers, rare, color=colour, linewidth=0.8, linestyle=":")
        pane.set_ylabel(label)
        pane.grid(alpha=0.3)
        pane.set_xscale("log", base=2)
    panes[0].axhline(limit_m, color="k", linewidth=0.8, linestyle="--")
    panes[0].set_yscale("log")
    panes[0].legend(fontsize=8)
    panes[1].set_title(
        "median, and dotted the 99 % quantile; × if the vehicles do not fly",
        fontsize=9,
    )
    panes[-1].set_xlabel("number of vehicles")
    ticks = sorted({2**i for i in range(13)} & set(range(1, _most(flown) + 1)))
    panes[-1].set_xticks(ticks, list(map(str, ticks)))
    figure.suptitle(title, fontsize=11)
    save(figure, path, dpi=110)


def _most(flown: Mapping[Scheme, FlownScheme]) -> int:
    return max(point.vehicles for each in flown.values() for point in each.points)


def _is_scale(axis: GridAxis) -> bool:
    numbers = all(type(value) in (int, float) for value in axis.values)
    return numbers and all(low < high for low, high in pairwise(axis.values))


def _places(axis: GridAxis) -> Array:
    return np.array(axis.values if _is_scale(axis) else range(len(axis.values)), dtype=np.float64)
