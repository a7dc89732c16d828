"""Figures of the documents: each is measured again by its command, and compared with the number in
its page.

`figures.toml` beside this file registers them. A figure is a text of a page in which every measured
number is a placeholder, with the commands that fly for it and their seeds; or the tables that a
module of `bench` makes. The register contains no numbers: only the pages do.

`make figures` makes all of them, and continues after Ctrl-C. With --write the numbers that have
left their tolerance are corrected in the pages.
"""

import hashlib
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
import tyro

from bench.harness import TextTable, place_of, refresh
from skytether.cli.fly import FlyOptions
from skytether.lab.commands import tables
from skytether.lab.commands.machine import commit
from skytether.lab.commands.pool import Flags, crew
from skytether.lab.engine import sweep
from skytether.lab.engine.intervals import interval
from skytether.shared.base import files, toml
from skytether.shell.commandline import command

ROOT = Path(__file__).parents[1]
REGISTER = Path(__file__).with_name("figures.toml")
PLACEHOLDER = re.compile(r"\{([a-z]\w*)\.([\w.+]+)(?:([*/])([\d.]+))?\}")
"""`{NAME.FIGURE}`: mean over the seeds of a figure in the summaries of the command NAME; also `A+B`
for a sum, `.median`, `.least`, `.most`, `.half` (half of the 95 % interval), and `*100` or `/39` at
the end."""
NUMBER = r"-?\d+(?:\.\d+)?"
STATISTICS: dict[str, Any] = {"mean": np.mean, "median": np.median, "least": np.min, "most": np.max}
CHUNK = 10


class Figure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    page: str
    """Page, relative to the top folder."""
    kind: Literal["fast", "slow"] = "slow"
    """`fast`: some seconds, made by the tests as well; `slow`: by `make figures` alone."""
    minutes: float = 0.1
    """Time to make the figure on two cores; figures with shorter times are made first."""
    text: str = ""
    """Text of the page with placeholders for its numbers; any white space matches any other."""
    commands: Mapping[str, str] = {}
    """Commands by the names in the placeholders, without `skytether`, `--json` and `--seed`."""
    seeds: tuple[int, int] = (1, 1)
    module: str = ""
    """Module of `bench` whose `document_tables(folder, flags)` makes the tables."""
    tables: tuple[str, ...] = ()
    """Names of the tables in the page."""
    tolerance: float = 0.02
    """Largest relative change of a number that still counts as unchanged."""

    def pattern(self) -> re.Pattern[str]:
        literals = PLACEHOLDER.sub("\0", self.text).split("\0")
        spaced = (re.sub(r"(?:\\?\s)+", r"\\s+", re.escape(each)) for each in literals)
        return re.compile(f"({NUMBER})".join(spaced))


class Flights(NamedTuple):
    command: str
    seeds: tuple[int, ...]


class Number(NamedTuple):
    """Number of a page, and the number that was measured now."""

    written: str
    found: float

    def rounded(self) -> str:
        """Measured number with the decimals of the written number."""
        return f"{self.found:.{len(self.written.partition('.')[2])}f}"

    def is_within(self, tolerance: float) -> bool:
        written = float(self.written)
        change = abs(self.found - written)
        return self.rounded() == self.written or change <= tolerance * abs(written)


@dataclass(frozen=True, slots=True)
class Verdict:
    numbers: Sequence[Number]
    page: str
    """Text of the page with the measured numbers in place of the written ones."""


def register() -> dict[str, Figure]:
    return msgspec.convert(toml.loads(REGISTER.read_text()), dict[str, Figure])


def code() -> str:
    """Digest of all code that flies, and of its scenarios: flights of other code are not reused."""
    ours = (f"skytether/{room}" for room in ("autopilot", "quadrotor", "scenarios", "sim"))
    rooms = ("server", "client", "netem", "shared", *ours)
    sources = (
        file
        for room in rooms
        for kind in ("*.py", "*.toml")
        for file in sorted((ROOT / room).rglob(kind))
    )
    return hashlib.sha256(b"".join(file.read_bytes() for file in sources)).hexdigest()[:12]


def fly(cell: Flights) -> list[dict[str, Any]]:
    """Summaries of a command's flights, as `--json` writes them; called in a worker."""
    name, *argv = shlex.split(cell.command)
    if name == "fly":  # a batch is ten times faster than a process for each flight
        options = command.parse(FlyOptions(), argv, "skytether fly", None)
        summaries = sweep.summaries(options.scenario, options.config, cell.seeds)
        return [msgspec.to_builtins(summary) for summary in summaries]
    results = []
    for seed in cell.seeds:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "summary.json"
            line = [sys.executable, "-m", "skytether", name, *argv]
            subprocess.run(
                [*line, "--seed", str(seed), "--json", file], check=True, capture_output=True
            )
            results.append(msgspec.json.decode(file.read_bytes()))
    return results


def cells(figure: Figure) -> dict[tuple[str, int], Flights]:
    first, last = figure.seeds
    return {
        (name, seed): Flights(line, tuple(range(seed, min(seed + CHUNK, last + 1))))
        for name, line in figure.commands.items()
        for seed in range(first, last + 1, CHUNK)
    }


