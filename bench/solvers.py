"""Cost of the two solves of a tick: one vehicle, H = 50, Δt = 0.02 s, two axes, hot and paced."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from bench.contestants import NOTHING, OURS, TUNED, Factory, by_axis, contestants
from bench.harness import (
    HOT,
    PACED,
    TextTable,
    WakeLateness,
    figures_us,
    interleave,
    progress,
    ratios,
    times,
    us,
)
from bench.problems import RecordedProblems, derive, record
from bench.reference import Reference
from skytether.shared.law.model import Array, Flags
from skytether.shared.scenario.whole import Scenario

TARGETS = {"hot": {"p50": 15.0, "p99": 10.0}, "paced": {"p50": 7.0, "p99": 5.0}}
"""Targets: ratio of tuned OSQP's time to the exact solver's, by pace and quantile."""
PACES = {"hot": HOT, "paced": PACED}


@dataclass(frozen=True)
class SolversCounts:
    hot: int = 1000
    paced: int = 200


FULL, QUICK = SolversCounts(), SolversCounts(hot=100, paced=20)


def flights() -> dict[str, Scenario]:
    """Scenarios of a flight that never reaches its bounds, and of one that does at every corner."""
    control = {"dt": 0.02, "horizon": 50}
    square = {"shape": "square", "period_s": 6.0}
    return {
        "smooth": derive("paper-every-step", duration=30.0, control=control),
        "saturated": derive("paper-every-step", duration=30.0, control=control, reference=square),
    }


def measure(counts: SolversCounts) -> dict[str, Any]:
    """Figures of all contestants in the saturated flight, and of tuned OSQP alone in the other."""
    lateness = WakeLateness()
    result: dict[str, Any] = {}
    for name, scenario in flights().items():
        factories = contestants(name)
        if name == "smooth":
            factories = {key: factories[key] for key in (OURS, TUNED)}
        result[name] = _measure_flight(name, scenario, factories, counts, lateness)
    return result | {"wake": lateness.figures()}


def _measure_flight(
    name: str,
    scenario: Scenario,
    factories: Mapping[str, Factory],
    counts: SolversCounts,
    lateness: WakeLateness,
) -> dict[str, Any]:
    recorded = record(scenario, max(counts.hot, counts.paced))
    reference = _references(recorded)
    figures: dict[str, Any] = {key: {"error": 0.0, "unsolved": 0} for key in factories}

    def compete(pace: str, *names: str) -> dict[str, dict[str, float]]:
        entries = {key: SolverEntry(factories[key], recorded) for key in names}
        runs = {key: entry.tick for key, entry in entries.items()}
        count, title = getattr(counts, pace), f"{name}, {pace}: {names[-1]}"
        spent = interleave(runs, count, PACES[pace], lateness, title)
        for key, entry in entries.items():
            off = float(np.abs(entry.inputs() - reference[:, :count]).max())
            figures[key]["error"] = max(off, figures[key]["error"])
            figures[key]["unsolved"] += entry.unsolved()
        return {key: figures_us(durations) for key, durations in spent.items()}

    spent = compete("hot", *factories)
    for key in factories:
        figures[key]["hot"] = spent[key] | {"ratio": ratios(spent[key], spent[OURS])}
    # A real server has one solver, so each solver runs against ours alone: more would empty the
    # caches.
    for key in factories.keys() - {OURS}:
        pair = compete("paced", OURS, key)
        figures[key]["paced"] = pair[key] | {"ratio": ratios(pair[key], pair[OURS])}
        if key == TUNED:
            figures[OURS]["paced"] = pair[OURS] | {"ratio": ratios(pair[OURS], pair[OURS])}
    return {"active": recorded.active(), "contestants": figures}


class SolverEntry:
    """Contestant, with one solver for the generator and one for the tracker."""

    def __init__(self, make: Factory, recorded: RecordedProblems) -> None:
        self._generator, self._tracker = (make(recorded.problem) for _ in range(2))
        # Sliced in advance, because slicing would cost as much as a solve.
        pairs = [
            [(gradient[None], guess[None]) for gradient, guess in zip(*half, strict=True)]
            for half in zip(recorded.gradient, recorded.guess, strict=True)
        ]
        self._problems = list(zip(*pairs, strict=True))
        self._answers: dict[int, tuple[tuple[Array, Flags], tuple[Array, Flags]]] = {}

    def tick(self, i: int) -> None:
        generator, tracker = self._problems[i]
        self._answers[i] = (self._generator.solve(*generator), self._tracker.solve(*tracker))

    def inputs(self) -> Array:
        """Inputs solved so far [m/s]; shape (2, ticks, axes, H)."""
        answers = (self._answers[i] for i in sorted(self._answers))
        return np.array([[inputs[0] for inputs, _ in both] for both in answers]).swapaxes(0, 1)

    def unsolved(self) -> int:
        return sum(not solved[0] for both in self._answers.values() for _, solved in both)


def _references(recorded: RecordedProblems) -> Array:
    """Exact inputs; shape (2, ticks, axes, H)."""
    references = [Reference(hessian, bound) for hessian, bound in by_axis(recorded.problem)]
    inputs = np.empty_like(recorded.gradient)
    for half, tick, axis in progress(list(np.ndindex(inputs.shape[:3])), "exact answers"):
        inputs[half, tick, axis] = references[axis].solve(recorded.gradient[half, tick, axis])
    return inputs


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    headings = ["[µs]"]
    for pace in PACES:
        headings += [f"{pace}\np50", "\np99", "\nratio", "\nof p99"]
    headings.append("error\n[m/s]")
    figures = result["saturated"]["contestants"]
    rows = [_row(name, figures[name]) for name in figures]
    shown = {"solvers-saturated": TextTable(headings, rows)}
    shown["solvers-targets"] = TextTable(
        ["tuned OSQP against ours", "bounds active", "hot p50", "p99", "paced p50", "p99"],
        [
            [
                flight,
                f"{result[flight]['active']:.0%}",
                *(
                    times(
                        result[flight]["contestants"][TUNED][pace]["ratio"][share],
                        TARGETS[pace][share],
                    )
                    for pace, share in product(PACES, ("p50", "p99"))
                ),
            ]
            for flight in flights()
        ],
    )
    return shown


def _row(name: str, figures: Mapping[str, Any]) -> list[str]:
    row = [name]
    for pace in PACES:
        spent = figures[pace]
        row += [us(spent["p50_us"]), us(spent["p99_us"])]
        row += [f"{spent['ratio'][share]:.1f}" for share in ("p50", "p99")]
    if name == NOTHING:
        return [*row, ""]
    failed = f", {figures['unsolved']} unsolved" if figures["unsolved"] else ""
    return [*row, f"{figures['error']:.0e}{failed}"]
