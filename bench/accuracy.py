"""Accuracy of the exact solver: max |u - u*| over 100 000 problems, against proved answers.

Half of the problems are recorded in flight, smooth and saturated, and half are random, from
gradients that activate no bound to such that hold nearly every input at a bound. No time is
measured, so all cores may work.
"""

import multiprocessing
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from bench.contestants import by_axis
from bench.harness import TextTable, progress
from bench.problems import derive, gradients, listening
from bench.reference import NoReference, Reference
from skytether.server.mpc.exact import ExactSolver
from skytether.server.mpc.problem import LATER, Problem, make_mpc, pose
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario
from skytether.sim.flight import fly

HORIZONS = (1, 30, 50, 100)
STEPS_S = (0.02, 0.05, 0.1)
INPUT_WEIGHTS = (1e-3, 1.93)
"""Values of R: nearly none, and the default."""
TAU_S = [0.4, 0.855]
"""Time constants of the two axes [s]."""
SCALES = (0.1, 1.0, 3.0, 10.0, 30.0)
"""Scales of random states [m, m/s] and the targets' steps: smooth to heavily saturated."""
SATURATED = {"shape": "square", "period_s": 5.0}
TARGET = 1e-6
SEED = 1


@dataclass(frozen=True)
class AccuracyCounts:
    """Number of problems to check, for each of the 24 combinations of H, Δt and R."""

    ticks: int = 260
    """Number of ticks of each of both flights; four problems each."""
    random: int = 210
    """Number of vehicles of each scale; two problems each."""
    horizons: tuple[int, ...] = HORIZONS


FULL, QUICK = AccuracyCounts(), AccuracyCounts(ticks=20, random=10)


@dataclass(frozen=True)
class AccuracyTask:
    """Set of problems: those of one flight, or random ones of one scale."""

    horizon: int
    dt_s: float
    input_weight: float
    reference: str = ""
    """Shape of a flight's reference; empty for random problems."""
    scale: float = 0.0
    """Scale of random problems; 0 for a flight."""
    count: int = 0

    def scenario(self) -> Scenario:
        """Scenario that is flown."""
        control = {"dt": self.dt_s, "horizon": self.horizon, "input_weight": self.input_weight}
        changes: dict[str, Any] = {"control": control, "model": {"tau_s": TAU_S}}
        changes["duration"] = (self.count + 100) * self.dt_s
        changes["settle"] = 0.0
        if self.reference == "square":
            changes["reference"] = SATURATED
        # the paper's delays are longer than so short a horizon bridges
        if self.horizon * self.dt_s < 0.5:
            none = "loss(0.1)"
            changes["network"] = {"uplink": none, "downlink": none}
        return derive("paper-every-step", **changes)


def tasks(counts: AccuracyCounts) -> list[AccuracyTask]:
    """Tasks, the longest horizons first, because they take longest."""
    piles = []
    for H, dt_s, R in product(sorted(counts.horizons, reverse=True), STEPS_S, INPUT_WEIGHTS):
        piles += [
            AccuracyTask(H, dt_s, R, reference=r, count=counts.ticks) for r in ("circle", "square")
        ]
        piles += [AccuracyTask(H, dt_s, R, scale=scale, count=counts.random) for scale in SCALES]
    return piles


def measure(counts: AccuracyCounts, workers: int | None = None) -> dict[str, Any]:
    """Figures of all problems, by H, computed by several processes."""
    piles = tasks(counts)
    with multiprocessing.get_context("spawn").Pool(workers or os.cpu_count()) as pool:
        checked = pool.imap_unordered(check, piles)
        results = [next(checked) for _ in progress(piles, "accuracy")]
    groups: dict[str, Any] = {}
    for H, kind in product(sorted(counts.horizons), ("flown", "random")):
        of_it = [each for each in results if each["horizon"] == H and each["kind"] == kind]
        groups[f"H = {H}, {kind}"] = _together(of_it)
    return {"groups": groups, "all": _together(results)}


