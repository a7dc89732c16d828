"""Benchmark of a policy on another machine: openpi's client and server alone, LeRobot's and DRTC's
rules, and `skytether policy`.

Over real UDP and TCP, the robot program and `policy join` run within `skytether netem run`; the
policy server and `policy serve` run beside it. TCP has Linux at both ends, see
`bench.policies.wire`. The systems are described in `bench.policies.robot`. In virtual time, the
same policies run with `skytether.policy.virtual.Emulated` and `skytether.gym.Networked`. Bounds:
`oracle`, a chunk at each step without delay, and `nothing sent` after the first chunk.

After Ctrl-C, the same command with the same `--out FOLDER` continues.
"""

import sys
import time
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import tyro
from numpy.typing import NDArray

from bench.harness import TextTable, machine
from bench.policies.real import fly_real, serving
from bench.policies.runs import (
    BOUNDS,
    NETWORKS,
    OF_BOUNDS,
    REAL,
    VIRTUAL,
    Cell,
    Result,
    seconds_of,
)
from bench.policies.tasks import TASKS
from bench.policies.virtual import fly_virtual
from skytether.lab.commands.pool import Crew, Flags, study, writing
from skytether.lab.engine.intervals import interval
from skytether.shared.base import files
from skytether.shell.commandline import command, terminal

STARTS_S = 2.5
"""Time of a run over a real network, besides the flight [s]."""


@dataclass(frozen=True)
class PoliciesOptions:
    tasks: tuple[str, ...] = tuple(TASKS)
    systems: tuple[str, ...] = (*BOUNDS, *VIRTUAL, *REAL)
    networks: tuple[str, ...] = tuple(NETWORKS)
    seeds: int = 50
    """Number of seeds, from 1 on."""
    seconds: float | None = None
    """Duration of a run [s]; by default 10, and 20 for PushT."""
    together: int = 8
    """Number of runs over a real network at a time."""
    out: Path | None = None
    """Folder for the results: after Ctrl-C, or with more seeds, the same command continues. Tables,
    figures and a picture are written there, too."""
    quick: bool = False
    """Two minutes: one seed, two tasks, three networks, runs of 5 s."""


def cells(options: PoliciesOptions) -> list[Cell]:
    """Cells seed by seed, so that an interrupted benchmark has all of them."""
    rows = [
        (task, network, system)
        for task in options.tasks
        for network in options.networks
        for system in options.systems
        if system not in BOUNDS
    ]
    rows += [(t, OF_BOUNDS, s) for t in options.tasks for s in options.systems if s in BOUNDS]
    return [Cell(*row, seed) for seed in range(1, options.seeds + 1) for row in rows]


