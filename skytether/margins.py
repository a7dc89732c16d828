"""`skytether margins`: whether a scenario's loop is stable, and with which vehicles."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tyro
from rich.table import Table

from lab import margins as lab
from lab.margins import Margin
from shared.config import Scenario
from shell import command
from shell.command import CommandError, ScenarioFlags, ScenarioName


@dataclass(frozen=True)
class Options:
    """Options of `skytether margins`."""

    scenario: ScenarioName = "demo"
    """Name of a scenario (see `skytether scenarios`) or path of a .toml file."""
    runs: Annotated[int, tyro.conf.arg(metavar="N")] = 16
    """Number of flights whose timing is taken, with seeds that count up from the scenario's."""
    json: Path | None = None
    """File for the figures."""
    config: ScenarioFlags = Scenario()


def margins(argv: Sequence[str]) -> None:
    """Say whether a scenario's loop is stable, computed for it and for vehicles that differ.

    Where no bound is active the loop is linear, given which packet arrives when. Along the timing
    of some flights it is computed how the square of a push, on average, dies away, which tells

      growth   of that at each step; below 1 the loop is stable in the mean square
      RMS      of the position's deviation, under the scenario's white wind and noise alone
      bound    share of the steps at which an input would lie beyond its bound: where it is more
               than some percent, the loop is not linear, and RMS is less than what is flown

    The server plans with the scenario's model. The vehicle is the scenario's own in the first row;
    in the others it differs as they say, which shows how far the model may be wrong. Of a trigger
    that looks at the state the loop is not linear; it is computed for a packet as often.
    """
    options = command.parse(Options(), argv, "skytether margins", margins.__doc__)
    command.check_count("--runs", options.runs, 1000)
    scenario = options.config
    rows = {lab.AS_IT_IS: scenario}
    rows |= {name: each.of(scenario) for name, each in lab.VEHICLES.items()}
    rates = lab.looks_at_state(scenario)
    total = len(rows) + 1 + rates
    with (
        command.interruptible() as interrupted,
        command.progress("computing margins", total, "parts") as bar,
    ):

        def check(done: int) -> None:
            bar(done)
            if interrupted():
                raise CommandError("interrupted", command.INTERRUPTED)

        if rates:
            scenario = lab.equivalent_period(scenario, stopped=interrupted)
            check(1)
        given = lab.timings(scenario, options.runs, stopped=interrupted)
        check(1 + rates)
        found = []
        for name, each in rows.items():
            alike = msgspec.structs.replace(each, control=scenario.control)
            found.append(lab.margin(alike, name, given))
            check(1 + rates + len(found))
    if options.json is not None:
        content = {"scenario": options.scenario, "trigger": scenario.control.trigger}
        command.write(options.json, msgspec.json.encode(content | {"margins": found}))
    _show(options, scenario, found)


def _show(options: Options, scenario: Scenario, found: Sequence[Margin]) -> None:
    wind, noises = lab.strengths(scenario)
    strengths = f"white wind {wind:g}"
    if any(noises):
        strengths += f", noise {noises[0]:g} m and {noises[1]:g} m/s"
    title = f"{options.scenario}, {options.runs} timings, {strengths}"
    if scenario.control.trigger != options.config.control.trigger:
        print(
            f"control.trigger: {options.config.control.trigger!r} looks at the state, so that the "
            f"loop is not linear: computed for {scenario.control.trigger!r}, which sends as often"
        )
    table = Table(title=title, title_justify="left", min_width=len(title))
    table.add_column("vehicle")
    table.add_column("growth")
    table.add_column("stable")
    for axis in "xyz"[: scenario.model.axes]:
        table.add_column(f"RMS {axis} [m]", justify="right")
    table.add_column("bound", justify="right")
    for each in found:
        half = "" if each.growth_ci95 is None else f" ± {each.growth_ci95:.4f}"
        rms = ["-"] * scenario.model.axes
        if each.rms_m is not None:
            halves: Sequence[Any] = each.rms_ci95_m or [None] * len(rms)
            rms = [
                f"{value:.4f}" + ("" if around is None else f" ± {around:.4f}")
                for value, around in zip(each.rms_m, halves, strict=True)
            ]
        beyond = each.saturated(scenario.u_max.tolist())
        table.add_row(
            each.vehicle,
            f"{each.growth:.4f}{half}",
            "yes" if each.stable else "no",
            *rms,
            "-" if beyond is None else f"{beyond:.1%}",
        )
    command.show(table)