def _together(results: list[dict[str, Any]]) -> dict[str, Any]:
    adds = ("problems", "active", "fallbacks", "unsolved", "unproved", "outside", "other_bits")
    sums = {key: sum(each[key] for each in results) for key in adds}
    return sums | {"error": max(each["error"] for each in results)}


def check(task: AccuracyTask) -> dict[str, Any]:
    """Solve all problems of a task twice, and prove every answer optimal."""
    figures: dict[str, Any] = dict.fromkeys(
        ("problems", "active", "fallbacks", "unsolved", "unproved", "outside", "other_bits"), 0
    )
    figures |= {"horizon": task.horizon, "error": 0.0}
    figures["kind"] = "flown" if task.reference else "random"
    for problem, gradient, guess in _problems(task):
        solver = ExactSolver(problem)
        inputs, solved = solver.solve(gradient, guess)
        again, _ = ExactSolver(problem).solve(gradient, guess)
        bound = problem.mpc.bounds[:, None]
        figures["problems"] += gradient.shape[0] * gradient.shape[1]
        figures["active"] += int((np.abs(inputs) >= bound).any(axis=2).sum())
        figures["fallbacks"] += solver.fallbacks
        figures["unsolved"] += int((~solved).sum())
        figures["outside"] += int((np.abs(inputs) > bound).sum())
        figures["other_bits"] += int((inputs.view(np.int64) != again.view(np.int64)).sum())
        references = [Reference(hessian, limit) for hessian, limit in by_axis(problem)]
        for vehicle, axis in np.ndindex(*gradient.shape[:2]):
            if not solved[vehicle]:
                continue
            try:
                right = references[axis].solve(gradient[vehicle, axis])
            except NoReference:
                figures["unproved"] += 1
                continue
            error = float(np.abs(inputs[vehicle, axis] - right).max())
            figures["error"] = max(figures["error"], error)
    return figures


def _problems(task: AccuracyTask) -> Iterator[tuple[Problem, Array, Array]]:
    """Problem, gradients and guesses [m/s] of a task."""
    scenario = task.scenario()
    if task.reference:
        with listening() as listeners:
            flight = fly(scenario)
        assert len(flight.client), flight.failure
        _, later = listeners
        for gradient, guess in zip(*later.heard(task.count), strict=True):
            yield later.problem, gradient, guess
        return
    terms = scenario.terms()
    problem = pose(terms.model, make_mpc(terms, scenario.control), LATER)
    where = (task.horizon, round(1000 * task.dt_s), round(1e6 * task.input_weight))
    rng = np.random.default_rng([SEED, *where, round(10 * task.scale)])
    axes, bound = terms.axes, problem.mpc.bounds[:, None]
    x = rng.normal(0.0, task.scale, (task.count, axes, 2))
    # Targets that drift about as far as a vehicle could fly in the time.
    drift = rng.normal(
        0.0, task.scale * np.sqrt(task.dt_s), (task.count, axes, task.horizon + 1, 2)
    )
    guess = np.clip(rng.normal(0.0, 1.0, (task.count, axes, task.horizon)), -bound, bound)
    calm, target = np.zeros(x.shape[:2]), np.cumsum(drift, axis=2)
    yield problem, gradients(problem, x, target, guess, calm), guess


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    """Table with a row for each group and one for all."""
    rows = []
    for name, figures in [*result["groups"].items(), ("all", result["all"])]:
        target = f" (≤ {TARGET:g})" if name == "all" else ""
        rows.append(
            [
                name,
                str(figures["problems"]),
                f"{figures['active'] / figures['problems']:.0%}",
                f"{figures['error']:.0e}{target}",
                str(figures["fallbacks"]),
                str(figures["unsolved"]),
                str(figures["outside"]),
                str(figures["other_bits"]),
                str(figures["unproved"]),
            ]
        )
    headings = ["problems", "number", "bounds active", "max error [m/s]", "by DAQP", "unsolved"]
    headings += ["inputs outside", "other bits", "reference unproved"]
    return {"accuracy": TextTable(headings, rows)}
