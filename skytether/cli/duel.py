"""`skytether duel`: scenarios on the same network and seed, side by side on one page."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
import tyro

from skytether.cli import page_process, processes
from skytether.server.schemes import loading
from skytether.shared.base import machine_code
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import summarise
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError
from skytether.shell.commandline.options import read
from skytether.shell.host import temporary
from skytether.shell.host.web import HOST_PORT
from skytether.sim import flight
from skytether.view.browser.flight import PageFlight
from skytether.view.browser.replay import Player
from skytether.view.browser.serve import serve_until_interrupted
from skytether.view.frames import of_flight


@dataclass(frozen=True)
class DuelOptions:
    scenarios: Annotated[tuple[str, ...], Argument(positional=True, metavar="SCENARIO")]
    """Two or more names of scenarios (`skytether list scenarios`) or .toml files. All are flown
    with the network, duration and seed of the first scenario.
    """
    duration: float | None = None
    """Length of the flights [s]; by default the first scenario's."""
    seed: int | None = None
    """Seed of the flights; by default the first scenario's."""
    virtual: bool = False
    """Fly in virtual time; the page shows the flights afterwards, until Ctrl-C."""
    page: str = HOST_PORT
    """HOST:PORT to serve the page on; if the port is taken, the next free port."""
    plugin: command.Plugins = ()


def duel(argv: Sequence[str]) -> None:
    """Fly scenarios side by side, and show them on one page.

    All flights have the same network, wind and seed; a change on the page applies to all flights.
    Ctrl-C ends the flights.
    """
    options = read(DuelOptions(tyro.MISSING), argv, "skytether duel", duel.__doc__)
    at = command.address("--page", options.page)
    scenarios = together(options)
    names = titles(options.scenarios)
    terminal.prepare(machine_code.missing(loading.others(*scenarios)))
    if options.virtual:
        frames = [
            list(of_flight(scenario, name, flight.fly(scenario)))
            for scenario, name in zip(scenarios, names, strict=True)
        ]
        flights = [PageFlight(name) for name in names]
        with closing(Player(flights, frames)) as player:
            serve_until_interrupted(at, flights, now_ns=player.now_ns, more=player.controls)
        return
    _really(scenarios, names, options.page)


def together(options: DuelOptions) -> list[Scenario]:
    """Scenarios of a duel, all with network, duration and seed of the first scenario."""
    if len(options.scenarios) < 2:
        message = f"got {len(options.scenarios)} scenario, expected two or more"
        raise CommandError(message, command.CONFIGURATION)
    overrides = {"duration": options.duration, "seed": options.seed}
    changes = {key: value for key, value in overrides.items() if value is not None}
    first = msgspec.structs.replace(reading.load_base(options.scenarios[0]), **changes)
    same = {key: getattr(first, key) for key in ("duration", "seed", "settle", "network")}
    scenarios = (
        msgspec.structs.replace(reading.load_base(name), **same) for name in options.scenarios
    )
    return [checked(each, name) for each, name in zip(scenarios, options.scenarios, strict=True)]


def checked(scenario: Scenario, name: str) -> Scenario:
    """Return the scenario unchanged; raises ConfigError if it cannot be flown."""
    return reading.check(reading.to_table(scenario), name)


def titles(names: Sequence[str]) -> list[str]:
    """Short names of scenarios, with numbers if several scenarios have the same name."""
    short = [Path(name).stem for name in names]
    return [
        name if short.count(name) == 1 else f"{name} {place}" for place, name in enumerate(short, 1)
    ]


def _really(scenarios: Sequence[Scenario], names: Sequence[str], page: str) -> None:
    def fly(scenario: Scenario, sockets: Path) -> Record:
        run = partial(processes.run, on_second=on_second, interrupted=interrupted, sockets=sockets)
        return processes.flown(scenario, run)

    with ExitStack() as stack:
        folder = stack.enter_context(temporary.folder())
        sockets = [folder / name for name in names]
        for each in sockets:
            each.mkdir(mode=0o700)
        stack.enter_context(page_process.beside(sockets, page))
        interrupted = stack.enter_context(command.interruptible())
        title = f"flying {' and '.join(names)}"
        on_second = stack.enter_context(terminal.progress(title, scenarios[0].duration))
        pool = stack.enter_context(ThreadPoolExecutor(len(names)))
        flights = list(pool.map(fly, scenarios, sockets))
    for scenario, name, record in zip(scenarios, names, flights, strict=True):
        if not len(record.client):
            raise CommandError("interrupted before the first step", command.INTERRUPTED)
        title = f"{name}, over UDP on loopback, seed {scenario.seed}"
        parts = record.client, record.server, record.netem
        terminal.finish(summarise(scenario, name, *parts, figures=record.figures), title)
