"""Table of docs/compare.md, and that of README: `skytether compare` in the cases of the page, with
fewer flights than its default.
"""

from collections.abc import Sequence
from pathlib import Path

from bench.harness import TextTable
from skytether.lab.commands import compare
from skytether.lab.commands.pool import Flags
from skytether.lab.commands.report_folder import CommandCall
from skytether.lab.engine import contenders
from skytether.lab.engine.comparison import ComparedCase, ContenderRuns, leading

CASES = {
    "target": "the server alone sees the target, and only where it is now",
    "turns": "the same, and the target turns suddenly",
    "route": "the server sees the next 4 s",
    "bounds": "the target is nearly as fast as the vehicle",
    "loss-0.5": "half of all packets are lost",
    "burst-2": "losses come in bursts of 2 s",
    "measured": "the server measures the target with noise of 20 cm",
}
"""Cases of the page by name, and what is special about each."""
BUDGETS = (1.0, 5.0, 40.0)
README_CASES = 3
README = (
    "paper-every-step",
    "paper-event",
    "feedback-periodic",
    "feedback-gap",
    "trajectory-periodic",
    "trajectory-expected",
)
RUNS, SCOUTS, ROUNDS = 30, 8, 3
UNSHOWN = "committed-gap"
"""Contender without feedback aboard, which only the report has."""


def document_tables(folder: Path | None, flags: Flags) -> dict[str, TextTable]:
    size = contenders.ComparisonSize(
        RUNS,
        generations=1,
        cases=contenders.cases(tuple(CASES)),
        contenders=[each for each in contenders.CONTENDERS if each.name != UNSHOWN],
        scouts=SCOUTS,
        rounds=ROUNDS,
        budgets=BUDGETS,
    )
    options = compare.CompareOptions(RUNS, folder or Path("compare/document"), pool=flags)
    results, _, _ = compare.run(options, size, CommandCall.now("compare", []))
    return {"compare": choice_table(results), "readme": readme_table(results)}


def choice_table(results: Sequence[ComparedCase]) -> TextTable:
    """The paper's scheme at every step, and the best contender within each budget, by case."""
    rows = []
    for each in results:
        paper = each.bought.get(("paper-every-step", BUDGETS[-1]))
        row = [f"`{each.case.name}`: {CASES[each.case.name]}", estimate(paper) if paper else "–"]
        rows.append([*row, *(best(each, budget) for budget in BUDGETS)])
    headings = [f"≤ {budget:g}/s" for budget in BUDGETS]
    return TextTable(["your case", "paper, every step", *headings], rows)


def best(compared: ComparedCase, budget: float) -> str:
    """Contender with the least mean, and how many others are not significantly worse."""
    if not (runs := leading(compared, budget)):
        return "–"
    alike = f"; {len(runs) - 1} alike" if runs[1:] else ""
    return f"**{runs[0].what.contender.title}** {estimate(runs[0])}{alike}"


def readme_table(results: Sequence[ComparedCase]) -> TextTable:
    """Means of some contenders with their intervals, in the first cases."""
    columns = [(each, budget) for each in results[:README_CASES] for budget in BUDGETS[1:]]
    headings = [f"{each.case.name}, ≤ {budget:g}/s" for each, budget in columns]
    rows = []
    for contender in contenders.CONTENDERS:
        if contender.name not in README:
            continue
        cells = [cell(each, contender.name, budget) for each, budget in columns]
        rows.append([contender.title, *cells])
    return TextTable(["RMSE xy [m]", *headings], rows)


def cell(compared: ComparedCase, contender: str, budget: float) -> str:
    """Mean with half of its 95 % interval, in bold if no other mean is significantly smaller."""
    runs = compared.bought.get((contender, budget))
    if runs is None or not runs.values("rmse_xy"):
        return "–"
    text = estimate(runs)
    return f"**{text}**" if runs in leading(compared, budget) else text


def estimate(runs: ContenderRuns) -> str:
    """Mean RMSE xy with half of its 95 % interval."""
    mean, half = runs.estimate("rmse_xy")
    return f"{mean:.3f} ± {half or 0.0:.3f}"
