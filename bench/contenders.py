"""Tables of docs/compare.md: `skytether compare` in the cases of the page, with fewer flights than
its default.
"""

from collections.abc import Sequence
from pathlib import Path

from bench.harness import TextTable
from skytether.lab import contenders
from skytether.lab.commands import compare
from skytether.lab.commands.pool import Flags
from skytether.lab.commands.report_folder import CommandCall
from skytether.lab.comparison import ComparedCase, leading

CASES = ("target", "turns", "route", "bounds", "loss-0.5", "burst-2", "measured")
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
        cases=contenders.cases(CASES),
        contenders=[each for each in contenders.CONTENDERS if each.name != UNSHOWN],
        scouts=SCOUTS,
        rounds=ROUNDS,
        budgets=BUDGETS,
    )
    options = compare.CompareOptions(RUNS, folder or Path("compare/document"), pool=flags)
    results, _, _ = compare.run(options, size, CommandCall.now("compare", []))
    made = {f"compare {budget:g}": table(results, budget) for budget in BUDGETS}
    return made | {"readme": readme_table(results)}


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


def cell(compared: ComparedCase, contender: str, budget: float, *, has_median: bool = False) -> str:
    """Mean with half of its 95 % interval, in bold if no other mean is significantly smaller."""
    runs = compared.bought.get((contender, budget))
    if runs is None or not runs.values("rmse_xy"):
        return "–"
    mean, half = runs.estimate("rmse_xy")
    text = f"{mean:.3f} ± {half or 0.0:.3f}" + (f" ({runs.median():.3f})" if has_median else "")
    return f"**{text}**" if runs in leading(compared, budget) else text


def table(results: Sequence[ComparedCase], budget: float) -> TextTable:
    """Mean RMSE xy with half of its 95 % interval, and the median, of each contender and case."""
    rows = []
    for contender in contenders.CONTENDERS:
        cells = [cell(each, contender.name, budget, has_median=True) for each in results]
        if set(cells) != {"–"}:
            rows.append([contender.title, *cells])
    return TextTable(["contender", *(f"`{each.case.name}`" for each in results)], rows)
