"""What comes out of a comparison of contenders: tables, ratios that are claimed, curves."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import stats

from skytether.figures.page import Table, as_text
from skytether.figures.tables import rows_csv, to_csv
from skytether.lab import plates
from skytether.lab.beside import Baselines, Floor
from skytether.lab.contenders import (
    ABOARD,
    CONTENDERS,
    PACKETS,
    Case,
    Contender,
    FlownContender,
    Plan,
)
from skytether.lab.plates import Plate
from skytether.lab.report import Drawn, as_interval
from skytether.lab.sweep import Estimate, Results, by_name, interval
from skytether.shared.base.chance import stream
from skytether.shared.telemetry.summary import Summary

PACKETS_UP, BYTES_UP = "uplink_packets_per_s", "uplink_bytes_per_s"
RMSE, SHARE = "rmse_xy", "event_ratio"
EFFORT, SATURATED = "effort_mps", "saturated"
FIGURES: Mapping[str, tuple[str, str]] = {
    RMSE: ("RMSE xy [m]", ".4f"),
    SHARE: ("steps sent", ".1%"),
    PACKETS_UP: ("packets up /s", ".2f"),
    BYTES_UP: ("bytes up /s", ",.0f"),
    "total_bytes_per_s": ("bytes /s", ",.0f"),
    EFFORT: ("effort [m/s]", ".3f"),
    SATURATED: ("at a bound", ".1%"),
    "aoi_s_mean": ("age [s]", ".2f"),
    "aoi_s_peak": ("peak age [s]", ".2f"),
    "plan_age_s_mean": ("age of plan [s]", ".2f"),
}
"""Figures that are compared, with heading and form."""


@dataclass(frozen=True, slots=True)
class Claim:
    """A claim that one contender's RMSE xy is at most so many times another's."""

    ours: str
    """Name of the one contender."""
    theirs: str
    """Name of the other."""
    limit: str = PACKETS_UP
    """Figure of which ours may spend no more: than PACKETS, where it is the share of steps that
    send, and than theirs otherwise."""
    at_most: Mapping[str, float] = field(default_factory=dict)
    """Largest ratio, by case; in cases that it lacks the ratio is reported and not asked for."""


OURS = "feedback-gap"
"""The contender for which most is claimed."""
CLAIMS = (
    Claim(OURS, "paper-every-step", SHARE, {"target": 0.5}),
    Claim(OURS, "paper-event", at_most={"target": 0.25}),
    Claim(OURS, "feedback-periodic", at_most={"target": 0.7, "turns": 0.7}),
    Claim("trajectory-expected", OURS, SHARE),
    Claim("trajectory-expected", OURS, BYTES_UP, {"target": 1.0, "turns": 1.0}),
    Claim("trajectory-expected", "paper-every-step", SHARE, {"target": 0.97, "turns": 0.85}),
    Claim("trajectory-expected", "trajectory-gap"),
    Claim("trajectory-expected", "trajectory-periodic"),
    Claim("trajectory-expected", "trajectory-every-step", SHARE),
    Claim(OURS, "paper-feedback-every-step", SHARE),
    Claim(OURS, "paper-feedback-event"),
    Claim(OURS, "committed-gap"),
    Claim("feedback-expected", OURS),
    Claim("committed-gap", "paper-every-step", SHARE),
    Claim("committed-gap", "paper-event"),
    Claim("committed-gap", "committed-periodic"),
    Claim("committed-gap", "committed-blind-gap"),
    Claim("committed-gap", "committed-deviation"),
    Claim("paper-event", "paper-periodic"),
)


def measure(run: Summary, figure: str) -> float | None:
    """One of FIGURES of a run; None where it has not flown."""
    if run.rmse_xy is None:
        return None
    up, down = run.uplink_bytes or 0, run.downlink_bytes or 0
    match figure:
        case "uplink_packets_per_s":
            return (run.uplink_packets or 0) / run.duration_s
        case "uplink_bytes_per_s":
            return up / run.duration_s
        case "total_bytes_per_s":
            return (up + down) / run.duration_s
    value: float | None = getattr(run, figure)
    return value


@dataclass(frozen=True, slots=True)
class ContenderRuns:
    """The runs of a contender in a case, at one threshold."""

    what: FlownContender
    """What was flown."""
    runs: Sequence[Summary]
    """Summary of each flight, by seed."""

    def estimate(self, figure: str) -> Estimate:
        """Mean of one of FIGURES, and half the width of its 95 % interval."""
        return interval(self.values(figure))

    def values(self, figure: str) -> list[float]:
        """One of FIGURES of every run that has it."""
        values = (measure(run, figure) for run in self.runs)
        return [value for value in values if value is not None]

    def mean(self, figure: str) -> float:
        """Mean of one of FIGURES; NaN where nothing has flown."""
        mean, _ = self.estimate(figure)
        return math.nan if mean is None else mean

    def median(self) -> float | None:
        """Median RMSE xy [m], which a few runs that went astray do not move; None of no runs."""
        values = self.values(RMSE)
        return float(np.median(values)) if values else None


@dataclass(frozen=True, slots=True)
class ComparedCase:
    """What has flown in a case."""

    case: Case
    flown: Sequence[ContenderRuns]
    """Runs of each contender at each threshold."""
    floor: Sequence[Floor] = ()
    """Points of a floor."""


def compared(plan: Plan, done: Results, beside: Baselines) -> ComparedCase:
    """What has flown of a plan, and beside it."""
    flown = [
        ContenderRuns(each, plan.sweep.of_cell(done, cell)) for cell, each in enumerate(plan.flying)
    ]
    if beside.aboard:
        flown.append(ContenderRuns(FlownContender(ABOARD, None, True, {}), beside.aboard))
    return ComparedCase(plan.case, flown, beside.floor)


def ratio(ours: ContenderRuns, theirs: ContenderRuns) -> tuple[float, float, float] | None:
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
    ours: ContenderRuns
    """Runs of our contender, at the threshold that is judged."""
    theirs: ContenderRuns
    """Runs of the other contender, at the threshold that was searched for."""
    ratio: tuple[float, float, float] | None
    """Ratio of both mean RMSE xy, with both ends of its interval; None where too little flew."""
    sparse: bool
    """Whether ours spends no more than it may."""

    @property
    def medians(self) -> float | None:
        """Ratio of both median RMSE xy; None where either has not flown."""
        ours, theirs = self.ours.median(), self.theirs.median()
        return ours / theirs if ours and theirs else None

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


def judge(claim: Claim, case: Case, flown: Sequence[ContenderRuns]) -> Judged:
    """Judge a claim, with ours at the threshold that sends most of those allowed."""

    def curve(name: str) -> list[ContenderRuns]:
        return [each for each in flown if each.what.contender.name == name]

    (theirs,) = (each for each in curve(claim.theirs) if each.what.tuned)
    most = PACKETS if claim.limit == SHARE else theirs.mean(claim.limit)

    def is_sparse(each: ContenderRuns) -> bool:
        return each.mean(claim.limit) <= most

    ours = curve(claim.ours)
    # Thresholds rise, and packets fall with them.
    found = next(filter(is_sparse, ours), ours[-1])
    return Judged(claim, case, found, theirs, ratio(found, theirs), is_sparse(found))


def draw(results: Sequence[ComparedCase]) -> Drawn:
    """The report of a comparison.

    Args:
        results: what has flown, case by case.
    """
    own = [each for each in results if not each.case.weights]
    judged = [
        judge(claim, each.case, each.flown)
        for each in own
        for claim in CLAIMS
        if {claim.ours, claim.theirs} <= {one.what.contender.name for one in each.flown}
    ]
    asked = [each.holds for each in judged if each.holds is not None]
    verdict = (
        f"{sum(asked)} of the {len(asked)} ratios that are asked for hold with all of their 95 % "
        "interval."
    )
    tables = [contenders_table(results), ratios_table(judged), weights_table(own)]
    if len(own) < len(results):
        tables.insert(1, ranks_table(results))
    pictures = list(map(curves, own))
    return Drawn(TITLE, ABOUT, tables, pictures, verdict)


TITLE = "Schemes and triggers compared"
ABOUT = (
    "What only the server knows is sent over the paper's network, in virtual time: all contenders "
    "fly with the same seeds, each at the weights and threshold that were best for it, searched "
    "for by the same optimiser with the same effort, on other seeds, and with the same limit on "
    "how much the command may change."
)


def tuned(flown: Sequence[ContenderRuns]) -> list[ContenderRuns]:
    """Runs at the thresholds that a search has found."""
    return [each for each in flown if each.what.tuned]


def _tuned(results: Sequence[ComparedCase]) -> list[tuple[Case, ContenderRuns]]:
    """Every case, with each contender at the threshold that a search has found."""
    return [(each.case, one) for each in results for one in tuned(each.flown)]


def contenders_table(results: Sequence[ComparedCase]) -> Table:
    """Table of the figures of each contender in each case."""
    rows, lines = [], []
    for case, each in _tuned(results):
        contender = each.what.contender
        rows.append({"case": case.name, "contender": contender.name} | _row(each))
        cells = [as_text(each.estimate(name)[0], form) for name, (_, form) in FIGURES.items()]
        cells[:1] = [
            as_interval(each.estimate(RMSE), FIGURES[RMSE][1]),
            as_text(each.median(), FIGURES[RMSE][1]),
        ]
        lines.append((case.title, contender.title, *cells))
    failed = sum(run.rmse_xy is None for one in results for each in one.flown for run in each.runs)
    says = (
        f"Means over the seeds, with the 95 % interval of RMSE and its median. Bytes are UDP "
        f"payload. Effort is the RMS change of the command from step to step; at a bound is the "
        f"share of steps with an input there; age is that of the newest information the vehicle "
        f"has. Where a trigger has a say in it, at most {PACKETS:.0%} of the steps sent in the "
        f"search."
    )
    if failed:
        says += f" {failed} runs never got a session and count in no mean."
    heads = [head for head, _ in FIGURES.values()]
    heading = ("case", "contender", heads[0], "median", *heads[1:])
    return Table("contenders", "Contenders", says, rows_csv(rows), heading, lines)


def _row(each: ContenderRuns) -> dict[str, Any]:
    """Threshold, number of runs and of those that flew, and every figure with its interval."""
    flew = sum(run.rmse_xy is not None for run in each.runs)
    counts = {"threshold": each.what.threshold, "runs": len(each.runs), "flown": flew}
    return counts | by_name(FIGURES, each.estimate) | {"rmse_xy_median": each.median()}


def ranks_table(results: Sequence[ComparedCase]) -> Table:
    """Table of who is the how manieth in cases that are flown at the same weights."""
    bases = {each.case.weights for each in results if each.case.weights}
    columns = [each for each in results if {each.case.name, each.case.weights} & bases]
    ranked = [(each.case, _ranked(tuned(each.flown))) for each in columns]
    rows, lines = [], []
    for each in tuned(columns[0].flown):
        contender, cells = each.what.contender, []
        for case, order in ranked:
            rank, one = next(
                (rank, one)
                for rank, one in enumerate(order, start=1)
                if one.what.contender == contender
            )
            error, share = one.estimate(RMSE)[0], one.estimate(SHARE)[0]
            cells.append(f"{rank}: {as_text(error, '.3f')} @ {as_text(share, '.0%')}")
            row = {"case": case.name, "contender": contender.name, "rank": rank}
            rows.append(row | by_name((RMSE, SHARE), one.estimate))
        lines.append((contender.title, *cells))
    says = (
        "Rank by mean RMSE xy, RMSE xy [m] @ steps sent. All fly at the weights and threshold that "
        "were found for the first of these cases: nobody has searched for the others."
    )
    heading = ("contender", *(each.case.title for each in columns))
    return Table("ranks", "Ranks where nobody has searched", says, rows_csv(rows), heading, lines)


def _ranked(flown: Sequence[ContenderRuns]) -> list[ContenderRuns]:
    """Contenders by their mean RMSE xy; those who have not flown come last."""
    return sorted(flown, key=lambda each: (math.isnan(each.mean(RMSE)), each.mean(RMSE)))


LIMITS = {SHARE: f"≤ {PACKETS:.0%}", PACKETS_UP: "packets", BYTES_UP: "bytes up"}
"""What is equal in a claim, as a reader of the report sees it."""


def ratios_table(judged: Sequence[Judged]) -> Table:
    """Table of the ratios that are claimed."""
    rows, lines = [], []
    for each in judged:
        ours, theirs = each.ours.what.contender, each.theirs.what.contender
        value, low, high = each.ratio or (None, None, None)
        our_share, their_share = each.ours.mean(SHARE), each.theirs.mean(SHARE)
        octets = each.ours.mean(BYTES_UP) / each.theirs.mean(BYTES_UP)
        medians = each.medians
        rows.append(
            {
                "case": each.case.name,
                "ours": ours.name,
                "threshold": each.ours.what.threshold,
                "theirs": theirs.name,
                "limit": each.claim.limit,
                "ratio": value,
                "ratio_low": low,
                "ratio_high": high,
                "ratio_of_medians": medians,
                "at_most": each.at_most,
                "holds": each.holds,
                "event_ratio_ours": our_share,
                "event_ratio_theirs": their_share,
                "bytes_up_ratio": octets,
            }
        )
        lines.append(
            (
                each.case.title,
                ours.title,
                theirs.title,
                LIMITS[each.claim.limit],
                as_text(value, ".3f"),
                f"{as_text(low, '.3f')} … {as_text(high, '.3f')}",
                as_text(medians, ".3f"),
                as_text(each.at_most, ".2f"),
                {None: "–", True: "yes", False: "no"}[each.holds],
                as_text(our_share, ".1%"),
                as_text(their_share, ".1%"),
                as_text(octets, ".2f"),
            )
        )
    says = (
        "Mean RMSE xy of ours over theirs, with 95 % intervals (bootstrap over pairs of the same "
        "seed), and the ratio of medians. A ratio holds where all of its interval is below what is "
        f"asked for, and ours spends no more than it may: than theirs, or {PACKETS:.0%} of the "
        "steps. It flies at the first threshold of its curve with which it does not. The last "
        "column is ours over theirs, too."
    )
    heading = (
        "case",
        "ours",
        "theirs",
        "at equal",
        "ratio",
        "95 %",
        "of medians",
        "at most",
        "holds",
        "steps sent, ours",
        "theirs",
        "bytes up",
    )
    return Table("ratios", "Ratios", says, rows_csv(rows), heading, lines)


def weights_table(results: Sequence[ComparedCase]) -> Table:
    """Table of the weights and threshold of each contender in each case."""
    keys = list(
        dict.fromkeys(
            key
            for _, each in _tuned(results)
            for key, value in each.what.control.items()
            if key.startswith("control.") and not isinstance(value, str)
        )
    )
    rows = [
        (case, each.what.contender, [_weights(each.what.control.get(key)) for key in keys])
        for case, each in _tuned(results)
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


COLOURS = ("#c1272d", "#cc79a7", "#e69f00", "#56b4e9", "0.5", "black", "#009e73")
"""Colours of the schemes, in their order."""
MARKERS = "sovD^P<*"
"""Markers of the triggers, in their order, which tell curves apart without colour."""


def _style(contender: Contender) -> tuple[str, str]:
    """Colour and marker of a contender, the same in every figure."""
    if contender is ABOARD:
        return "0.3", ""
    schemes = list(dict.fromkeys(each.scheme for each in CONTENDERS))
    triggers = list(dict.fromkeys(each.trigger for each in CONTENDERS))
    colour = COLOURS[schemes.index(contender.scheme)]
    return colour, MARKERS[triggers.index(contender.trigger)]


def curves(compared: ComparedCase) -> Plate:
    """Figure of what a packet buys in a case: RMSE xy over what each contender spends."""
    case, flown = compared.case, compared.flown
    rows = [
        {"contender": each.what.contender.name, "tuned": each.what.tuned} | _row(each)
        for each in flown
    ]
    sparse = [each for each in flown if 0.0 < each.mean(SHARE) <= PACKETS]
    best = min(sparse, key=lambda each: each.mean(RMSE), default=None)
    says = (
        "Below and to the left is better. A curve is a scheme with a trigger, at its weights; its "
        "large marker is the threshold that was searched for, with its median as a tick. Bands are "
        "95 % intervals of the mean."
    )
    if best:
        says += (
            f" Of all that send at no more than {PACKETS:.0%} of the steps, the best is "
            f"“{best.what.contender.title}”: {best.mean(RMSE):.4f} m at {best.mean(SHARE):.1%}."
        )

    def bought(each: ContenderRuns) -> plates.Bought:
        rmse_m, half_m = each.estimate(RMSE)
        return plates.Bought(
            packets_per_s=each.mean(PACKETS_UP),
            bytes_per_s=each.mean(BYTES_UP),
            effort_mps=each.mean(EFFORT),
            rmse_m=rmse_m,
            rmse_half_m=half_m,
            median_m=each.median(),
            tuned=each.what.tuned,
        )

    drawn = [
        plates.Curve(one.title, *_style(one), list(map(bought, points)))
        for one in (*CONTENDERS, ABOARD)
        if (points := [each for each in flown if each.what.contender == one])
    ]
    title = f"What a packet buys: {case.title}"
    floor = [(each.packets_per_s, each.rmse_m) for each in compared.floor if each.rmse_m > 0.0]
    if floor:
        says += (
            " The dotted line is the floor, which the ages of packets sent by a clock leave to "
            "those without feedback aboard, and to all where the target is not known ahead."
        )
    return plates.trade(f"trade-{case.name}", title, says, drawn, floor, rows_csv(rows))
