"""Cost of a whole tick: for one vehicle, for fleets, and over the number of vehicles."""

import gc
import time
import tracemalloc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bench import solvers
from bench.airspace import Airspace, PlannedFleet
from bench.contestants import Factory, tuned
from bench.harness import (
    HOT,
    PACED,
    Pace,
    TextTable,
    WakeLateness,
    figures_us,
    interleave,
    progress,
    quantile_ms,
    ratios,
    times,
    us,
    without_gc,
)
from bench.problems import ByTurns, derive, listening, saturated, solving
from skytether.figures.flights import save
from skytether.server.mpc.exact import ExactSolver
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.scenario.whole import Scenario

PERIOD_MS = 20.0
"""Length Δt of a step of all flights here [ms]."""
TARGETS_TICK = {"hot": {"p50": 12.0, "p99": 5.0}, "paced": {"p50": 6.0, "p99": 5.0}}
"""Targets of one vehicle's tick: tuned OSQP's time over ours, by pace and quantile."""
TARGET_FLEET, TARGET_P99_MS = 150.0, 10.0
"""Targets for fleets: OSQP's time over that of a batch, and the p99 of STAGES [ms]."""
FIGURE = Path(__file__).parents[1] / "docs" / "scaling.png"
SETTLE = 50
"""Number of ticks before the measurement, in which vehicles leave the reference."""
STAGES = ("estimate", "plan", "trigger")
"""Laps of the stopwatch to which TARGET_P99_MS applies."""


@dataclass(frozen=True)
class TickCounts:
    hot: int = 1000
    paced: int = 300
    fleet: int = 1000
    """Number of vehicles planned for at once."""
    fleet_ticks: int = 100
    fleet_sample: int = 20
    """Number of vehicles of the fleet that OSQP plans for."""
    crowd: int = 2500
    crowd_ticks: int = 400
    scale: tuple[int, ...] = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
    scale_ticks: int = 50


FULL = TickCounts()
QUICK = TickCounts(100, 20, 200, 10, 5, 500, 20, (1, 2, 5, 10, 20, 50, 100, 200), 10)


def mixes() -> dict[str, Scenario]:
    """Scenarios whose bounds are active never, rarely, and in half of the axis problems."""
    control = {"dt": 0.02, "horizon": 50}

    def square(period_s: float, u_max: float) -> Scenario:
        reference = {"shape": "square", "period_s": period_s}
        model = {"u_max": [u_max]}
        return derive("paper-every-step", control=control, reference=reference, model=model)

    circle = derive("paper-every-step", control=control)
    return {"never": circle, "rarely": square(10.8, 1.8), "half": square(4.0, 1.5)}


def measure(counts: TickCounts) -> dict[str, Any]:
    lateness = WakeLateness()
    single = {
        name: _single(name, scenario, counts, lateness)
        for name, scenario in solvers.flights().items()
    }
    half = mixes()["half"]
    return {
        "single": single,
        "fleets": fleets(counts),
        "crowd": _crowd(half, counts, lateness),
        "scaling": _scaling(half, counts, lateness),
        "memory": {"bytes_per_vehicle": _bytes_per_vehicle(half)},
        "counts": {"fleet": counts.fleet, "crowd": counts.crowd},
        "wake": lateness.figures(),
    }


def fleets(counts: TickCounts) -> dict[str, Any]:
    """Figures of planning for a fleet in one batch against tuned OSQP, for each of `mixes`."""
    return {
        name: _fleet(name, scenario, tuned("saturated" if name == "half" else "smooth"), counts)
        for name, scenario in mixes().items()
    }


def _single(
    name: str, scenario: Scenario, counts: TickCounts, lateness: WakeLateness
) -> dict[str, Any]:
    """CPU time from a decoded observation to a packed horizon of one vehicle, on two servers."""
    ours = Airspace(scenario, 1)
    with solving(lambda problem: ByTurns(tuned(name), problem)):
        theirs = Airspace(scenario, 1)
    spaces = {"ours": ours, "osqp": theirs}
    result: dict[str, Any] = {}
    for pace, count in ((HOT, counts.hot), (PACED, counts.paced)):
        figures = {
            key: figures_us(durations)
            for key, durations in interleave(
                {key: waker(space) for key, space in spaces.items()},
                count,
                pace,
                lateness,
                f"one vehicle, {name}",
                prepare={key: space.prepare for key, space in spaces.items()},
            ).items()
        }
        result["hot" if pace is HOT else "paced"] = {
            **figures,
            "ratio": ratios(figures["osqp"], figures["ours"]),
        }
    return result


