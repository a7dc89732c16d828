"""Picture of an identification: steps over the fitted model, and residuals."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from skytether.figures.page import blank
from skytether.lab.identify.fit import GOOD, Fit, binned, differences, unit_response
from skytether.lab.identify.outcome import AXES, AxisOutcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = {True: "tab:blue", False: "tab:orange"}
WORDS = {True: "sets out", False: "stops"}


def drawn(axes: Sequence[AxisOutcome]) -> "Figure":
    """Figure with the steps of each axis over its model, scaled to height 1, and the residuals
    below.
    """
    figure = blank(4.2 * len(axes), 5.0)
    grid = figure.subplots(2, len(axes), squeeze=False, sharex="col", height_ratios=(3, 2))
    for name, axis, (above, below) in zip(AXES, axes, grid.T, strict=False):
        title = f"{name}, steps of {axis.speed:g} m/s"
        if axis.fit is not None:
            _draw(axis, axis.fit, above, below)
            gain, tau, late = axis.fit.numbers
            title += f"\ngain {gain:.2f}, τ {tau:.3g} s, θ {late:.3g} s"
        above.set_title(title, fontsize=10)
        below.set_xlabel("time from the step [s]")
        for each in (above, below):
            each.grid(alpha=0.3)
    grid[0, 0].set_ylabel("share of the step")
    grid[1, 0].set_ylabel("residual [%]")
    if any(axis.fit for axis in axes):
        first = next(n for n, axis in enumerate(axes) if axis.fit)
        grid[0, first].legend(loc="lower right", fontsize=8)
    return figure


def _draw(axis: AxisOutcome, fit: Fit, above: Any, below: Any) -> None:
    for starts in (True, False):
        colour, curves = COLOURS[starts], []
        for response in axis.responses:
            if response.starts is not starts:
                continue
            left = differences(response, fit.numbers)
            model = unit_response(response.times, fit.numbers)
            above.plot(response.times, model + left, color=colour, linewidth=0.5, alpha=0.5)
            curves.append((response.times, left))
        times, mean, _ = binned(curves)
        below.plot(times, 100.0 * mean, color=colour, label=WORDS[starts])
        model = unit_response(times, fit.numbers)
        above.plot(times, model + mean, color=colour, linewidth=1.5, label=f"{WORDS[starts]}, mean")
    end_s = max(float(each.times[-1]) for each in axis.responses)
    times = np.linspace(0.0, end_s, 500)
    above.plot(times, unit_response(times, fit.numbers), "k--", linewidth=1.2, label="model")
    for bound in (-100.0 * GOOD, 100.0 * GOOD):
        below.axhline(bound, color="0.5", linewidth=0.8, linestyle=":")