def statistic(runs: Sequence[Mapping[str, Any]], path: str) -> float:
    """Statistic of a figure over some summaries; see PLACEHOLDER."""
    *names, kind = path.split(".")
    if kind not in (*STATISTICS, "half"):
        names, kind = [*names, kind], "mean"
    values = []
    for run in runs:
        value: Any = run
        for name in names:
            parts = [value[each] for each in name.split("+")]
            value = sum(parts) if len(parts) > 1 else parts[0]
        values.append(np.nan if value is None else float(value))
    if kind == "half":
        return float(interval(values)[1] or np.nan)
    return float(STATISTICS[kind](np.array(values)))


def compare(figure: Figure, page: str, results: Mapping[tuple[str, int], Any]) -> Verdict:
    """Comparison of a text with the summaries of its flights.

    Raises:
        ValueError: the page does not have the text exactly once.
    """
    matches = list(figure.pattern().finditer(page))
    if len(matches) != 1:
        raise ValueError(f"{figure.page}: got {len(matches)} places with the text, expected 1")
    runs: dict[str, list[Any]] = {}
    for (name, _), summaries in results.items():
        runs.setdefault(name, []).extend(summaries)
    numbers, parts, end = list[Number](), list[str](), 0
    for group, (name, path, operator, by) in enumerate(PLACEHOLDER.findall(figure.text), 1):
        value = statistic(runs[name], path)
        factor = float(by or 1)
        number = Number(matches[0][group], value / factor if operator == "/" else value * factor)
        within = number.is_within(figure.tolerance)
        parts += page[end : matches[0].start(group)], number.written if within else number.rounded()
        numbers.append(number)
        end = matches[0].end(group)
    return Verdict(numbers, "".join(parts) + page[end:])


def compare_tables(figure: Figure, page: str, made: Mapping[str, TextTable]) -> Verdict:
    written = refresh(page, {name: made[name] for name in figure.tables})
    numbers = list[Number]()
    for name in figure.tables:
        place = place_of(name)
        before, after = (re.findall(NUMBER, place.findall(each)[0]) for each in (page, written))
        pairs = zip_longest(before, after, fillvalue="nan")
        numbers += [Number(old, float(new)) for old, new in pairs]
    unchanged = all(each.is_within(figure.tolerance) for each in numbers)
    return Verdict(numbers, page if unchanged else written)


@dataclass(frozen=True)
class FiguresOptions:
    only: tuple[str, ...] = ()
    """Figures to make, by name; all unless given."""
    fast: bool = False
    """Make only the fast figures."""
    write: bool = False
    """Correct the pages where a number has left its tolerance."""
    jobs: int | None = None
    """Number of flights at once; one per core unless given."""
    out: Path = Path("results/figures")
    """Folder of the finished flights, with one folder for each state of the code. After Ctrl-C the
    same command continues."""


def main(argv: Sequence[str]) -> None:
    options = tyro.cli(FiguresOptions, args=argv, description=__doc__)
    figures = {
        name: figure
        for name, figure in sorted(register().items(), key=lambda each: each[1].minutes)
        if name in (options.only or [name]) and (figure.kind == "fast" or not options.fast)
    }
    if unknown := set(options.only) - figures.keys():
        raise command.CommandError(f"--only: got {', '.join(sorted(unknown))}, no such figure", 2)
    cache, rows, bad = options.out / code(), list[list[str]](), 0
    for name, figure in figures.items():
        page = ROOT / figure.page
        try:
            verdict = make(figure, page, cache, Flags(options.jobs))
        except (ValueError, subprocess.CalledProcessError) as error:
            rows.append([name, figure.page, "", "", "", str(error)])
            bad += 1
            continue
        if options.write:
            files.write(page, verdict.page.encode())
        off = [each for each in verdict.numbers if not each.is_within(figure.tolerance)]
        bad += bool(off)
        for each in verdict.numbers if figure.text else off:
            moved = "has moved" if each in off else ""
            tolerance = f"{figure.tolerance:.0%}"
            rows.append([name, figure.page, each.written, each.rounded(), tolerance, moved])
        within = f"{len(verdict.numbers) - len(off)} of {len(verdict.numbers)} within"
        print(f"{name}: {within}", flush=True)
    headings = ["figure", "page", "written", "found", "tolerance", "verdict"]
    tables.show(f"{len(figures)} figures, commit {commit()}", headings, rows)
    if bad:
        raise command.CommandError(f"{bad} of {len(figures)} figures have left their tolerance", 1)


def make(figure: Figure, page: Path, folder: Path, flags: Flags) -> Verdict:
    """Make a figure, and compare it with its page; `folder` is for the finished flights.

    Raises:
        CommandError: interrupted.
        ValueError: the page does not have the figure.
    """
    if figure.module:
        module = import_module(f"bench.{figure.module}")
        new_tables = module.document_tables(folder / figure.module, flags)
        return compare_tables(figure, page.read_text(), new_tables)
    tasks = cells(figure)
    settings = {"tasks": [[*key, *each.seeds, each.command] for key, each in tasks.items()]}
    cache = folder / hashlib.sha256(msgspec.json.encode(settings)).hexdigest()[:12]
    flights = sum(len(each.seeds) for each in tasks.values())
    with crew(flags, "flying", flights, "flights") as flyers:
        kind = list[dict[str, Any]]
        results = flyers.study(fly, tasks, kind, settings, cache, size=lambda each: len(each.seeds))
    return compare(figure, page.read_text(), results)


if __name__ == "__main__":
    sys.exit(command.main(main, sys.argv[1:], "figures"))
