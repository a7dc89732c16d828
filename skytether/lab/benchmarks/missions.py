"""Random missions over random networks: how near vehicles come to each other and to zones.

    python -m skytether.lab.benchmarks.missions --missions 1000

Each mission has 2 to 32 vehicles in a fence, up to six boxes, cylinders and triangles in their way,
and a network with losses up to one half, bursts up to two seconds and delays up to half a second.
Goals are such that each vehicle has a way to its own. With --harsh every link is also cut again and
again, often for so long that the server takes the vehicle for gone, and in half of the missions the
server dies, and begins anew without memory. With --space they fly at any height, some zones end
below or begin above them, and whoever hears nothing for 40 s lands. All that went wrong is told by
its seed: `--first 17 --missions 1` flies that one again.
"""

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro

from skytether.lab.benchmarks.harness import TextTable
from skytether.lab.benchmarks.kept import flights
from skytether.lab.benchmarks.together import ARRIVED_M, MortalServer, deaths
from skytether.server.missions.routes import Routes
from skytether.shared.base import files
from skytether.shared.base.chance import stream
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading, zones
from skytether.shared.scenario.mission import Mission
from skytether.shared.scenario.schema import Scenario
from skytether.shared.scenario.zones import Zones
from skytether.shared.telemetry.summary import least_separation
from skytether.shared.wire.protocol import Mode
from skytether.shell import command
from skytether.sim import flight

ROOM_M2 = 12.0
"""Area for each vehicle and zone [m²]."""
GOAL_AT_S = 2.0
"""Time from which on all want to be at their goals [s]."""
UP_S, CUT_S = (20.0, 80.0), (2.0, 20.0)
"""Ranges of the mean times between two cuts of a link, and for which it is cut [s]."""
HIGH_M = 6.0
"""Greatest height of a goal in space [m]; the least is a sixth of it."""
MORTAL = 0.5
"""Share of the harsh missions in which the server dies."""


@dataclass(frozen=True)
class MissionsOptions:
    """Amount to fly."""

    missions: int = 100
    first: int = 1
    """Seed of the first."""
    duration: float = 120.0
    """Length of a flight [s]."""
    harsh: bool = False
    """Whether links are cut and servers die."""
    space: bool = False
    """Whether vehicles fly in space."""
    workers: int = 2
    """Number of processes."""
    out: Path | None = None
    """Folder that keeps the missions: after Ctrl-C, or with more, the same command goes on."""
    markdown: Path | None = None
    """File for the table as Markdown."""


class FlownMission(NamedTuple):
    """Result of a mission."""

    seed: int
    vehicles: int
    network: str
    least_m: float
    """Smallest distance between two vehicles [m]."""
    clear_m: float
    """Smallest distance of a vehicle from a zone [m]; infinite without zones."""
    late: int
    """Number of vehicles that have not arrived."""
    arrived_s: float | None
    """Time from the goals to the last arrival [s]; None if one has not."""
    left: int
    """Observations of a vehicle outside its tube."""
    landed: int = 0
    """Number of vehicles that have landed."""


def mission(options: MissionsOptions, seed: int, folder: Path) -> Scenario:
    """A random mission; its table of goals is put into a folder."""
    rng = stream(seed, "mission")
    vehicles = int(rng.integers(2, 33))
    obstacles = int(rng.integers(0, 7))
    half_m = 0.5 * float(np.sqrt(ROOM_M2 * (vehicles + 2 * obstacles))) + 1.0
    shapes = list(_zones(rng, obstacles, half_m))
    file = folder / f"mission{seed}.csv"
    apart_m = reading.load("swap").clearances.apart_m
    kept = zones.parse(" & ".join(shapes), 2)
    places, columns = _places(rng, vehicles, half_m, kept, apart_m), "vehicle,t,x,y"
    if options.space:
        heights = stream(seed, "heights")
        shapes = [_between(heights, each) for each in shapes]
        high_m = heights.uniform(HIGH_M / 6.0, HIGH_M, (2, vehicles, 1))
        places, columns = np.concatenate([places, high_m], axis=2), f"{columns},z"
    rows = [
        ",".join([str(number), str(at_s), *(f"{each:.4f}" for each in place)])
        for number, both in enumerate(places.swapaxes(0, 1), start=1)
        for at_s, place in zip((0.0, GOAL_AT_S), both, strict=True)
    ]
    files.write(file, "\n".join([columns, *rows, ""]).encode())
    table = reading.to_table(reading.load("sphere" if options.space else "swap"))
    table |= {"seed": seed, "duration": options.duration, "settle": 1.0}
    table["reference"] |= {"shape": "mission", "file": str(file)}
    table["mission"]["zones"] = " & ".join(shapes)
    table["link"]["connect_s"] = 60.0
    way = _network(rng)
    if options.harsh:
        cuts = stream(seed, "cuts")
        way += f" & outages({cuts.uniform(*UP_S):.1f}, {cuts.uniform(*CUT_S):.1f})"
    table["network"] |= {"uplink": way, "downlink": way}
    return reading.check(table, f"mission {seed}")


