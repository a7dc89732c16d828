"""Picture of a measured path: delays over time, and their distribution."""

from typing import TYPE_CHECKING

import numpy as np

from skytether.figures.page import blank
from skytether.netem.impairments.delays import Delay
from skytether.netem.impairments.direction import impairments
from skytether.probe.outcome import ProbeOutcome
from skytether.probe.prober import TRAIN, TRAIN_SLOTS
from skytether.shared.base.units import HEADER_BYTES, SECOND_NS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS_MAX = 20_000


def drawn(*outcomes: ProbeOutcome) -> "Figure":
    """Draw for each path the delays of both directions over time, with lost packets marked, and
    their distributions.

    The best model is drawn over each distribution.
    """
    figure = blank(10.0, 5.6 * len(outcomes))
    grid = figure.subplots(2 * len(outcomes), 2, width_ratios=(5, 3))
    ways = [(outcome, name) for outcome in outcomes for name in outcome.delays]
    for (outcome, name), (over_time, shares) in zip(ways, grid, strict=True):
        delays, figures = outcome.delays[name], getattr(outcome.figures, name)
        path_name = f"{outcome.figures.listener} " if len(outcomes) > 1 else ""
        every = max(1, len(delays.time_s) // DOTS_MAX)
        time_s, delay_ms = delays.time_s[::every], 1e3 * delays.delay_s[::every]
        came = np.isfinite(delay_ms)
        over_time.plot(time_s[came], delay_ms[came], ".", markersize=2, color="tab:blue")
        lost_s = time_s[~came]
        over_time.plot(lost_s, np.zeros(len(lost_s)), "|", markersize=8, color="tab:red")
        ends = np.flatnonzero(np.diff(delays.time_s) > TRAIN_SLOTS / 2 * outcome.figures.every_s)
        for end in ends.tolist():
            over_time.axvspan(*delays.time_s[end : end + 2], color="0.9", linewidth=0)
        over_time.set_title(
            f"{path_name}{name}: {figures.sent} packets, {figures.loss:.2%} lost (red)"
            f"{f'; grey: {TRAIN} at once, to measure the rate' if len(ends) else ''}",
            fontsize=10,
            loc="left",
        )
        over_time.set_ylabel("delay [ms]")
        sorted_ms = np.sort(1e3 * delays.delay_s[delays.came])
        at = (np.arange(len(sorted_ms)) + 0.5) / len(sorted_ms)
        shares.step(sorted_ms, at, color="tab:blue", label="measured", where="post")
        if figures.delay_models:
            _, model = impairments(figures.delay_models[0].text).parts[0]
            assert isinstance(model, Delay)
            passes_s = (
                (outcome.figures.bytes + HEADER_BYTES) / figures.rate_bytes_per_s
                if figures.rate_bytes_per_s
                else 0.0
            )
            grid_of = np.linspace(0.001, 0.999, 500)
            model_ms = [
                1e3 * (model.quantile_ns(share) / SECOND_NS + passes_s) for share in grid_of
            ]
            label = figures.delay_models[0].text.partition("(")[0]
            shares.plot(model_ms, grid_of, "--", color="tab:orange", label=label)
        shares.set_title("share of packets", fontsize=10, loc="left")
        shares.legend(loc="lower right", fontsize=8)
        for axes in (over_time, shares):
            axes.grid(alpha=0.3)
    grid[-1, 0].set_xlabel("time [s]")
    grid[-1, 1].set_xlabel("delay [ms]")
    return figure
