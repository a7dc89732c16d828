"""Statistics of a comparison of contenders: their runs, significant differences, claimed ratios."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from skytether.lab.engine.budgets import (
    BUDGETS,
    EVERY,
    ITS_OWN,
    SOUGHT,
    Chosen,
    FlownContender,
    Plan,
)
from skytether.lab.engine.contenders import ABOARD, CONTENDERS, Case, Contender
from skytether.lab.engine.floor import Baselines, Floor
from skytether.lab.engine.intervals import Estimate, interval, jackknife
from skytether.lab.engine.sweep import Results, Sweep
from skytether.shared.telemetry.summary import Summary

RMSE, SHARE, EFFORT = "rmse_xy", "event_ratio", "effort_mps"
PACKETS, BYTES = "packets_per_s", "bytes_per_s"
FIGURES = (
    RMSE,
    PACKETS,
    BYTES,
    "uplink_packets_per_s",
    "uplink_bytes_per_s",
    "downlink_packets_per_s",
    "downlink_bytes_per_s",
    SHARE,
    "uplink_above",
    "uplink_due",
    EFFORT,
    "saturated",
    "aoi_s_mean",
    "aoi_s_peak",
    "plan_age_s_mean",
)


@dataclass(frozen=True, slots=True)
class Claim:
    """Claim: one contender's RMSE xy is at most a given multiple of another contender's."""

    ours: str
    theirs: str
    share: float = 1.0
    """Largest number of packets, both ways, as a share of the other contender's packets."""
    at_most: Mapping[str, float] = field(default_factory=dict)
    """Largest claimed ratio by case; in other cases the ratio is only reported."""


OURS = "trajectory-expected"
"""Name of the contender that most claims are about."""
CLAIMS = (
    Claim(OURS, "paper-every-step", 0.12, {"target": 0.95, "turns": 0.8}),
    Claim(OURS, "feedback-gap", 0.5),
    Claim("feedback-gap", "paper-every-step", 0.25),
)


@dataclass(frozen=True, slots=True)
class ContenderRuns:
    """Runs of a contender in a case, at one threshold and with one reporting policy."""

    what: FlownContender
    runs: Sequence[Summary]

    def estimate(self, figure: str) -> Estimate:
        """Mean of one of FIGURES, and half the width of its 95 % interval."""
        return interval(self.values(figure))

    def values(self, figure: str) -> list[float]:
        """Values of one of FIGURES; runs that failed or have no value are left out."""
        flew = (run for run in self.runs if run.rmse_xy is not None)
        values = (getattr(run, figure) for run in flew)
        return [value for value in values if value is not None]

    def mean(self, figure: str) -> float:
        """Mean of one of FIGURES; NaN if no run has it."""
        mean, _ = self.estimate(figure)
        return math.nan if mean is None else mean

    def median(self) -> float | None:
        """Median RMSE xy [m], robust against a few failed runs; None without runs."""
        values = self.values(RMSE)
        return float(np.median(values)) if values else None


@dataclass(frozen=True, slots=True)
class ComparedCase:
    case: Case
    bought: Mapping[tuple[str, float], ContenderRuns]
    """Flights of each contender at its best point (weights, threshold and report) within each
    budget, by the contender's name and the budget [packets/s]."""
    tuned: Sequence[FlownContender] = ()
    """Each contender at the threshold that the search for weights found."""
    floor: Sequence[Floor] = ()

    @property
    def contenders(self) -> list[Contender]:
        points = (*self.tuned, *(runs.what for runs in self.bought.values()))
        found = {point.contender.name: point.contender for point in points}
        first = [each.name for each in CONTENDERS if each.name in found]
        return [found[name] for name in dict.fromkeys([*first, *found])]

    def curve(self, contender: str) -> list[ContenderRuns]:
        """Runs of a contender's chosen points by rising budget; each point occurs only once."""
        points = (self.bought.get((contender, budget)) for budget in SOUGHT)
        return list({id(each): each for each in points if each is not None}.values())