def _zones(rng: np.random.Generator, count: int, half_m: float) -> Iterator[str]:
    yield f"fence({-half_m:.2f}, {half_m:.2f}, {-half_m:.2f}, {half_m:.2f})"
    for _ in range(count):
        x, y = rng.uniform(-0.8 * half_m, 0.8 * half_m, 2)
        wide, deep = rng.uniform(0.3, 2.0, 2)
        match int(rng.integers(3)):
            case 0:
                yield f"box({x:.2f}, {x + wide:.2f}, {y:.2f}, {y + deep:.2f})"
            case 1:
                yield f"cylinder({x:.2f}, {y:.2f}, {wide / 2:.2f})"
            case _:
                turn = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * np.arange(3) / 3
                corners = np.stack([x + wide * np.cos(turn), y + wide * np.sin(turn)], axis=1)
                yield f"polygon({', '.join(f'{each:.2f}' for each in corners.ravel())})"


def _between(heights: np.random.Generator, shape: str) -> str:
    """A box or cylinder between two heights; any other zone as it is."""
    low_m, thick_m = heights.uniform(0.0, HIGH_M), heights.uniform(0.5, 3.0)
    is_high = shape.startswith(("box", "cylinder"))
    return f"{shape[:-1]}, {low_m:.2f}, {low_m + thick_m:.2f})" if is_high else shape


def _places(
    rng: np.random.Generator, vehicles: int, half_m: float, kept: Zones, apart_m: float
) -> Array:
    """Starts and goals of the vehicles [m]; shape (2, vehicles, 2)."""
    room_m = 0.75 * apart_m  # from zones: past a vehicle at its goal there is a way
    routes, found = Routes(kept, room_m), list[Array]()
    while len(found) < 2:
        places = np.zeros((0, 2))
        for _ in range(20_000):
            place = rng.uniform(-half_m, half_m, (1, 2))
            near = np.linalg.norm(places - place, axis=1) < 1.6 * apart_m
            if near.any() or kept.clearance(place).min() < room_m + 0.05:
                continue
            if found and not routes.reaches(found[0][len(places)], place[0]):
                continue
            places = np.concatenate([places, place])
            if len(places) == vehicles:
                found.append(places)
                break
        else:
            found.clear()  # too full: begin anew
    return np.stack(found)


def _network(rng: np.random.Generator) -> str:
    loss = rng.uniform(0.0, 0.5)
    late = (
        "paper(0.4, 0.02, 2)",
        f"constant({rng.uniform(0.0, 0.4):.3f})",
        f"gamma(0.02, {rng.uniform(0.15, 0.5):.3f}, {rng.uniform(0.02, 0.3):.3f})",
    )[int(rng.integers(3))]
    lost = (
        f"loss({loss:.3f})",
        f"gilbert_elliott({0.6 * loss + 0.01:.3f}, {rng.uniform(0.1, 2.0):.2f})",
    )[int(rng.integers(2))]
    return f"{late} & {lost}"


def fly(options: MissionsOptions, seed: int) -> FlownMission:
    """Fly one; to its end, unless all have arrived by half of the time."""
    if not options.harsh:
        found = _flown(replace(options, duration=options.duration / 2.0), seed)
        if not found.late:
            return found
    return _flown(options, seed)


