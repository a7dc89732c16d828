"""What comes out of a comparison of contenders: tables, ratios that are claimed, curves."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import stats

from lab import plates
from lab.contenders import CASES, CONTENDERS, PACKETS, Case, Flying, Plan
from lab.plates import Picture
from lab.report import Drawn, Table, as_interval, as_text
from lab.sweep import Estimate, Results, by_name, interval, rows_csv, to_csv
from shared.chance import stream
from shared.summary import Summary


@dataclass(frozen=True, slots=True)
class Claim:
    """A claim that one contender's RMSE xy is at most so many times another's."""

    ours: str
    """Name of the one contender."""
    theirs: str
    """Name of the other."""
    share: float | None = None
    """Largest share of steps at which ours may send; None: no more packets than theirs sends."""
    at_most: Mapping[str, float] = field(default_factory=dict)
    """Largest ratio, by case; in cases that it lacks the ratio is reported and not asked for."""


NAMES = tuple(case.name for case in CASES)
WINDY = ("wind-0.1", "wind-0.3", "gusts")
EVERY_STEP = {**dict.fromkeys(NAMES, 0.75), "quiet": 0.2}
EVENT = dict.fromkeys(NAMES, 0.35)
CLAIMS = (
    Claim("committed-gap", "paper-every-step", PACKETS, EVERY_STEP),
    Claim("committed-gap", "paper-event", at_most=EVENT),
    Claim("committed-gap", "committed-periodic", at_most=dict.fromkeys(WINDY, 0.9)),
    Claim("feedback-gap", "paper-every-step", PACKETS, EVERY_STEP),
    Claim("feedback-gap", "paper-event", at_most=EVENT),
    Claim("feedback-gap", "committed-gap"),
    Claim("paper-event", "paper-periodic"),
)


RMSE, SHARE, PACKETS_UP, BYTES = FIGURES = (
    "rmse_xy",
    "event_ratio",
    "uplink_packets_per_s",
    "total_bytes_per_s",
)
"""Figures that are compared."""


def measure(run: Summary, figure: str) -> float | None:
    """One of FIGURES of a run; None where it has not flown."""
    if run.rmse_xy is None:
        return None
    if figure == PACKETS_UP:
        return (run.uplink_packets or 0) / run.duration_s
    if figure == BYTES:
        return ((run.uplink_bytes or 0) + (run.downlink_bytes or 0)) / run.duration_s
    value: float | None = getattr(run, figure)
    return value


@dataclass(frozen=True, slots=True)
class Flown:
    """The runs of a contender in a case, at one threshold."""

    what: Flying
    """What was flown."""
    runs: Sequence[Summary]
    """Summary of each flight, by seed."""

    def estimate(self, figure: str) -> Estimate:
        """Mean of one of FIGURES, and half the width of its 95 % interval."""
        values = [measure(run, figure) for run in self.runs]
        return interval([value for value in values if value is not None])

    def mean(self, figure: str) -> float:
        """Mean of one of FIGURES; NaN where nothing has flown."""
        mean, _ = self.estimate(figure)
        return math.nan if mean is None else mean


def flown(plan: Plan, done: Results) -> list[Flown]:
    """The runs of each contender at each threshold of a plan."""
    cells = enumerate(plan.flying)
    return [Flown(each, plan.sweep.of_cell(done, cell)) for cell, each in cells]


def ratio(ours: Flown, theirs: Flown) -> tuple[float, float, float] | None:
    """Mean RMSE xy of ours over theirs, and both ends of its 95 % interval.

    The interval is a bootstrap over pairs of the same seed. The result is None where fewer than two
    seeds have flown in both.
    """
    errors = [
        (one.rmse_xy, other.rmse_xy)
        for one, other in zip(ours.runs, theirs.runs, strict=True)
        if one.rmse_xy is not None and other.rmse_xy is not None
    ]
    if len(errors) < 2:
        return None

    def of_means(one: Any, other: Any, axis: int = -1) -> Any:
        return np.mean(one, axis=axis) / np.mean(other, axis=axis)

    pair = np.array(errors, dtype=np.float64).T
    low, high = stats.bootstrap(
        pair, of_means, paired=True, method="percentile", random_state=stream(1, "bootstrap")
    ).confidence_interval
    return float(of_means(*pair)), float(low), float(high)


@dataclass(frozen=True, slots=True)
class Judged:
    """A claim, judged in a case."""

    claim: Claim
    """What is claimed."""
    case: Case
    """Case in which it is judged."""
    ours: Flown
    """Runs of our contender, at the threshold that is judged."""
    theirs: Flown
    """Runs of the other contender, at the threshold that was searched for."""
    ratio: tuple[float, float, float] | None
    """Ratio of both mean RMSE xy, with both ends of its interval; None where too little flew."""
    sparse: bool
    """Whether ours sends no more than it may."""

    @property
    def at_most(self) -> float | None:
        """Largest ratio that is asked for; None where none is."""
        return self.claim.at_most.get(self.case.name)

    @property
    def holds(self) -> bool | None:
        """Whether all of the interval is below what is asked for; None where nothing is asked."""
        if self.at_most is None:
            return None
        return self.sparse and self.ratio is not None and self.ratio[2] <= self.at_most


def judge(claim: Claim, case: Case, flown: Sequence[Flown]) -> Judged:
    """Judge a claim, with ours at the threshold that sends most of those allowed."""

    def curve(name: str) -> list[Flown]:
        return [each for each in flown if each.what.contender.name == name]

    def is_sparse(each: Flown) -> bool:
        if claim.share is not None:
            return each.mean(SHARE) <= claim.share
        return each.mean(PACKETS_UP) <= theirs.mean(PACKETS_UP)

    (theirs,) = (each for each in curve(claim.theirs) if each.what.tuned)
    ours = curve(claim.ours)
    # Thresholds rise, and packets fall with them.
    found = next(filter(is_sparse, ours), ours[-1])
    return Judged(claim, case, found, theirs, ratio(found, theirs), is_sparse(found))


Compared = Sequence[tuple[Case, Sequence[Flown]]]
"""Runs of all contenders, case by case."""


def draw(results: Compared, runs: int) -> Drawn:
    """The report of a comparison.

    Args:
        runs: number of flights of each contender in each case at each threshold.
    """
    judged = [judge(claim, case, flown) for case, flown in results for claim in CLAIMS]
    asked = [each.holds for each in judged if each.holds is not None]
    verdict = (
        f"{sum(asked)} of the {len(asked)} ratios that are asked for hold with all of their 95 % "
        "interval."
    )
    tables = [contenders_table(results, runs), ratios_table(judged), weights_table(results)]
    pictures = [curves(case, flown) for case, flown in results]
    return Drawn(TITLE, ABOUT, tables, pictures, verdict)


TITLE = "Schemes and triggers compared"
ABOUT = (
    "All fly the paper's vehicle, trajectory and network in virtual time, with the same seeds, "
    "each at the weights and threshold that were best for it in that very case. They were searched "
    "for by the same optimiser with the same effort, on other seeds."
)


def tuned(flown: Sequence[Flown]) -> list[Flown]:
    """Runs at the thresholds that a search has found."""
    return [each for each in flown if each.what.tuned]


def contenders_table(results: Compared, runs: int) -> Table:
    """Table of the figures of each contender in each case."""
    specs = {RMSE: ".4f", SHARE: ".1%", PACKETS_UP: ".2f", BYTES: ",.0f"}
    rows, lines = [], []
    for case, flown in results:
        for each in tuned(flown):
            contender = each.what.contender
            rows.append({"case": case.name, "contender": contender.name} | _row(each))
            cells = [as_interval(each.estimate(name), spec) for name, spec in specs.items()]
            lines.append((case.title, contender.title, *cells))
    failed = sum(run.rmse_xy is None for _, flown in results for each in flown for run in each.runs)
    says = (
        f"Means of {runs} flights with 95 % intervals. Bytes are UDP payload, both ways. Where a "
        f"trigger has a say in it, it was searched for with at most {PACKETS:.0%} of the steps."
    )
    if failed:
        says += f" {failed} runs never got a session and count in no mean."
    heading = ("case", "contender", "RMSE xy [m]", "steps sent", "packets up /s", "bytes /s")
    return Table("contenders", "Contenders", says, rows_csv(rows), heading, lines)


def _row(each: Flown) -> dict[str, Any]:
    """Threshold, number of runs and of those that flew, and every figure with its interval."""
    flew = sum(run.rmse_xy is not None for run in each.runs)
    counts = {"threshold": each.what.threshold, "runs": len(each.runs), "flown": flew}
    return counts | by_name(FIGURES, each.estimate)


def ratios_table(judged: Sequence[Judged]) -> Table:
    """Table of the ratios that are claimed."""
    rows, lines = [], []
    for each in judged:
        ours, theirs = each.ours.what.contender, each.theirs.what.contender
        value, low, high = each.ratio or (None, None, None)
        our_share, their_share = each.ours.mean(SHARE), each.theirs.mean(SHARE)
        rows.append(
            {
                "case": each.case.name,
                "ours": ours.name,
                "threshold": each.ours.what.threshold,
                "theirs": theirs.name,
                "ratio": value,
                "ratio_low": low,
                "ratio_high": high,
                "at_most": each.at_most,
                "holds": each.holds,
                "event_ratio_ours": our_share,
                "event_ratio_theirs": their_share,
            }
        )
        lines.append(
            (
                each.case.title,
                ours.title,
                theirs.title,
                as_text(value, ".3f"),
                f"{as_text(low, '.3f')} … {as_text(high, '.3f')}",
                as_text(each.at_most, ".2f"),
                {None: "–", True: "yes", False: "no"}[each.holds],
                as_text(our_share, ".1%"),
                as_text(their_share, ".1%"),
            )
        )
    says = (
        "Mean RMSE xy of ours over theirs, with 95 % intervals (bootstrap over pairs of the same "
        "seed). A ratio holds where all of its interval is below what is asked for, and ours sends "
        "no more packets than it may. Where it would send more at the threshold found, it flies at "
        "the next one of its curve that does not."
    )
    heading = (
        "case",
        "ours",
        "theirs",
        "ratio",
        "95 %",
        "at most",
        "holds",
        "steps sent, ours",
        "theirs",
    )
    return Table("ratios", "Ratios", says, rows_csv(rows), heading, lines)


def weights_table(results: Compared) -> Table:
    """Table of the weights and threshold of each contender in each case."""
    keys = list(
        dict.fromkeys(
            key
            for _, flown in results
            for each in tuned(flown)
            for key, value in each.what.control.items()
            if key.startswith("control.") and not isinstance(value, str)
        )
    )
    rows = [
        (case, each.what.contender, [_weights(each.what.control.get(key)) for key in keys])
        for case, flown in results
        for each in tuned(flown)
    ]
    text = to_csv(
        ("case", "contender", *keys), [(case.name, one.name, *row) for case, one, row in rows]
    )
    lines = [(case.title, one.title, *row) for case, one, row in rows]
    heading = ("case", "contender", *(key.removeprefix("control.") for key in keys))
    says = "Empty cells are those of the plant's own scenario."
    return Table("weights", "Weights and thresholds", says, text, heading, lines)


def _weights(value: Any) -> str:
    """A number, or several between commas; an empty text for None."""
    parts = () if value is None else np.atleast_1d(value)
    return ", ".join(f"{part:.4g}" for part in parts)


def curves(case: Case, flown: Sequence[Flown]) -> Picture:
    """Figure of what a packet buys in a case: RMSE xy over what each contender sends."""
    rows = [
        {"contender": each.what.contender.name, "tuned": each.what.tuned} | _row(each)
        for each in flown
    ]
    drawn = {
        contender.title: [each for each in flown if each.what.contender == contender]
        for contender in CONTENDERS
    }
    sparse = [each for each in flown if each.mean(SHARE) <= PACKETS and each.mean(RMSE) > 0.0]
    best = min(sparse, key=lambda each: each.mean(RMSE), default=None)
    says = (
        "Below and to the left is better; large markers are the thresholds that were searched for."
    )
    if best:
        says += (
            f" Of all that send at no more than {PACKETS:.0%} of the steps, the best is "
            f"“{best.what.contender.title}”: {best.mean(RMSE):.4f} m at {best.mean(SHARE):.1%}."
        )

    def bought(each: Flown) -> plates.Bought:
        rmse_m, half_m = each.estimate(RMSE)
        return plates.Bought(
            packets_per_s=each.mean(PACKETS_UP),
            bytes_per_s=each.mean(BYTES),
            rmse_m=rmse_m,
            rmse_half_m=half_m,
            tuned=each.what.tuned,
        )

    return plates.trade(
        f"trade-{case.name}",
        f"What a packet buys: {case.title}",
        says,
        {title: list(map(bought, points)) for title, points in drawn.items()},
        rows_csv(rows),
    )