def compared(
    plan: Plan,
    chosen: Chosen,
    sweep: Sweep,
    done: Results,
    beside: Baselines,
) -> ComparedCase:
    """Collect the results of a case: flights of the chosen points, and the baselines."""
    cells = {name: cell for cell, (name,) in enumerate(sweep.cells)}
    flown = {
        point.name: ContenderRuns(point, sweep.of_cell(done, cells[point.name]))
        for point in chosen.values()
    }
    bought = {key: flown[point.name] for key, point in chosen.items()}
    if beside.aboard:
        alone = ContenderRuns(FlownContender(ABOARD, None, "", tuned=True, keys={}), beside.aboard)
        bought |= {(ABOARD.name, budget): alone for budget in BUDGETS}
    tuned = [each for each in plan.points if each.tuned and each.report in (EVERY, ITS_OWN)]
    return ComparedCase(plan.case, bought, tuned, beside.floor)


def ratio(ours: ContenderRuns, theirs: ContenderRuns) -> tuple[float, float, float] | None:
    """Ratio of our contender's mean RMSE xy to the other contender's, and the ends of its 95 %
    interval (`jackknife` of the ratio's logarithm, because a ratio is positive).

    None if fewer than two seeds succeeded with both contenders.
    """
    errors = [
        (one.rmse_xy, other.rmse_xy)
        for one, other in zip(ours.runs, theirs.runs, strict=True)
        if one.rmse_xy is not None and other.rmse_xy is not None
    ]
    if len(errors) < 2:
        return None
    value, half = jackknife(
        lambda pairs: float(np.log(np.divide(*pairs.mean(axis=0)))), np.array(errors)
    )
    return math.exp(value), math.exp(value - half), math.exp(value + half)


@dataclass(frozen=True, slots=True)
class Judged:
    claim: Claim
    case: Case
    ours: ContenderRuns
    """Runs of our contender within the largest budget that the claim allows."""
    theirs: ContenderRuns
    """Runs of the other contender within the largest budget."""
    ratio: tuple[float, float, float] | None
    """Ratio of the two mean RMSE xy, with its interval; None if too few flights succeeded."""
    sparse: bool
    """Whether our contender sends no more packets than the claim allows."""

    @property
    def medians(self) -> float | None:
        """Ratio of the two median RMSE xy; None if either contender has no runs."""
        ours, theirs = self.ours.median(), self.theirs.median()
        return ours / theirs if ours and theirs else None

    @property
    def at_most(self) -> float | None:
        """Largest claimed ratio; None if there is no claim for the case."""
        return self.claim.at_most.get(self.case.name)

    @property
    def holds(self) -> bool | None:
        """Whether interval and packets are within the claim; None without a claimed ratio."""
        if self.at_most is None:
            return None
        return self.sparse and self.ratio is not None and self.ratio[2] <= self.at_most


def judge(claim: Claim, compared: ComparedCase) -> Judged | None:
    ours, theirs = compared.curve(claim.ours), compared.curve(claim.theirs)
    if not (ours and theirs):
        return None
    most = claim.share * theirs[-1].mean(PACKETS)
    within = [each for each in ours if each.mean(PACKETS) <= most]
    chosen = within[-1] if within else ours[0]
    return Judged(
        claim, compared.case, chosen, theirs[-1], ratio(chosen, theirs[-1]), sparse=bool(within)
    )


def ranked(compared: ComparedCase, budget: float) -> list[ContenderRuns]:
    """Runs within a budget in the order of their mean RMSE xy; failed runs come last."""
    flown = [runs for (_, within), runs in compared.bought.items() if within == budget]
    return sorted(flown, key=lambda each: (math.isnan(each.mean(RMSE)), each.mean(RMSE)))


def leading(compared: ComparedCase, budget: float) -> list[ContenderRuns]:
    """Runs within a budget with the least mean RMSE xy, and the runs that do not differ from them
    significantly.
    """
    best_first = ranked(compared, budget)
    return [
        each
        for each in best_first
        if not math.isnan(each.mean(RMSE))
        and (each is best_first[0] or ((of := ratio(each, best_first[0])) and of[1] <= 1.0))
    ]
