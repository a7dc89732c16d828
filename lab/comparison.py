"""What a comparison of contenders says: tables, ratios that are claimed, curves."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import stats

from lab import plates
from lab.contenders import CASES, CONTENDERS, PACKETS, Case, Flying, Plan
from lab.plates import Picture
from lab.report import Drawn, Table, as_text
from lab.sweep import Done, interval, to_csv
from shared.chance import stream
from shared.summary import Summary


@dataclass(frozen=True, slots=True)
class Claim:
    """That one contender's RMSE xy is at most so many times another's."""

    ours: str
    theirs: str
    share: float | None = None
    """Most steps at which ours may send; unless given, it may send no more packets than theirs."""
    at_most: Mapping[str, float] = field(default_factory=dict)
    """By case; where it has none, it is told and not asked for."""


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
    *("rmse_xy", "event_ratio"),
    *("uplink_packets_per_s", "total_bytes_per_s"),
)


def measure(run: Summary, figure: str) -> float | None:
    """One of FIGURES; None of a run that has not flown."""
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
    runs: Sequence[Summary]

    def estimate(self, figure: str) -> tuple[float | None, float | None]:
        """Mean of one of FIGURES, and half the width of its 95 % interval."""
        values = [measure(run, figure) for run in self.runs]
        return interval([value for value in values if value is not None])

    def mean(self, figure: str) -> float:
        """Not a number where none has flown."""
        mean, _ = self.estimate(figure)
        return math.nan if mean is None else mean


def flown(plan: Plan, done: Mapping[tuple[int, int], Done]) -> list[Flown]:
    """What came of a plan."""
    cells = enumerate(plan.flying)
    return [Flown(each, plan.sweep.of_cell(done, cell)) for cell, each in cells]


def ratio(ours: Flown, theirs: Flown) -> tuple[float, float, float] | None:
    """Mean RMSE xy of ours over theirs, seed by seed, and its 95 % interval (bootstrap).

    None where fewer than two seeds have flown in both.
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
    """A claim in a case."""

    claim: Claim
    case: Case
    ours: Flown
    theirs: Flown
    ratio: tuple[float, float, float] | None
    sparse: bool
    """Whether ours sends as little as it has to."""

    @property
    def at_most(self) -> float | None:
        """What is asked for."""
        return self.claim.at_most.get(self.case.name)

    @property
    def holds(self) -> bool | None:
        """Whether all of the interval is below what is asked for; None where nothing is."""
        if self.at_most is None:
            return None
        return self.sparse and self.ratio is not None and self.ratio[2] <= self.at_most


def judge(claim: Claim, case: Case, flown: Sequence[Flown]) -> Judged:
    """A claim, with ours at the threshold that sends most without sending more than it may."""

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


Results = Sequence[tuple[Case, Sequence[Flown]]]


def draw(results: Results, runs: int) -> Drawn:
    """All tables and figures.

    Args:
        runs: of each contender, case and threshold.
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
    """The contenders at the thresholds that a search has found."""
    return [each for each in flown if each.what.tuned]


def contenders_table(results: Results, runs: int) -> Table:
    """What each came to in each case."""
    header = ("case", "contender", *_HEADER)
    rows, lines = [], []
    specs = (".4f", ".1%", ".2f", ",.0f")
    for case, flown in results:
        for each in tuned(flown):
            found = [each.estimate(figure) for figure in FIGURES]
            rows.append([case.name, each.what.contender.name, *_row(each)])
            cells = [
                f"{as_text(mean, spec)} ± {as_text(half, spec)}"
                for (mean, half), spec in zip(found, specs, strict=True)
            ]
            lines.append((case.title, each.what.contender.title, *cells))
    failed = sum(run.rmse_xy is None for _, flown in results for each in flown for run in each.runs)
    says = (
        f"Means of {runs} flights with 95 % intervals. Bytes are UDP payload, both ways. Where a "
        f"trigger has a say in it, it was searched for with at most {PACKETS:.0%} of the steps."
    )
    if failed:
        says += f" {failed} runs never got a session and count in no mean."
    heading = ("case", "contender", "RMSE xy [m]", "steps sent", "packets up /s", "bytes /s")
    return Table("contenders", "Contenders", says, to_csv(header, rows), heading, lines)


_HEADER = (
    *("threshold", "runs", "flown"),
    *(name for figure in FIGURES for name in (figure, f"{figure}_ci95")),
)


def _row(each: Flown) -> list[Any]:
    """Threshold, runs, those that flew, and every figure with its interval."""
    flew = sum(run.rmse_xy is not None for run in each.runs)
    pairs = [part for figure in FIGURES for part in each.estimate(figure)]
    return [each.what.threshold, len(each.runs), flew, *pairs]


def ratios_table(judged: Sequence[Judged]) -> Table:
    """What was claimed."""
    header = (
        *("case", "ours", "threshold", "theirs", "ratio", "ratio_low", "ratio_high", "at_most"),
        *("holds", "event_ratio_ours", "event_ratio_theirs"),
    )
    rows, lines = [], []
    for each in judged:
        ours, theirs = each.ours.what.contender, each.theirs.what.contender
        found = each.ratio or (None, None, None)
        shares = [side.mean(SHARE) for side in (each.ours, each.theirs)]
        rows.append(
            (
                *(each.case.name, ours.name, each.ours.what.threshold, theirs.name, *found),
                *(each.at_most, each.holds, *shares),
            )
        )
        value, low, high = (as_text(part, ".3f") for part in found)
        lines.append(
            (
                *(each.case.title, ours.title, theirs.title, value, f"{low} … {high}"),
                *(as_text(each.at_most, ".2f"), {None: "–", True: "yes", False: "no"}[each.holds]),
                *(as_text(share, ".1%") for share in shares),
            )
        )
    says = (
        "Mean RMSE xy of ours over theirs, with 95 % intervals (bootstrap over pairs of the same "
        "seed). A ratio holds where all of its interval is below what is asked for, and ours sends "
        "no more packets than it may. Where it would at the threshold found, it flies at the next "
        "one of its curve that does not."
    )
    heading = (
        *("case", "ours", "theirs", "ratio", "95 %", "at most", "holds"),
        *("steps sent, ours", "theirs"),
    )
    return Table("ratios", "Ratios", says, to_csv(header, rows), heading, lines)


def weights_table(results: Results) -> Table:
    """What each flies at."""
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
    says = "Where nothing stands, it is the plant's own."
    return Table("weights", "Weights and thresholds", says, text, heading, lines)


def _weights(value: Any) -> str:
    """A number, or several, and nothing for none."""
    parts = () if value is None else np.atleast_1d(value)
    return ", ".join(f"{part:.4g}" for part in parts)


def curves(case: Case, flown: Sequence[Flown]) -> Picture:
    """What a packet buys in a case."""
    header = ("contender", "tuned", *_HEADER)
    rows = [[each.what.contender.name, each.what.tuned, *_row(each)] for each in flown]
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
    return plates.trade(
        f"trade-{case.name}",
        f"What a packet buys: {case.title}",
        says,
        {
            title: [
                plates.Bought(
                    *(each.mean(PACKETS_UP), each.mean(BYTES), *each.estimate(RMSE)),
                    each.what.tuned,
                )
                for each in points
            ]
            for title, points in drawn.items()
        },
        header,
        rows,
    )
