"""Tables, verdict and curves of a comparison of contenders."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from skytether.figures.page import Cell, Row, Table, as_text, lettered, table_of
from skytether.figures.tables import rows_csv, to_csv
from skytether.lab.engine.budgets import BUDGETS
from skytether.lab.engine.comparison import (
    BYTES,
    CLAIMS,
    EFFORT,
    FIGURES,
    OURS,
    PACKETS,
    RMSE,
    ComparedCase,
    ContenderRuns,
    Judged,
    judge,
    leading,
    ranked,
    ratio,
)
from skytether.lab.engine.contenders import ABOARD, CASES, CONTENDERS, Contender
from skytether.lab.engine.sweep import by_name
from skytether.lab.pages import plates
from skytether.lab.pages.plates import Plate
from skytether.lab.pages.report import Drawn


def draw(results: Sequence[ComparedCase]) -> Drawn:
    own = [each for each in results if not each.case.weights]
    judged = [found for each in results for claim in CLAIMS if (found := judge(claim, each))]
    asked = [each.holds for each in judged if each.holds is not None]
    flights = min((len(each.ours.runs) for each in judged), default=0)
    if flights < FLIGHTS_MIN:
        verdict = (
            f"A first look: {flights} flights of each contender tell little. The claimed ratios "
            f"are judged from {FLIGHTS_MIN} flights on."
        )
    else:
        verdict = (
            f"{sum(asked)} of the {len(asked)} claimed ratios hold over their whole 95 % interval."
        )
    tables = [
        budgets_table(results),
        leaders_table(results),
        ratios_table(judged),
        weights_table(own),
    ]
    return Drawn(TITLE, ABOUT, tables, list(map(curves, results)), verdict, figures_first=True)


FLIGHTS_MIN = 10
"""Smallest number of flights for which claimed ratios are judged."""
TITLES = {each.name: each.title for each in CONTENDERS}
CASE_TITLES = {each.name: each.title for each in CASES}
TITLE = "Schemes and triggers compared"
ABOUT = (
    "Flights over the paper's network in virtual time; the reference is known to the server only. "
    "All contenders fly with the same seeds, each with its own best weights, found by the same "
    "optimiser with the same effort on other seeds, and with the same limit on changes of the "
    "command. Packets and bytes are those of both directions, with heartbeats and 28 B of IP and "
    "UDP headers a packet."
)


UNDECIDED = "too few flights to tell"
SIMILAR = 2 / 3
"""Largest share of contenders marked as equal to the best; if more are equal, none is marked.
"""


def budgets_table(results: Sequence[ComparedCase]) -> Table:
    rows: list[dict[str, Any]] = []
    lines: list[tuple[str, ...]] = []
    bold, own = [], []
    for each in results:
        best = {budget: leading(each, budget) for budget in BUDGETS}
        alike = {budget for budget in BUDGETS if not _is_distinct(each, budget)}
        for contender in each.contenders:
            if contender.keys:
                own.append(len(lines))
            cells = []
            for column, budget in enumerate(BUDGETS, start=2):
                runs = each.bought.get((contender.name, budget))
                if runs is None:
                    cells.append("–")
                    continue
                named = {"case": each.case.name, "contender": contender.name, "budget": budget}
                rows.append(named | _row(runs) | {"best": runs in best[budget]})
                mean, half, median = (
                    as_text(value, ".4f") for value in (*runs.estimate(RMSE), runs.median())
                )
                text = f"{mean} ± {half} ({median}) @ {as_text(runs.mean(PACKETS), '.1f')}"
                text += "!" if runs.mean(PACKETS) > budget else ""
                is_marked = runs in best[budget] and budget not in alike
                cells.append(f"{text} *" if is_marked else text)
                if is_marked and runs is best[budget][0]:
                    bold.append((len(lines), column))
            lines.append((each.case.title, contender.title, *cells))
        if alike:
            notes = (UNDECIDED if budget in alike else "" for budget in BUDGETS)
            lines.append((each.case.title, "which is best", *notes))
    says = (
        "Mean RMSE xy [m] with its 95 % interval, and median, @ packets a second. Within a budget "
        "each contender flies at the threshold and with the reporting policy that had the smallest "
        "error on other seeds. The smallest mean is bold; * marks it, and means that do not differ "
        "from it significantly: the interval of their ratio on the same seeds contains 1. Where "
        f"that is so for nearly all, there are {UNDECIDED}, and none is marked. ! marks what has "
        "sent more than the budget, which was kept on the other seeds. – means that no "
        "flown setting was within the budget and the case's limit on effort. The CSV has bytes and "
        "all other figures."
    )
    flown = {id(runs): runs for each in results for runs in each.bought.values()}.values()
    failed = sum(run.rmse_xy is None for each in flown for run in each.runs)
    if failed:
        says += f" {failed} runs without a session are left out of the means."
    heading = ("case", "contender", *(f"≤ {budget:g}/s" for budget in BUDGETS))
    title = "Error within each budget of packets"
    return Table("budgets", title, says, rows_csv(rows), heading, lines, bold, own)


def _is_distinct(compared: ComparedCase, budget: float) -> bool:
    """Whether the flights suffice to distinguish the best contenders within a budget."""
    flown = sum(not math.isnan(each.mean(RMSE)) for each in ranked(compared, budget))
    return flown < 2 or len(leading(compared, budget)) <= SIMILAR * flown


def leaders_table(results: Sequence[ComparedCase]) -> Table:
    rows = []
    titles = {one.name: one.title for each in results for one in each.contenders}
    for each in results:
        for budget in BUDGETS:
            for name in (OURS, *(one.name for one in each.contenders if one.keys)):
                ours = each.bought.get((name, budget))
                others = [
                    runs
                    for runs in ranked(each, budget)
                    if runs is not ours and runs.what.contender is not ABOARD
                ]
                if ours is not None and others:
                    other = {
                        "best_other": others[0].what.contender.name,
                        "rmse_xy_other": others[0].mean(RMSE),
                    }
                    about = {"case": each.case.name, "budget": budget, "contender": name}
                    about |= {"rmse_xy": ours.mean(RMSE)}
                    rows.append(about | other | _ratio_row(ratio(ours, others[0])))
    says = (
        f"Mean RMSE xy of “{TITLES[OURS]}”, and of each contender of your own, divided by that of "
        "the best other contender within the same budget, with its 95 % interval."
    )
    shown: dict[str, Cell] = {
        "case": lambda row: CASE_TITLES[row["case"]],
        "budget": lambda row: f"≤ {row['budget']:g}/s",
        "contender": lambda row: titles[row["contender"]],
        "RMSE xy [m]": ("rmse_xy", ".4f"),
        "best of the others": lambda row: titles[row["best_other"]],
        "its RMSE xy [m]": ("rmse_xy_other", ".4f"),
        "ratio": ("ratio", ".3f"),
        "95 %": _ratio_span,
    }
    own = [at for at, row in enumerate(rows) if row["contender"] != OURS]
    return table_of("leaders", "At equal packets", says, rows, shown, own)


def _ratio_row(found: tuple[float, float, float] | None) -> dict[str, float | None]:
    """CSV cells of a ratio and the ends of its interval; empty without a ratio, see `ratio`."""
    return dict(zip(("ratio", "ratio_low", "ratio_high"), found or (None,) * 3, strict=True))


def _ratio_span(row: Row) -> str:
    return f"{as_text(row['ratio_low'], '.3f')} … {as_text(row['ratio_high'], '.3f')}"


def _row(each: ContenderRuns) -> dict[str, Any]:
    flew = sum(run.rmse_xy is not None for run in each.runs)
    counts = {
        "threshold": each.what.threshold,
        "report": each.what.report,
        "runs": len(each.runs),
        "flown": flew,
    }
    return counts | by_name(FIGURES, each.estimate) | {"rmse_xy_median": each.median()}


def ratios_table(judged: Sequence[Judged]) -> Table:
    rows = []
    for each in judged:
        packets, octets = (each.ours.mean(of) / each.theirs.mean(of) for of in (PACKETS, BYTES))
        rows.append(
            {
                "case": each.case.name,
                "ours": each.claim.ours,
                "theirs": each.claim.theirs,
                "share": each.claim.share,
                **_ratio_row(each.ratio),
                "ratio_of_medians": each.medians,
                "at_most": each.at_most,
                "holds": each.holds,
                "packets_ratio": packets,
                "bytes_ratio": octets,
            }
        )
    says = (
        "Mean RMSE xy of ours over theirs, with 95 % intervals (jackknife over seeds), and the "
        "ratio of medians. Theirs has no limit on packets, ours at most a share of theirs; the "
        "columns packets and bytes are the ratios of what was sent. A claim holds if the whole "
        "interval is below the claimed ratio."
    )
    shown: dict[str, Cell] = {
        "case": lambda row: CASE_TITLES[row["case"]],
        "ours": lambda row: TITLES[row["ours"]],
        "theirs": lambda row: TITLES[row["theirs"]],
        "ratio": ("ratio", ".3f"),
        "95 %": _ratio_span,
        "of medians": ("ratio_of_medians", ".3f"),
        "at most": ("at_most", ".2f"),
        "holds": lambda row: {None: "–", True: "yes", False: "no"}[row["holds"]],
        "share": lambda row: f"≤ {row['share']:.0%}",
        "packets": ("packets_ratio", ".1%"),
        "bytes": ("bytes_ratio", ".1%"),
    }
    return table_of("ratios", "With a share of the packets", says, rows, shown)


def weights_table(results: Sequence[ComparedCase]) -> Table:
    flown = [(each.case, point) for each in results for point in each.tuned]
    keys = list(
        dict.fromkeys(
            key
            for _, point in flown
            for key, value in point.keys.items()
            if key.startswith("control.") and not isinstance(value, str)
        )
    )
    rows = [
        (case, point.contender, [_weights(point.keys.get(key)) for key in keys])
        for case, point in flown
    ]
    text = to_csv(
        ("case", "contender", *keys), [(case.name, one.name, *row) for case, one, row in rows]
    )
    lines = [(case.title, one.title, *row) for case, one, row in rows]
    heading = ("case", "contender", *(key.removeprefix("control.") for key in keys))
    says = "An empty cell has the value of the case's own scenario."
    own = [at for at, (_, one, _) in enumerate(rows) if one.keys]
    return Table("weights", "Weights and thresholds", says, text, heading, lines, own=own)


def _weights(value: Any) -> str:
    """Text of a weight, or of several weights with commas; empty for None."""
    parts = () if value is None else np.atleast_1d(value)
    return ", ".join(f"{part:.4g}" for part in parts)


SPENT = {
    PACKETS: "packets /s, both ways",
    BYTES: "bytes /s, both ways",
    EFFORT: "effort [m/s]",
}
COLOURS = ("#c1272d", "0.5", "black", "#009e73")
MARKERS = "sovD^P<*"
"""Markers of the triggers, in order, so that curves can be told apart without colour."""
USER_COLOURS = ("#0072b2", "#e69f00", "#cc79a7", "#56b4e9")
USER_MARKERS = "Xhdp>"


def _style(contender: Contender, users: Sequence[Contender]) -> tuple[str, str]:
    """Colour and marker of a contender in all figures; `users` are the user's contenders."""
    if contender is ABOARD:
        return "0.3", ""
    if contender.keys:
        index = users.index(contender)
        return USER_COLOURS[index % len(USER_COLOURS)], USER_MARKERS[index % len(USER_MARKERS)]
    schemes = list(dict.fromkeys(each.scheme for each in CONTENDERS))
    triggers = list(dict.fromkeys(each.trigger for each in CONTENDERS))
    colour = COLOURS[schemes.index(contender.scheme)]
    return colour, MARKERS[triggers.index(contender.trigger)]