def measure(options: PoliciesOptions) -> list[Result]:
    every = cells(options)
    real = [cell for cell in every if cell.system in REAL]
    # Runs of all kinds beside each other, so that the load is even.
    order = np.random.default_rng(1).permutation(len(real) // options.seeds)
    real = [real[at + i] for at in range(0, len(real), len(order) or 1) for i in order]
    virtual = [cell for cell in every if cell.system not in REAL]
    settings = {"seconds": options.seconds or 0.0}
    flown_s = sum(seconds_of(cell, options.seconds) + STARTS_S for cell in real) / options.together
    print(
        f"{len(virtual)} runs in virtual time; {len(real)} over a real network, "
        f"{flown_s / 60:.0f} min",
        flush=True,
    )

    def part(name: str) -> Path | None:
        return options.out and options.out / name

    found: list[Result] = []
    if virtual:
        fly = partial(fly_virtual, options.seconds)
        found += study(fly, virtual, Result, settings, part("virtual"), Flags(), "virtual", "runs")
    if real:
        with (
            writing(options.out),
            serving(real) as servers,
            command.interruptible() as interrupted,
            busy(),
            threads(options.together) as executor,
            terminal.progress("over UDP and TCP", len(real), "runs") as bar,
        ):
            crew = Crew(executor, bar, len(real), "runs", interrupted)
            flying = crew.study(
                partial(fly_real, servers, options.seconds),
                {cell: cell for cell in real},
                Result,
                settings,
                part("real"),
            )
            found += flying.values()
    return found


@contextmanager
def busy() -> Iterator[None]:
    """Print how busy this machine's cores were in the block; above 90 % runs disturb each other."""

    def counted() -> NDArray[np.int64]:
        return np.array(Path("/proc/stat").read_text().split()[1:9], np.int64)

    before = counted()
    yield
    spent = counted() - before
    print(f"the cores were {1.0 - spent[3:5].sum() / max(spent.sum(), 1):.0%} busy")


@contextmanager
def threads(count: int) -> Iterator[ThreadPoolExecutor]:
    pool = ThreadPoolExecutor(count)
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def tables(results: Sequence[Result]) -> dict[str, TextTable]:
    """Scores of each task by network and system, and further figures of each cell."""
    grouped: dict[tuple[str, str, str], list[Result]] = {}
    for result in results:
        grouped.setdefault(result.cell[:3], []).append(result)
    made = {}
    for task in dict.fromkeys(key[0] for key in grouped):
        keys = [key for key in grouped if key[0] == task]
        systems = [each for each in (*REAL, *VIRTUAL) if any(each == key[2] for key in keys)]
        networks = [each for each in NETWORKS if any(each == key[1] for key in keys)]
        scores = [
            [network, *(_score(grouped.get((task, network, each), [])) for each in systems)]
            for network in networks
        ]
        bounds = [
            f"{each} {_score(grouped[task, OF_BOUNDS, each])}"
            for each in BOUNDS
            if (task, OF_BOUNDS, each) in grouped
        ]
        what = "mean cost, lower is better" if TASKS[task].is_cost else "mean coverage of the goal"
        title = f"{task}: {what}" + (f" (bounds: {', '.join(bounds)})" if bounds else "")
        made[title] = TextTable(["network", *systems], scores)
        figures = [
            [network, system, *_figures(grouped[task, network, system])]
            for network in networks
            for system in REAL
            if (task, network, system) in grouped
        ]
        if figures:
            head = ["network", "system", "runs", "freeze, median [s]", "longest [s]", "calls"]
            head += ["late", "of these by the machine", "longest wait [ms]", "errors"]
            head += ["program woke late, longest [ms]"]
            head += ["sent [kbit/s]", "received [kbit/s]", "robot CPU [%]", "serve CPU [%]"]
            made[f"{task}: figures"] = TextTable(head, figures)
    return made


def _score(results: Sequence[Result]) -> str:
    middle, half = interval([each.flown.score for each in results if each.flown])
    if middle is None:
        return ""
    return f"{middle:.2f}" + (f" ± {half:.2f}" if half is not None else "")


def _figures(results: Sequence[Result]) -> list[str]:
    whole = [(each, each.flown) for each in results if each.flown]
    runs = f"{len(whole)}" + (f" of {len(results)}" if len(whole) < len(results) else "")
    if not whole:
        return [runs, *[""] * 12]
    freezes = [each.freeze_s for _, each in whole]
    seconds = sum(each.seconds for _, each in whole)
    is_waiting = results[0].cell.system not in ("lerobot", "drtc")
    late = sum(len(each.late) for _, each in whole)
    return [
        runs,
        f"{np.median(freezes):.2f}",
        f"{max(freezes):.2f}",
        f"{sum(each.calls for _, each in whole)}",
        f"{late}" if is_waiting else "-",
        f"{sum(each.paused for each, _ in whole)}" if is_waiting else "-",
        f"{1e3 * max(each.wait_s_max for _, each in whole):.0f}" if is_waiting else "-",
        f"{sum(each.errors for _, each in whole)}",
        f"{1e3 * max(each.woke_late_s for _, each in whole):.0f}",
        f"{8e-3 * sum(each.sent for each, _ in whole) / seconds:.0f}",
        f"{8e-3 * sum(each.received for each, _ in whole) / seconds:.0f}",
        f"{100 * sum(each.cpu_s for _, each in whole) / seconds:.1f}",
        f"{100 * sum(each.serve_cpu_s for each, _ in whole) / seconds:.1f}",
    ]


def draw(results: Sequence[Result], out: Path) -> None:
    """Picture with the mean score of each system over the networks, a panel for each task."""
    import matplotlib.pyplot as plt

    real = [each for each in results if each.cell.system in REAL and each.flown]
    if not real:
        return
    tasks = dict.fromkeys(each.cell.task for each in real)
    networks = [name for name in NETWORKS if any(each.cell.network == name for each in real)]
    systems = [name for name in REAL if any(each.cell.system == name for each in real)]
    figure, panels = plt.subplots(
        len(tasks),
        1,
        figsize=(9, 3 * len(tasks) + 0.5),
        sharex=True,
        squeeze=False,
        layout="constrained",
    )
    for task, panel in zip(tasks, panels[:, 0], strict=True):
        for place, name in enumerate(systems):
            found = [
                interval(
                    [each.flown.score for each in real if each.cell[:3] == cell and each.flown]
                )
                for cell in ((task, network, name) for network in networks)
            ]
            means, halves = (
                [np.nan if value is None else value for value in each]
                for each in zip(*found, strict=True)
            )
            at = np.arange(len(networks)) + 0.12 * (place - 2)
            panel.errorbar(at, means, np.nan_to_num(halves), fmt="o", ms=4, label=name)
        panel.set_title(task)
        panel.set_ylabel("mean cost" if TASKS[task].is_cost else "coverage")
    panels[-1, 0].set_xticks(range(len(networks)), networks, rotation=30, ha="right")
    named = panels[0, 0].get_legend_handles_labels()
    figure.legend(*named, loc="outside upper center", ncols=len(systems))
    with files.replacing(out) as file:
        figure.savefig(file, format="png", dpi=120)
    plt.close(figure)


def quick(options: PoliciesOptions) -> PoliciesOptions:
    return replace(
        options,
        tasks=("pendulum", "cameras, 86 ms"),
        networks=("none", "100 ms, 5 %", "40 ms, 4 Mbit/s"),
        seeds=1,
        seconds=5.0,
    )


def run(argv: Sequence[str]) -> None:
    options = tyro.cli(
        PoliciesOptions, args=argv, prog="python -m bench.policies", description=__doc__
    )
    options = quick(options) if options.quick else options
    known: dict[str, Collection[str]] = {
        "--tasks": TASKS,
        "--networks": NETWORKS,
        "--systems": [*BOUNDS, *VIRTUAL, *REAL],
    }
    for flag, names in known.items():
        for name in getattr(options, flag[2:]):
            if name not in names:
                raise command.CommandError(f"{flag}: got {name!r}, expected of {list(names)}", 2)
    began_s = time.monotonic()
    results = measure(options)
    for title, table in (made := tables(results)).items():
        table.show(title)
    for result in results:
        if result.fault:
            print(f"no figures of {result.cell}: {result.fault}")
    print(f"{(time.monotonic() - began_s) / 60:.1f} min")
    if options.out:
        text = "".join(f"### {title}\n\n{table.markdown()}\n" for title, table in made.items())
        files.write(options.out / "tables.md", text.encode())
        content = {"machine": machine(), "results": results}
        files.write(options.out / "policies.json", msgspec.json.encode(content))
        draw(results, options.out / "policies.png")


if __name__ == "__main__":
    sys.exit(command.main(run, sys.argv[1:], "policies"))
