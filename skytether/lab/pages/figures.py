"""Pictures of sweeps."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from skytether.figures.flights import save
from skytether.figures.page import blank
from skytether.lab.engine.sweep import GridAxis
from skytether.shared.law.model import Array

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


def _is_scale(axis: GridAxis) -> bool:
    numbers = all(type(value) in (int, float) for value in axis.values)
    return numbers and all(low < high for low, high in pairwise(axis.values))


def _places(axis: GridAxis) -> Array:
    return np.array(axis.values if _is_scale(axis) else range(len(axis.values)), dtype=np.float64)