def curves(compared: ComparedCase) -> Plate:
    case = compared.case
    rows = [
        {"contender": name, "budget": budget} | _row(runs)
        for (name, budget), runs in compared.bought.items()
    ]
    says = (
        "Lower and further left is better. A curve is a scheme with a trigger; each point is its "
        "mean within a budget of packets, with the median as a tick. Bands are 95 % intervals of "
        "the mean."
    )

    title = f"Error over packets: {case.title}"
    floor = [(each.packets_per_s, each.rmse_m) for each in compared.floor if each.rmse_m > 0.0]
    if floor:
        says += (
            " The dotted line, over uplink packets only, is a lower bound of the error for packets "
            "sent at fixed times: for schemes without feedback aboard, and for all schemes if the "
            "target is not known ahead."
        )
    with lettered(plates.PAGE, 5.0, plates.LETTERS) as figure:
        panes = figure.subplots(1, 3, sharey=True)
        users = [each for each in compared.contenders if each.keys]
        for contender in compared.contenders:
            if points := compared.curve(contender.name):
                _draw_curve(panes, contender, points, _style(contender, users))
        if floor:
            panes[0].plot(*zip(*floor, strict=True), color="0.3", linestyle=":", label="floor")
        for plane, (spent, label) in zip(panes, SPENT.items(), strict=True):
            plane.set_yscale("log")
            if spent != EFFORT:
                plane.set_xscale("log")
                plane.xaxis.set_minor_formatter("")  # minor tick labels would overlap
            plane.set_xlabel(label)
        panes[0].set_ylabel("RMSE xy [m]")
        handles, labels = panes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=7)
    return plates.picture(figure, f"trade-{case.name}", title, says, rows_csv(rows))