def _flown(options: MissionsOptions, seed: int) -> FlownMission:
    """A mission that is flown to its end."""
    with tempfile.TemporaryDirectory() as folder:
        scenario = mission(options, seed, Path(folder))
        goals, kept = scenario.make_reference(), scenario.zones
        assert isinstance(goals, Mission)
        count = len(goals.vehicles)
        server = None
        if options.harsh and stream(seed, "mortal").random() < MORTAL:
            server = MortalServer(scenario, count, deaths(seed, options.duration))
        record = flight.fly(scenario, vehicles=count, server=server)
    told, client = record.figures["client"]["by_vehicle"], record.client
    each = [client[client["vehicle"] == number] for number in np.unique(client["vehicle"])]
    began_s = [told[str(rows["vehicle"][0])]["began_s"] for rows in each]
    least = least_separation(each, began_s, scenario.control.dt, scenario.mission.height_scale)
    assert least is not None
    arrived_s, clear_m, late = [], [], 0
    for rows in each:
        goal = goals.of(int(rows["vehicle"][0]))(np.array(options.duration))[:, 0]
        away = np.flatnonzero(np.linalg.norm(rows["state"][:, :, 0] - goal, axis=1) > ARRIVED_M)
        last = int(away.max(initial=-1)) + 1
        arrived_s.append(last * scenario.control.dt - GOAL_AT_S)
        late += last == len(rows)
        begins = int(np.argmax(rows["mode"] == Mode.TRACK))
        flown = rows["state"][begins:, :, 0]
        clear_m.append(float(kept.clearance(flown).min(initial=np.inf)))
    return FlownMission(
        seed,
        len(each),
        scenario.network.uplink.text,
        least,
        min(clear_m),
        late,
        None if late else max(arrived_s),
        record.figures["server"]["counts"].get("left_tube", 0),
        sum(bool((rows["mode"] == Mode.LAND).any()) for rows in each),
    )


def table(options: MissionsOptions) -> tuple[TextTable, list[FlownMission]]:
    """Fly all; what was seen, and those of which something is to be told."""
    seeds = range(options.first, options.first + options.missions)
    settings = {
        "first": options.first,
        "duration": options.duration,
        "harsh": options.harsh,
        "space": options.space,
    }
    work = partial(fly, options)
    flown = flights(work, seeds, FlownMission, settings, options.out, options.workers)
    asked_m = reading.load("swap").mission.separation_m
    rows = []
    for low, high in ((2, 8), (9, 16), (17, 24), (25, 32)):
        those = [each for each in flown if low <= each.vehicles <= high]
        if not those:
            continue
        done = [each.arrived_s for each in those if each.arrived_s is not None]
        rows.append(
            [
                f"{low} to {high}",
                str(len(those)),
                f"{min(each.least_m for each in those):.3f}",
                str(sum(each.least_m < asked_m for each in those)),
                f"{min(each.clear_m for each in those):.3f}",
                str(sum(each.clear_m < 0.0 for each in those)),
                str(sum(each.left for each in those)),
                str(sum(each.landed for each in those)),
                str(len(those) - len(done)),
                f"{np.median(done):.0f}, {max(done):.0f}" if done else "-",
            ]
        )
    headings = [
        "vehicles",
        "missions",
        "least separation\n[m]",
        "nearer than\nasked",
        "least distance\nfrom a zone [m]",
        "in a zone",
        "out of a tube",
        "landed",
        "not all\narrived",
        "last arrival\np50, max [s]",
    ]
    told = [
        each
        for each in flown
        if each.least_m < asked_m or each.clear_m < 0.0 or (each.late and not options.harsh)
    ]
    return TextTable(headings, rows), told


def main(argv: Sequence[str]) -> None:
    """Fly as the command line says, and print a table."""
    options = tyro.cli(MissionsOptions, args=argv, description=__doc__)
    found, told = table(options)
    found.show(f"{options.missions} random missions of {options.duration:g} s")
    for each in told:
        print(
            f"seed {each.seed}: {each.vehicles} vehicles, {each.network}: {each.least_m:.3f} m, "
            f"zones {each.clear_m:.3f} m, {each.late} not arrived"
        )
    if options.markdown:
        files.write(options.markdown, found.markdown().encode())


if __name__ == "__main__":
    sys.exit(command.main(main, sys.argv[1:], "missions"))
