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
RUNS, SCOUTS, ROUNDS = 60, 8, 3
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
    )
    options = compare.CompareOptions(RUNS, folder or Path("compare/document"), pool=flags)
    results, _, _ = compare.run(options, size, CommandCall.now("compare", []))
    return {f"compare {budget:g}": table(results, budget) for budget in BUDGETS}


def table(results: Sequence[ComparedCase], budget: float) -> TextTable:
    """Mean RMSE xy with half of its 95 % interval, and the median, of each contender and case."""
    best = [leading(each, budget) for each in results]
    rows = []
    for contender in contenders.CONTENDERS:
        cells = []
        for each, leaders in zip(results, best, strict=True):
            runs = each.bought.get((contender.name, budget))
            if runs is None or not runs.values("rmse_xy"):
                cells.append("–")
                continue
            mean, half = runs.estimate("rmse_xy")
            text = f"{mean:.3f} ± {half:.3f} ({runs.median():.3f})"
            cells.append(f"**{text}**" if runs in leaders else text)
        if set(cells) != {"–"}:
            rows.append([contender.title, *cells])
    return TextTable(["contender", *(f"`{each.case.name}`" for each in results)], rows)
