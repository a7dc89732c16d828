"""`skytether fly`: one flight, over real UDP or in virtual time, and its summary."""

import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from lab import figures
from shared import config, record
from shared.config import ConfigError, Scenario
from shared.events import Event, ServerHeard, ServerRestarted, ServerSilent
from shared.summary import Summary, summarise
from shell import command
from shell.command import CommandError, ScenarioFlags, ScenarioName
from sim import flight
from skytether import processes


@dataclass(frozen=True)
class Options:
    """Options of `skytether fly`."""

    scenario: ScenarioName = "demo"
    """A scenario's name (see `skytether scenarios`) or a .toml file."""
    virtual: bool = False
    """Fly in virtual time: the same code in one process, reproducible, many times faster."""
    json: Path | None = None
    """File for the summary of the flight."""
    figure: Path | None = None
    """File for a picture of the flight (.png, .pdf or .svg)."""
    beside: str | None = None
    """Another scenario to compare with, flown in virtual time with the same duration and seed."""
    config: ScenarioFlags = Scenario()


def fly(argv: Sequence[str]) -> None:
    """Fly a scenario: server, netem and client as processes on loopback, or in virtual time.

    Every key of the scenario is a flag, as in `--control.trigger always`. Ctrl-C ends the flight
    and still shows what was flown.
    """
    options = command.parse(Options(), argv, "skytether fly", fly.__doc__)
    scenario = options.config
    if options.figure:
        figures.check(options.figure)
    beside = _beside(options)
    where = "in virtual time" if options.virtual else "over UDP on loopback"
    title = f"{options.scenario}, {where}, seed {scenario.seed}"
    with (
        command.interruptible() as interrupted,
        command.progress(f"flying {title}", scenario.duration) as on_second,
    ):
        flown = (_virtually if options.virtual else _really)(scenario, on_second, interrupted)
    if flown.failure:
        raise CommandError(str(flown.failure))
    if not len(flown.client):
        raise CommandError("interrupted before the first step", command.INTERRUPTED)
    flights = {title: (scenario, flown)}
    if beside:
        other = flight.fly(beside)
        other_title = f"{options.beside}, in virtual time, seed {beside.seed}"
        flights[other_title] = beside, other
        command.finish(_summarise(beside, str(options.beside), other), other_title)
    command.finish(_summarise(scenario, options.scenario, flown), title, options.json)
    if options.figure:
        figures.flights(options.figure, flights)


def _beside(options: Options) -> Scenario | None:
    if options.beside is None:
        return None
    same = {key: getattr(options.config, key) for key in ("duration", "seed", "settle")}
    try:
        return msgspec.structs.replace(config.load(options.beside), **same)
    except ConfigError as error:
        raise CommandError(str(error), command.CONFIGURATION) from None


def _summarise(scenario: Scenario, name: str, flown: flight.Flight) -> Summary:
    return summarise(scenario, name, flown.client, flown.server, flown.netem)


def _virtually(
    scenario: Scenario, on_second: Callable[[float], None], interrupted: Callable[[], bool]
) -> flight.Flight:
    return flight.fly(scenario, on_second=on_second, stopped=interrupted)


def _really(
    scenario: Scenario, on_second: Callable[[float], None], interrupted: Callable[[], bool]
) -> flight.Flight:
    with tempfile.TemporaryDirectory(prefix="skytether-") as folder:
        parts = Path(folder)
        processes.run(scenario, parts, on_second=on_second, interrupted=interrupted, on_event=_tell)
        client, server, netem = (record.read(parts / part) for part in processes.NAMES)
        return flight.Flight(client, server, netem)


def _tell(event: Event) -> None:
    """Show what may happen to the link in flight, above the progress bar."""
    if isinstance(event, ServerSilent | ServerHeard | ServerRestarted):
        print(event, file=sys.stderr)
