"""Runs all benchmarks, one after the other; writes the figures to results.json and docs/.

With --only, the figures of the other benchmarks are kept.
"""

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import tyro

from bench import (
    environments,
    flood,
    link,
    motions,
    netem,
    program,
    restarts,
    solvers,
    starting,
    tick,
)
from bench.harness import CONSOLE, TextTable, machine, refresh
from skytether.shared.base import files

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).with_name("results.json")
DOCUMENT = ROOT / "docs" / "performance.md"
Section = Literal[
    "netem",
    "program",
    "solvers",
    "tick",
    "motions",
    "link",
    "flood",
    "restarts",
    "starting",
    "environments",
]
SECTIONS: dict[Section, ModuleType] = {
    "netem": netem,
    "program": program,
    "solvers": solvers,
    "tick": tick,
    "motions": motions,
    "link": link,
    "flood": flood,
    "restarts": restarts,
    "starting": starting,
    "environments": environments,
}

LACKS: dict[Section, Callable[[], str]] = {"program": program.missing}
"""Functions that say what a machine lacks for a benchmark."""


@dataclass(frozen=True)
class BenchmarkOptions:
    only: tuple[Section, ...] = tuple(SECTIONS)
    """Benchmarks to run."""
    quick: bool = False
    """Run all benchmarks in three minutes with few repetitions, and write nothing."""


def main() -> int:
    options = tyro.cli(BenchmarkOptions, prog="python -m bench", description=__doc__)
    for name in options.only:
        section = SECTIONS[name]
        CONSOLE.rule(name)
        if name in LACKS and (lack := LACKS[name]()):
            CONSOLE.print(f"left out: {lack}")
            continue
        figures = section.measure(section.QUICK if options.quick else section.FULL)
        for title, table in section.tables(figures).items():
            table.show(title)
        if not options.quick:
            write({name: {"machine": machine(), **figures}})
    return 0


def write(
    results: Mapping[str, Any],
    file: Path = RESULTS,
    document: Path = DOCUMENT,
    folder: Path = DOCUMENT.parent,
) -> None:
    """Merge new figures with those of other sections; write the tables that the document has.

    Args:
        results: measured figures, by section.
        document: document with a place for each table.
        folder: folder for pictures.
    """
    if "tick" in results:
        tick.draw(results["tick"], folder / tick.FIGURE.name)
    all_results = {**(json.loads(file.read_text()) if file.exists() else {}), **results}
    merged: dict[Section, Any] = {
        name: all_results[name] for name in SECTIONS if name in all_results
    }
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(each)}" for name, each in merged.items())
    files.write(file, f"{{{lines}}}\n".encode())
    tables = {"machine": machines(merged)}
    for name, figures in merged.items():
        tables |= SECTIONS[name].tables(figures)
    files.write(document, refresh(document.read_text(), tables).encode())


def machines(results: Mapping[Section, Any]) -> TextTable:
    """Table of machine, commit and date of each group of sections, and the lateness of sleeps."""
    alike: dict[tuple[str, ...], list[Section]] = {}
    for name, figures in results.items():
        on = figures["machine"]
        where = f"{on['cores']} x {on['cpu']}, Python {on['python']}"
        alike.setdefault((where, on["commit"] or "", on["date"]), []).append(name)
    rows = []
    for place, names in alike.items():
        late_ms = [results[name]["wake"]["p99_ms"] for name in names if "wake" in results[name]]
        worst = f"{max(late_ms):.2f}" if late_ms else ""
        rows.append([", ".join(names), *place, worst])
    headings = ["measured", "on", "commit", "date", "wakes late, largest p99 [ms]"]
    return TextTable(headings, rows)


if __name__ == "__main__":
    sys.exit(main())