def _draw_curve(
    panes: Sequence[Any],
    contender: Contender,
    points: Sequence[ContenderRuns],
    style: tuple[str, str],
) -> None:
    """Draw the RMSE of a contender over each figure of SPENT, with 95 % bands.

    A contender that sends no packets is a horizontal line.
    """
    flown = [each for each in points if each.values(RMSE)]
    rmse, half = np.array([each.estimate(RMSE) for each in flown], np.float64).reshape(-1, 2).T
    half = np.nan_to_num(half)
    median = np.array([each.median() for each in flown], np.float64)
    low = np.maximum(rmse - half, 0.5 * rmse)  # a logarithmic axis cannot show 0
    colour, marker = style
    size, width, above = (7, 2.0, 3.0) if contender.keys else (4, 0.8, 2.0)
    if flown and not flown[0].mean(PACKETS):
        for plane in panes:
            plane.axhline(rmse[0], color=colour, linestyle="--", label=contender.title)
        return
    dots: Any = {"color": colour, "linestyle": "none", "zorder": above}
    for plane, spent in zip(panes, SPENT, strict=True):
        cost = np.array([each.mean(spent) for each in flown], np.float64)
        plane.plot(cost, rmse, **dots, marker=marker, markersize=size, label=contender.title)
        plane.plot(cost, median, **dots, marker="_", markersize=7)
        if spent == EFFORT:
            continue  # no line: effort may rise or fall with the threshold
        plane.plot(cost, rmse, color=colour, linewidth=width, zorder=above)
        plane.fill_between(cost, low, rmse + half, color=colour, alpha=0.2, linewidth=0)