def _fleet(name: str, scenario: Scenario, make: Factory, counts: TickCounts) -> dict[str, Any]:
    """Figures of planning for all in one batch, then for some of them one by one by OSQP.

    The QPs of a second, equal fleet are recorded, and both solvers solve them again.
    """
    fleet = PlannedFleet(scenario, counts.fleet)
    with listening() as listeners:
        second = PlannedFleet(scenario, counts.fleet)
    _, later = listeners
    exact, sample = (
        ExactSolver(later.problem),
        range(0, counts.fleet, max(1, counts.fleet // counts.fleet_sample)),
    )
    # Each vehicle has its own solvers, with their own warm starts.
    others = [[make(later.problem) for _ in range(2)] for _ in sample]
    plan_ns, solve_ns, theirs_ns, active = [], [], [], []
    with without_gc():
        for tick in progress(range(counts.fleet_ticks + SETTLE), f"fleet, {name}"):
            start_ns = time.process_time_ns()
            fleet.plan()
            planned_ns = time.process_time_ns() - start_ns
            second.plan()
            fleet.fly()
            second.fly()
            if tick >= SETTLE:
                gradient, guess = later.recorded()
                start_ns = time.process_time_ns()
                answers = [exact.solve(*half)[0] for half in zip(gradient, guess, strict=True)]
                solve_ns.append(time.process_time_ns() - start_ns)
                single_ns = []
                for row, pair in zip(sample, others, strict=True):
                    vehicle = slice(row, row + 1)
                    problems = [
                        (gradient[half, vehicle], guess[half, vehicle]) for half in range(2)
                    ]
                    start_ns = time.process_time_ns()
                    for solver, problem in zip(pair, problems, strict=True):
                        solver.solve(*problem)
                    single_ns.append(time.process_time_ns() - start_ns)
                plan_ns.append(planned_ns)
                theirs_ns.append(float(np.mean(single_ns)))
                active.append(saturated(np.array(answers), later.problem))
            later.forget()
    ours = {
        "plan": figures_us(plan_ns, per=counts.fleet),
        "solve": figures_us(solve_ns, per=counts.fleet),
    }
    theirs = figures_us(theirs_ns)
    return {
        "active": float(np.mean(active)),
        **ours,
        "osqp": theirs,
        "ratio": {key: ratios(theirs, figures) for key, figures in ours.items()},
    }


def _crowd(scenario: Scenario, counts: TickCounts, lateness: WakeLateness) -> dict[str, Any]:
    """Time of a server's tick of many saturated vehicles, by stage [ms]."""
    space = Airspace(scenario, counts.crowd, Stopwatch(time.process_time_ns))
    spent = space.server.stopwatch.spent_ns
    laps: dict[str, list[int]] = {}
    wall_ns = []
    with without_gc():
        for tick in progress(range(counts.crowd_ticks + SETTLE), f"{counts.crowd} vehicles"):
            spent.clear()
            space.prepare()
            lateness.sleep(PACED.pause_s)
            start_ns = time.perf_counter_ns()
            space.wake()
            took_ns = time.perf_counter_ns() - start_ns
            if tick >= SETTLE:
                wall_ns.append(took_ns)
                for stage, stage_ns in spent.items():
                    laps.setdefault(stage, []).append(stage_ns)
    received = np.sum([laps.pop(stage) for stage in ("decode", "observe")], axis=0)
    target = np.sum([laps[stage] for stage in STAGES], axis=0)
    tick_ns = np.sum(list(laps.values()), axis=0)
    durations: dict[str, Any] = {
        "receive": received,
        **laps,
        " + ".join(STAGES): target,
        "tick": tick_ns,
        "tick, elapsed time": wall_ns,
    }
    shares = {"p50_ms": 0.5, "p99_ms": 0.99}
    return {
        stage: {name: quantile_ms(taken, share) for name, share in shares.items()}
        for stage, taken in durations.items()
    }


def waker(space: Airspace) -> Callable[[int], None]:
    return lambda _: space.wake()


def _scaling(scenario: Scenario, counts: TickCounts, lateness: WakeLateness) -> dict[str, float]:
    """Median CPU time of a tick [ms], by the number of vehicles."""
    spaces = {count: Airspace(scenario, count) for count in counts.scale}
    spent = interleave(
        {str(count): waker(space) for count, space in spaces.items()},
        counts.scale_ticks,
        Pace(turn=10, pause_s=HOT.pause_s),
        lateness,
        "more and more vehicles",
        prepare={str(count): space.prepare for count, space in spaces.items()},
    )
    return {count: figures_us(durations)["p50_us"] / 1000.0 for count, durations in spent.items()}


def _bytes_per_vehicle(scenario: Scenario) -> float:
    few, many = (_server_bytes(scenario, count) for count in (100, 300))
    return (many - few) / 200


def _server_bytes(scenario: Scenario, count: int) -> int:
    tracemalloc.start()
    space = Airspace(scenario, count)
    for _ in range(3):
        space.prepare()
        space.wake()
    space.server.outbox()
    gc.collect()
    with_it, _ = tracemalloc.get_traced_memory()
    del space.server
    gc.collect()
    without, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return with_it - without


def draw(result: Mapping[str, Any], file: Path = FIGURE) -> None:
    """Draw tick time over vehicles, both on logarithmic axes, with a line of slope 1."""
    counts = [int(count) for count in result["scaling"]]
    ticks_ms = list(result["scaling"].values())
    figure = Figure(figsize=(7.0, 4.5), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    axes.loglog(counts, ticks_ms, "o-", color="#0072b2", label="one tick, measured (median)")
    least_ms = min(tick_ms / count for tick_ms, count in zip(ticks_ms, counts, strict=True))
    proportional = [least_ms * count for count in counts]
    label = f"{1000.0 * least_ms:.1f} µs a vehicle (slope 1)"
    axes.loglog(counts, proportional, "--", color="#555555", label=label)
    axes.axhline(PERIOD_MS, color="#d55e00", linewidth=1.0, label=f"Δt = {PERIOD_MS:g} ms")
    axes.set_xlabel("vehicles in one batch")
    axes.set_ylabel("CPU time of a tick [ms]")
    axes.set_xticks(counts, [f"{count}" for count in counts])
    axes.yaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.grid(visible=True, alpha=0.3)
    axes.legend()
    save(figure, file, dpi=150)


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    limits = {" + ".join(STAGES): f" (< {TARGET_P99_MS:g})"}
    rows = [
        [
            f"{stage} [ms]",
            f"{figures['p50_ms']:.2f}",
            f"{figures['p99_ms']:.2f}{limits.get(stage, '')}",
        ]
        for stage, figures in result["crowd"].items()
    ]
    kilobytes = result["memory"]["bytes_per_vehicle"] / 1000.0
    rows.append(["the server's memory for each vehicle [kB]", f"{kilobytes:.1f}", ""])
    return {
        "tick-single": _single_table(result["single"]),
        "tick-fleet": _fleet_table(result["fleets"]),
        "tick-crowd": TextTable([f"{result['counts']['crowd']} vehicles", "p50", "p99"], rows),
    }


def _fleet_table(fleets: Mapping[str, Any]) -> TextTable:
    rows = []
    for name, figures in fleets.items():
        row = [f"{name} ({figures['active']:.0%})"]
        row += [us(figures[key]["p50_us"]) for key in ("plan", "solve", "osqp")]
        row += [times(figures["ratio"][key]["p50"], TARGET_FLEET) for key in ("plan", "solve")]
        rows.append(row)
    headings = ["bounds active", "ours, planning [µs]", "solving alone", "tuned OSQP, solving"]
    headings += ["OSQP / planning", "OSQP / solving"]
    return TextTable(headings, rows)


def _single_table(single: Mapping[str, Any]) -> TextTable:
    rows = []
    for flight, paces in single.items():
        for pace, figures in paces.items():
            row = [f"{flight}, {pace}"]
            for key in ("ours", "osqp"):
                row += [us(figures[key][f"{share}_us"]) for share in ("p50", "p99")]
            targets = TARGETS_TICK[pace].items()
            row += [times(figures["ratio"][share], target) for share, target in targets]
            rows.append(row)
    headings = ["one tick [µs]", "ours p50", "p99", "tuned OSQP p50", "p99", "ratio p50", "p99"]
    return TextTable(headings, rows)
