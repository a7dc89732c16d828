"""Flights of an autopilot over real UDP, encrypted, with a model from `skytether identify`.

`python -m skytether.lab.benchmarks.autopilots_udp FOLDER` repeats a user's steps with both flavours
of the simulated autopilot, each process started by its command: it identifies the model in calm
air, with steps of the size that is flown, and flies with the model over netem, with a key. The best
law of set-points flies on the same seeds. Each flight is repeated with the network cut for a while.
All of it runs in real time: four minutes to identify, and 70 s for each flight. With --write, the
table goes into docs/straight.md.
"""

import asyncio
import contextlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, get_args

import msgspec
import tyro

from skytether.autopilot.flavours import FLAVOURS, FlavourName
from skytether.cli import keygen
from skytether.cli.processes import ANYWHERE, Child, record_of, started
from skytether.lab.benchmarks import autopilots
from skytether.lab.benchmarks.autopilots import (
    CUT_S,
    DOCUMENT,
    HEADINGS,
    HEALED_S,
    Air,
    Cell,
    FlownCell,
    as_it_was,
    contenders,
    judged,
    kept,
    row,
)
from skytether.lab.benchmarks.harness import TextTable, refresh
from skytether.shared.base import files
from skytether.shared.core.events import Flying, address_text
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Record, read
from skytether.shell import command, temporary
from skytether.shell.command import CommandError
from skytether.shell.control import Caller
from skytether.shell.log import LogLine
from skytether.sim.straight import AROUND_S, READY_S
from skytether.station import laws
from skytether.station.joined import joined

CONTENDERS = ("led, gain 0.5", "skytether", "skytether, inputs")
"""Names of the contenders, see `autopilots.contenders`."""


async def identify(flavour: FlavourName, out: Path) -> None:
    """Identify a flavour's model; the scenario is written to a folder.

    Raises:
        CommandError: the identification failed.
    """
    pilots = ("autopilot", f"--flavour={flavour}", f"--ready={READY_S}", *ANYWHERE)
    async with started("autopilot", *pilots) as pilot:
        address = f"--vehicle.address=udpout:{address_text(*pilot.address)}"
        argv = [sys.executable, "-P", "-m", "skytether", "identify", "mavlink", f"--out={out}"]
        argv += ["--scenario=autopilot", "--set-parameters", address]
        process = await asyncio.create_subprocess_exec(*argv, stdout=asyncio.subprocess.DEVNULL)
        if code := await process.wait():
            raise CommandError(f"skytether identify ended with {code}, expected 0")


async def fly(scenario: Scenario, cell: Cell, parts: Path, *, cut: bool) -> Record:
    """Fly a contender to the end; returns a record like that of `autopilots.fly`.

    Args:
        scenario: scenario to fly.
        cell: contender and flavour.
        parts: empty folder for the processes' files.
        cut: whether the network is cut for a while.

    Raises:
        CommandError: the flight did not reach its end.
    """
    law = contenders(cell.flavour)[cell.contender]
    file, keys = parts / "scenario.toml", ("--keys", str(parts / "keys"))
    files.write(file, reading.to_toml(scenario))
    keygen.make(parts / "keys", [1])
    said: list[LogLine] = []
    flies = asyncio.Event()

    def hear(line: LogLine) -> None:
        said.append(line)
        if isinstance(line.event, Flying):
            flies.set()

    async with contextlib.AsyncExitStack() as stack:

        async def start(name: str, *argv: str) -> Child:
            told = (str(file), "--record", str(parts / name), *argv)
            return await stack.enter_async_context(started(name, *told, on_event=hear))

        pilot = (f"--flavour={cell.flavour}", f"--ready={READY_S}")
        if law is None:
            ground = await start("server", *keys, *ANYWHERE)
        else:
            ground = await start("station", *laws.flags(law), *ANYWHERE)
        to_ground = ("--flows=1", "--server", address_text(*ground.address))
        netem = await start("netem", *to_ground, *ANYWHERE, "--control", str(parts / "control"))
        if law is None:
            autopilot = await start("autopilot", *pilot, *ANYWHERE)
            line = f"--vehicle.address=udpout:{address_text(*autopilot.address)}"
            to_netem = ("--server", address_text(*netem.address))
            last = await start("client", *keys, *to_netem, line, "--set-parameters", "--new-flight")
        else:
            await start("autopilot", *pilot, "--to", address_text(*netem.address))
            last = ground
        breaking = [_cut(scenario, parts / "control", flies)] if cut else []
        ends = asyncio.gather(last.end(), *breaking)
        try:
            code, *_ = await asyncio.wait_for(ends, scenario.duration + AROUND_S)
        except TimeoutError:
            raise CommandError(f"{cell}: the flight has not ended") from None
        if code:
            raise CommandError(f"{cell}: {last.last_words()}")
    truth = read(parts / "autopilot").copy()
    if law is not None:
        return joined(scenario, read(parts / "station"), truth, read(parts / "netem"))
    truth["time_ns"] -= min(line.time_ns for line in said)
    return as_it_was(scenario, record_of(parts, scenario, [], said), truth)


