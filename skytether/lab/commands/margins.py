"""`skytether margins`: stability of a scenario's loop, and the vehicles for which it is stable."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec

from skytether.lab.commands import tables
from skytether.lab.commands.pool import Flags, Interrupted, PoolFlags, crew
from skytether.lab.engine import margins as lab
from skytether.lab.engine.margins import Margin, MarginLimit
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError, ScenarioFlags, ScenarioName


@dataclass(frozen=True)
class MarginsOptions:
    """Options of `skytether margins`."""

    scenario: ScenarioName = "demo"
    """Name of a scenario (`skytether list scenarios`) or path of a .toml file."""
    runs: Annotated[int, Argument(metavar="N")] = 16
    """Number of flights of each vehicle; seeds count up from the scenario's."""
    json: Path | None = None
    """JSON file for the results."""
    pool: PoolFlags = Flags()
    config: ScenarioFlags = Scenario()


def margins(argv: Sequence[str]) -> None:
    """Fly a scenario's loop, and find for which vehicles it is stable.

    The vehicle hovers in virtual time, over the scenario's network. After a weak push:

      growth   of the mean square deviation per step; below 1: stable

    In the scenario's white wind and noise, if the loop is stable:

      RMS      of the position's deviation
      bound    share of the steps with an input at its bound

    The server plans with the scenario's model. The first row has the scenario's own vehicle; in the
    other rows the vehicle differs as described. The second table has limits, found by bisection:
    how far one quantity may differ from the model's value before the loop is no longer stable. For
    pushes, a trigger that uses the state is replaced by a periodic trigger with the same mean rate,
    because a weak push stays below every threshold.
    """
    options = command.parse(MarginsOptions(), argv, "skytether margins", margins.__doc__)
    command.check_count("--runs", options.runs, 1000)
    options.pool.check()
    scenario = options.config
    vehicles = {lab.AS_IT_IS: scenario}
    vehicles |= {
        name: each.of(scenario) for name, each in lab.VEHICLES.items() if each.is_of(scenario)
    }
    total = len(vehicles) + len(lab.LIMITS) + 1
    try:
        with crew(
            options.pool, f"flying vehicles like {options.scenario}'s", total, "parts"
        ) as flyers:
            (trigger,) = flyers.map(lab.clocked_trigger, [scenario])
            flyers.advance(1)
            parts: list[Callable[[], Margin | MarginLimit]] = [
                partial(lab.margin, each, name, trigger, options.runs)
                for name, each in vehicles.items()
            ]
            runs = min(options.runs, lab.LIMIT_RUNS)
            parts += [partial(lab.limit, scenario, each, trigger, runs) for each in lab.LIMITS]
            results = flyers.study(_fly, dict(enumerate(parts))).values()
    except Interrupted as interrupted:  # no journal, so nothing to continue
        raise CommandError("interrupted", command.INTERRUPTED) from interrupted
    flown = [each for each in results if isinstance(each, Margin)]
    limits = [each for each in results if isinstance(each, MarginLimit)]
    if options.json is not None:
        about = {"scenario": options.scenario, "trigger": trigger}
        content = msgspec.json.encode(about | {"margins": flown, "limits": limits})
        command.write(options.json, content)
    _show(options, trigger, flown)
    _show_limits(limits)


def _fly(part: Callable[[], Margin | MarginLimit]) -> Margin | MarginLimit:
    return part()


def _show(options: MarginsOptions, trigger: str, found: Sequence[Margin]) -> None:
    scenario = options.config
    title = f"{options.scenario}, {options.runs} seeds, white wind {lab.wind_of(scenario):g}"
    noises = scenario.sensor.position_noise_m, scenario.sensor.velocity_noise_mps
    if any(noises):
        title += f", noise {noises[0]:g} m and {noises[1]:g} m/s"
    if trigger != scenario.control.trigger:
        print(
            f"control.trigger: {scenario.control.trigger!r} uses the state; pushes are flown with "
            f"{trigger!r}, at the same mean rate"
        )
    rms_headings = [f"RMS {axis} [m]" for axis in "xyz"[: scenario.model.axes]]
    rows = []
    for each in found:
        rms: Sequence[float | None] = each.rms_m or [None] * scenario.model.axes
        halves = each.rms_ci95_m or [None] * len(rms)
        row = (
            each.vehicle,
            _with_interval(each.growth, each.growth_ci95),
            "yes" if each.stable else "no",
            *map(_with_interval, rms, halves),
            "-" if each.saturated is None else f"{each.saturated:.1%}",
        )
        rows.append(row)
    tables.show(title, ("vehicle", "growth", "stable", *rms_headings, "bound"), rows)


def _with_interval(value: float | None, half: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4f}" + ("" if half is None else f" ± {half:.4f}")


def _show_limits(limits: Sequence[MarginLimit]) -> None:
    rows = []
    for each in limits:
        beyond = "<" if each.quantity.endswith("least") else ">"
        unknown = f"{beyond} {each.searched:g}"
        rows.append((each.quantity, unknown if each.value is None else f"{each.value:.3g}"))
    tables.show("stable up to, relative to the model", ("quantity", "limit"), rows)
