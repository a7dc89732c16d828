"""Results of an identification: sentences on each axis, and a scenario with the identified model.

The scenario also contains the keys changed on the command line.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import tomli_w

from skytether.lab.identify.fit import Fit, Numbers, StepResponse, verdict
from skytether.lab.identify.steps import STEPS, reference_speeds
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario

AXES = "xyz"
BEYOND = 1.5
"""Largest allowed input, divided by the largest step: larger inputs were not measured."""
FASTER = 1.25
"""Speed that the input bound must allow, divided by that of the reference or the fence's wind."""
DIGITS = 4


class AxisOutcome(NamedTuple):
    speed: float
    cut: int
    """Number of steps that the fence shortened or left no space for."""
    responses: Sequence[StepResponse]
    fit: Fit | None
    """Fitted model; None with too few steps."""

    @property
    def steps(self) -> str:
        """Number of usable steps as text, and of cut steps if there are any, as in "12, 2 cut"."""
        return f"{len(self.responses)}{f', {self.cut} cut' if self.cut else ''}"


def with_interval(name: str, numbers: Numbers, within: Numbers) -> str:
    half = getattr(within, name)
    return f"{getattr(numbers, name):.3f} ± {f'{half:.3f}' if math.isfinite(half) else '?'}"


def describe(axis: AxisOutcome) -> str:
    fit = axis.fit
    if fit is None:
        return f"too few steps ({axis.steps}), {_remedy(axis)}"
    gain, tau, late = (with_interval(name, fit.numbers, fit.within) for name in Numbers._fields)
    numbers = f"gain {gain}, time constant {tau} s, dead time {late} s"
    return f"{numbers}, from {axis.steps} steps of {axis.speed:g} m/s: {verdict(fit)}"


def _remedy(axis: AxisOutcome) -> str:
    if axis.cut < STEPS:
        return "let the flight finish, and measure velocities"
    return "the fence leaves no room: expected a wider one, a smaller --speed, or a shorter --hold"


def scenario_text(
    flown: Scenario, extends: str, base: Scenario, axes: Sequence[AxisOutcome]
) -> bytes | None:
    """Scenario with the identified model; None if an axis has no model.

    Args:
        flown: scenario that was flown.
        extends: name or file of the base scenario, which the result extends.
        base: the base scenario.
        axes: results of each axis.
    """
    fits = [each.fit for each in axes if each.fit is not None]
    if len(fits) < len(axes):
        return None
    table: dict[str, Any] = {
        "extends": str(Path(extends).absolute()) if ".toml" in extends else extends,
        "title": f"{extends}, with the model of a {flown.vehicle.kind} as identified",
    }
    table |= differing(reading.to_table(base), reading.to_table(flown))
    if file := table.get("reference", {}).get("file"):
        table["reference"]["file"] = str(Path(file).absolute())
    # the plant equals the model unless the scenario says otherwise
    if flown.vehicle.kind == "simulated":
        truth = {
            "tau_s": flown.true_tau_s,
            "gain": flown.true_gain,
            "dead_time_s": flown.true_dead_time_s,
        }
        table["vehicle"] = table.get("vehicle", {}) | {
            key: values.tolist() for key, values in truth.items()
        }
    numbers = [fit.numbers for fit in fits]
    table["model"] = table.get("model", {}) | {
        "tau_s": [_rounded(each.tau_s) for each in numbers],
        "u_max": _u_max(flown, axes, numbers),
        "gain": [_rounded(each.gain) for each in numbers],
        "dead_time_s": [round(each.dead_time_s, 3) for each in numbers],
    }
    lines = [
        f"Made by `skytether identify {flown.vehicle.kind}`: first-order model with dead time,",
        "fitted to steps of velocity; with 95 % intervals.",
        *(f"{name}: {describe(axis)}" for name, axis in zip(AXES, axes, strict=False)),
        f"u_max: {BEYOND:g} times the size of the steps, because larger inputs were not measured;",
        f"more if {FASTER:g} times the desired trajectory's speed or the fence's wind needs more.",
    ]
    return "".join(f"# {line}\n" for line in lines).encode() + tomli_w.dumps(table).encode()


def differing(base: dict[str, Any], table: dict[str, Any]) -> dict[str, Any]:
    """Values of a table that differ from the base, nested as in the table."""
    found: dict[str, Any] = {}
    for key, value in table.items():
        before = base.get(key)
        if isinstance(value, dict) and isinstance(before, dict):
            if below := differing(before, value):
                found[key] = below
        elif value != before:
            found[key] = value
    return found


def _rounded(number: float) -> float:
    return float(f"{number:.{DIGITS}g}")


def _u_max(flown: Scenario, axes: Sequence[AxisOutcome], numbers: Sequence[Numbers]) -> list[float]:
    """Bounds of the input [m/s]: enough for the reference, the fence's wind and the largest step,
    but at most the bounds that were flown.
    """
    wind_mps = flown.fence.wind_mps if flown.fence.is_there else 0.0
    wanted = [max(speed, wind_mps) for speed in reference_speeds(flown)]
    most = flown.u_max.tolist()
    each = zip(axes, numbers, wanted, most, strict=True)
    return [
        _rounded(min(bound, max(BEYOND * axis.speed, FASTER * speed / found.gain)))
        for axis, found, speed, bound in each
    ]


class AxisResults(msgspec.Struct, frozen=True):
    """Results of an axis in identified.json; None for unknown values."""

    axis: str
    step_mps: float
    steps: int
    cut: int
    verdict: str
    gain: float | None = None
    tau_s: float | None = None
    dead_time_s: float | None = None
    gain_within: float | None = None
    tau_s_within: float | None = None
    dead_time_s_within: float | None = None
    rms: float | None = None
    largest: float | None = None
    largest_at_s: float | None = None


def axis_results(name: str, axis: AxisOutcome) -> AxisResults:
    steps, fit = len(axis.responses), axis.fit
    if fit is None:
        return AxisResults(name, axis.speed, steps, axis.cut, describe(axis))
    gain, tau, late = (each if math.isfinite(each) else None for each in fit.within)
    off = fit.misfit
    return AxisResults(
        name,
        axis.speed,
        steps,
        axis.cut,
        verdict(fit),
        *fit.numbers,
        gain_within=gain,
        tau_s_within=tau,
        dead_time_s_within=late,
        rms=off.rms,
        largest=off.largest,
        largest_at_s=off.at_s,
    )