async def _cut(scenario: Scenario, control: Path, flies: asyncio.Event) -> None:
    """Cut the network for a while, some time into the flight."""
    await flies.wait()
    for wait_s, loss in (CUT_S, 1.0), (HEALED_S - CUT_S, scenario.network.uplink.loss):
        await asyncio.sleep(wait_s)
        with contextlib.closing(Caller(control)) as caller:
            values = {f"network.{way}.loss": loss for way in ("uplink", "downlink")}
            refused = (await asyncio.to_thread(caller.ask, values)).refused
            assert not refused, refused


async def fly_cell(cell: Cell, model: Mapping[str, Any]) -> FlownCell:
    """Fly a cell twice: the second time with a cut."""
    scenario = autopilots.scenario_of(cell, model)
    with temporary.folder() as parts:
        whole = await fly(scenario, cell, parts, cut=False)
    with temporary.folder() as parts:
        broken = await fly(scenario, cell, parts, cut=True)
    return judged(cell, scenario, whole, broken, secure=True)


def table(flights: list[FlownCell]) -> TextTable:
    """A row for each contender in each air."""
    cases = {(each.flavour, each.air, each.contender) for each in flights}
    rows = [
        row(
            f"{FLAVOURS[case[0]].title}, {case[1]}: {case[2]}",
            [each for each in flights if (each.flavour, each.air, each.contender) == case],
        )
        for case in sorted(cases)
    ]
    return TextTable(HEADINGS, rows)


@dataclass(frozen=True)
class UdpBenchmarkOptions:
    """Options of this benchmark."""

    folder: tyro.conf.Positional[Path]
    """Folder of the identified scenarios, one folder per flavour, and of the figures of every
    flight; existing results are kept."""
    seeds: int = 2
    """Number of seeds, from 1 on."""
    jobs: int = 1
    """Number of flights at once."""
    write: bool = False
    """Put the table into docs/straight.md."""


async def fly_all(options: UdpBenchmarkOptions) -> list[FlownCell]:
    """Identify and fly what is missing; returns all results."""
    free = asyncio.Semaphore(options.jobs)
    flavours = get_args(FlavourName)

    async def model_of(flavour: FlavourName) -> dict[str, Any]:
        out = options.folder / flavour
        async with free:
            if not (out / "scenario.toml").exists():
                await identify(flavour, out)
        model: dict[str, Any] = reading.to_table(reading.load(str(out / "scenario.toml")))["model"]
        return model

    found = await asyncio.gather(*map(model_of, flavours))
    models = dict(zip(flavours, found, strict=True))
    figures = options.folder / "flights.json"
    flights = kept(figures)
    done = {(each.contender, each.flavour, each.air, each.seed) for each in flights}

    async def flown(cell: Cell) -> None:
        async with free:
            flights.append(await fly_cell(cell, models[cell.flavour]))
        command.write(figures, msgspec.json.encode(flights))
        print(*row(str(tuple(cell)), [flights[-1]]), sep=" | ", flush=True)

    seeds = range(1, options.seeds + 1)
    cells = map(Cell._make, product(CONTENDERS, flavours, get_args(Air), seeds))
    await asyncio.gather(*(flown(cell) for cell in cells if cell not in done))
    return flights


def main() -> int:
    """Fly as the command line says, and return the exit code."""
    options = tyro.cli(UdpBenchmarkOptions, description=__doc__)
    options.folder.mkdir(parents=True, exist_ok=True)
    made = table(asyncio.run(fly_all(options)))
    made.show("over UDP")
    if options.write:
        files.write(DOCUMENT, refresh(DOCUMENT.read_text(), {"udp": made}).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
