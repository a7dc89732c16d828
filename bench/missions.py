"""Benchmark of missions: smallest distances between vehicles and from zones, and arrival times.

    python -m bench.missions random --seeds 1000
    python -m bench.missions swap
    python -m bench.missions published

`random`: each mission has 2 to 32 vehicles in a fence, up to six boxes, cylinders and triangles,
and a network with losses up to 50 %, bursts up to 2 s and delays up to 0.5 s. Each vehicle can
reach its goal. With --harsh every link is also cut repeatedly, often for so long that the server
takes the vehicle as lost, and in half of the missions the server restarts without memory. With
--space they fly with three axes, some zones end below or begin above the vehicles, and a vehicle
without packets for 40 s lands. Every fault is shown with its seed: `--first 17 --seeds 1` flies the
mission of seed 17 again.

`swap`: vehicles swap places on a circle or a sphere, over several networks; with one of them the
server is down three times a flight, for 0.5 to 20 s.

`published`: tasks of published planners, with positions, distances, bounds and noise of the
authors' code. Skytether plans with the same distances, for vehicles with the paper's time constant,
over a good network (20 ms, no loss) and over the paper's with 30 % loss.

- Luis, Vukosavljev and Schoellig (RA-L, 2020), github.com/carlosluis/online_dmpc: `config.json`
  (four cross), `sim_params.m` and `comp_dmpc_bvc.m` (random positions), `run_algorithm.m` (a
  crash).
- Gräfe et al. (DMPC-Swarm, 2025), github.com/Data-Science-in-Mechanical-Engineering/DMPC-Swarm:
  `setpoint_creator.py` (a circle of 1.5 m), `batch_simulation.yaml` (fifteen random positions).
"""

import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, cast

import msgspec
import numpy as np
import tyro

from bench.harness import Study, StudyOptions, TextTable
from skytether.server.endpoint import Server
from skytether.server.missions.routes import RoutesAroundZones
from skytether.shared.base import files
from skytether.shared.base.chance import stream
from skytether.shared.law.model import Array
from skytether.shared.law.motion import MARGIN_M
from skytether.shared.missions import zone_texts
from skytether.shared.missions.derived import clearances, zones
from skytether.shared.missions.mission import Mission
from skytether.shared.missions.zones import Zones
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import NetworkConfig
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import least_separation
from skytether.shared.wire.protocol import Mode
from skytether.shell.commandline import command
from skytether.sim import flight
from skytether.sim.process import VirtualProcess

GOAL_AT_S = 2.0
"""Time from which the goals of random and published missions hold [s]."""
ARRIVED_M, PUBLISHED_ARRIVED_M = 0.3, 0.1
"""Distances from the goal at which a vehicle has arrived [m]; the second: `comp_dmpc_bvc.m`."""
ROOM_M2 = 12.0
"""Area for each vehicle and zone of a random mission [m²]."""
UP_S, CUT_S = (20.0, 80.0), (2.0, 20.0)
"""Ranges of the mean time between two cuts of a link, and of the mean length of a cut [s]."""
HIGH_M = 6.0
"""Greatest height of a goal with --space [m]; the least is a sixth of it."""
MORTAL_SHARE = 0.5
"""Share of the harsh missions in which the server restarts."""
DEATHS, DOWN_S = 3, (0.5, 20.0)
"""Number of times that the server stops, and range of the times that it is down [s]."""
MORTAL = "10 %, a server that dies"
"""Network with which the server restarts."""
SWAP_NETWORKS = {
    "no loss": "paper(0.4, 0.02, 2)",
    "10 % lost": "paper(0.4, 0.02, 2) & loss(0.1)",
    "30 %": "paper(0.4, 0.02, 2) & loss(0.3)",
    "50 %": "paper(0.4, 0.02, 2) & loss(0.5)",
    "30 %, bursts of 2 s": "paper(0.4, 0.02, 2) & gilbert_elliott(0.3, 2)",
    "10 %, all links cut for 5 s every 20 s": "paper(0.4, 0.02, 2) & loss(0.1) & outages(20, 5)",
    MORTAL: "paper(0.4, 0.02, 2) & loss(0.1)",
}
"""Networks, the same in both directions."""
PUBLISHED_NETWORKS = {
    "20 ms": ("constant(0.02)", 0.5),
    "paper, 30 %": ("paper(0.4, 0.02, 2) & loss(0.3)", 1.0),
}
"""Network of both directions, and `link.join_s` [s]."""


@dataclass(frozen=True)
class RandomOptions(StudyOptions):
    """Random missions."""

    seeds: int = 100
    first: int = 1
    """Seed of the first mission."""
    duration: float = 120.0
    """Length of a flight [s]."""
    harsh: bool = False
    """Whether links are cut and servers restart."""
    space: bool = False
    """Whether vehicles fly with three axes."""


@dataclass(frozen=True)
class SwapOptions(StudyOptions):
    """Vehicles that swap places."""

    seeds: int = 30
    shape: Literal["swap", "sphere"] = "swap"
    """Whether vehicles on a circle swap places, or on a sphere."""
    vehicles: int = 16
    duration: float = 120.0
    """Length of a flight [s]."""


@dataclass(frozen=True)
class PublishedOptions(StudyOptions):
    """Tasks of published planners."""

    seeds: int = 10
    duration: float = 90.0
    """Length of a flight [s]."""


class MissionFlight(NamedTuple):
    seed: int
    vehicles: int
    network: str
    least_m: float
    """Smallest distance between two vehicles, with scaled heights [m]."""
    clear_m: float | None
    """Smallest distance of a vehicle from a zone [m]; None without zones."""
    late: int
    arrived_s: float | None
    """Time from the start of the goals until all vehicles stay at them [s]; None if one has not
    arrived."""
    left: int
    """Number of observations of a vehicle outside its tube."""
    landed: int
    packets: float
    """Packets a second, both directions together, per vehicle."""

    @property
    def was_in_zone(self) -> bool:
        return self.clear_m is not None and self.clear_m < 0.0


def fly_mission(
    scenario: Scenario,
    vehicles: int,
    *,
    deaths: Sequence[tuple[float, float]] = (),
    goal_at_s: float = GOAL_AT_S,
    arrived_m: float = ARRIVED_M,
) -> MissionFlight:
    """Fly a scenario to its end, and evaluate the flight.

    Args:
        deaths: times at which the server stops and restarts [s], in order.
        goal_at_s: time from which on the goals hold, on each vehicle's clock [s]; with 0 the
            vehicles' clocks are aligned.
        arrived_m: distance from its goal at which a vehicle has arrived [m].
    """
    record, lives = fly_with_deaths(scenario, vehicles, deaths)
    goals, dt_s, client = scenario.make_reference(), scenario.control.dt, record.client
    assert isinstance(goals, Mission)
    each = [client[client["vehicle"] == number] for number in np.unique(client["vehicle"])]
    figures = record.figures["client"]["by_vehicle"]
    began_s = [figures[str(rows["vehicle"][0])]["began_s"] for rows in each]
    least = least_separation(each, began_s, dt_s, scenario.mission.height_scale)
    assert least is not None
    arrived_s, clear_m, late = [], [], 0
    for rows, began in zip(each, began_s, strict=True):
        goal = goals.of(int(rows["vehicle"][0]))(np.array(scenario.duration))[:, 0]
        away = np.flatnonzero(np.linalg.norm(rows["state"][:, :, 0] - goal, axis=1) > arrived_m)
        last = int(away.max(initial=-1)) + 1
        late += last == len(rows)
        arrived_s.append(last * dt_s - (goal_at_s or min(began_s) - began))
        positions = rows["state"][int(np.argmax(rows["mode"] == Mode.TRACK)) :, :, 0]
        clear_m.append(float(zones(scenario).clearance(positions).min(initial=np.inf)))
    packets = sum(record.figures["netem"][way]["packets"] for way in ("uplink", "downlink"))
    counts = Counter[str]()
    for life in lives:
        counts.update(life.figures()["counts"])
    return MissionFlight(
        seed=scenario.seed,
        vehicles=len(each),
        network=scenario.network.uplink,
        least_m=least,
        clear_m=min(clear_m) if zones(scenario) else None,
        late=late,
        arrived_s=None if late else max(arrived_s),
        left=counts["left_tube"],
        landed=sum(bool((rows["mode"] == Mode.LAND).any()) for rows in each),
        packets=packets / (vehicles * scenario.duration),
    )


def fly_with_deaths(
    scenario: Scenario, vehicles: int, deaths: Sequence[tuple[float, float]]
) -> tuple[Record, list[Server]]:
    """Flight in which the server stops and restarts at `deaths` [s]; and all runs of the server."""
    lives: list[Server] = []

    def live(number: int) -> Server:
        entropy = stream(scenario.seed, "mortal", number).bytes
        lives.append(Server(scenario, boot_id=1 + number, entropy=entropy, capacity=vehicles))
        return lives[-1]

    server = VirtualProcess(flight.SERVER[0], live)
    actions = [each for down, up in deaths for each in ((down, server.kill), (up, server.start))]
    return flight.fly(scenario, vehicles=vehicles, server=lives[0], actions=actions), lives


def deaths(seed: int, duration: float) -> list[tuple[float, float]]:
    """Random times at which a server stops and restarts [s]."""
    rng = stream(seed, "deaths")
    begins = rng.uniform(np.arange(DEATHS), np.arange(DEATHS) + 1.0) * duration / DEATHS
    for_s = rng.uniform(*DOWN_S, DEATHS)
    ends = np.minimum(begins + for_s, np.append(begins[1:], np.inf) - 1.0)
    return [(b, e) for b, e in zip(begins.tolist(), ends.tolist(), strict=True) if e > b]


def mission_scenario(
    name: str, seed: int, duration: float, goals: Array, folder: Path
) -> dict[str, Any]:
    """Table of a scenario with other starts and goals [m]; shape (2, vehicles, axes)."""
    rows = [
        ",".join([str(number), str(at_s), *(f"{each:.4f}" for each in place)])
        for number, both in enumerate(goals.swapaxes(0, 1), start=1)
        for at_s, place in zip((0.0, GOAL_AT_S), both, strict=True)
    ]
    file = folder / f"mission{seed}.csv"
    columns = ",".join(["vehicle", "t", *"xyz"[: goals.shape[2]]])
    files.write(file, "\n".join([columns, *rows, ""]).encode())
    table = reading.to_table(reading.load(name))
    table |= {"seed": seed, "duration": duration, "settle": 1.0}
    table["reference"] |= {"shape": "mission", "file": str(file)}
    return table


def arrivals(flown: Sequence[MissionFlight]) -> str:
    done = [each.arrived_s for each in flown if each.arrived_s is not None]
    return f"{np.median(done):.1f}, {max(done):.1f}" if done else "-"


# -- random missions -------------------------------------------------------------------------


def random_mission(options: RandomOptions, seed: int, folder: Path) -> Scenario:
    """Random mission; its table of goals is written to a folder."""
    rng = stream(seed, "mission")
    vehicles = int(rng.integers(2, 33))
    obstacles = int(rng.integers(0, 7))
    half_m = 0.5 * float(np.sqrt(ROOM_M2 * (vehicles + 2 * obstacles))) + 1.0
    shapes = list(_zones(rng, obstacles, half_m))
    apart_m = clearances(reading.load("swap")).apart_m
    forbidden = zone_texts.parse(" & ".join(shapes), 2)
    places = _places(rng, vehicles, half_m, forbidden, apart_m)
    if options.space:
        heights = stream(seed, "heights")
        shapes = [_between(heights, each) for each in shapes]
        high_m = heights.uniform(HIGH_M / 6.0, HIGH_M, (2, vehicles, 1))
        places = np.concatenate([places, high_m], axis=2)
    name = "sphere" if options.space else "swap"
    table = mission_scenario(name, seed, options.duration, places, folder)
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
    """Box or cylinder limited to random heights; any other zone unchanged."""
    low_m, thick_m = heights.uniform(0.0, HIGH_M), heights.uniform(0.5, 3.0)
    is_high = shape.startswith(("box", "cylinder"))
    return f"{shape[:-1]}, {low_m:.2f}, {low_m + thick_m:.2f})" if is_high else shape


def _places(
    rng: np.random.Generator, vehicles: int, half_m: float, forbidden: Zones, apart_m: float
) -> Array:
    """Starts and goals of the vehicles [m]; shape (2, vehicles, 2)."""
    room_m = 0.75 * apart_m  # from zones, so that others can pass a vehicle at its goal
    routes, chosen = RoutesAroundZones(forbidden, room_m), list[Array]()
    while len(chosen) < 2:
        places = np.zeros((0, 2))
        for _ in range(20_000):
            place = rng.uniform(-half_m, half_m, (1, 2))
            near = np.linalg.norm(places - place, axis=1) < 1.6 * apart_m
            if near.any() or forbidden.clearance(place).min() < room_m + 0.05:
                continue
            if chosen and not routes.reaches(chosen[0][len(places)], place[0]):
                continue
            places = np.concatenate([places, place])
            if len(places) == vehicles:
                chosen.append(places)
                break
        else:
            chosen.clear()  # too crowded: start again
    return np.stack(chosen)


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


def fly_random(options: RandomOptions, seed: int) -> MissionFlight:
    """Fly a random mission, and only half of its duration if all vehicles have arrived by then."""
    if not options.harsh:
        half = _fly_random(replace(options, duration=options.duration / 2.0), seed)
        if not half.late:
            return half
    return _fly_random(options, seed)


def _fly_random(options: RandomOptions, seed: int) -> MissionFlight:
    with tempfile.TemporaryDirectory() as folder:
        scenario = random_mission(options, seed, Path(folder))
        goals = scenario.make_reference()
        assert isinstance(goals, Mission)
        dies = options.harsh and stream(seed, "mortal").random() < MORTAL_SHARE
        when = deaths(seed, options.duration) if dies else []
        return fly_mission(scenario, len(goals.vehicles), deaths=when)


def random_cells(options: RandomOptions, seeds: int) -> Sequence[int]:
    return range(options.first, options.first + seeds)


def random_tables(options: RandomOptions, flights: Sequence[MissionFlight]) -> dict[str, TextTable]:
    """Table of all missions, and of those with a fault, if there are any."""
    asked_m = reading.load("swap").mission.separation_m
    rows = []
    for low, high in ((2, 8), (9, 16), (17, 24), (25, 32)):
        if those := [each for each in flights if low <= each.vehicles <= high]:
            figures = (
                len(those),
                f"{min(each.least_m for each in those):.3f}",
                f"{min(each.clear_m for each in those if each.clear_m is not None):.3f}",
                sum(each.left for each in those),
                sum(each.landed for each in those),
                sum(each.late > 0 for each in those),
                arrivals(those),
            )
            rows.append([f"{low} to {high}", *map(str, figures)])
    headings = [
        "vehicles",
        "missions",
        "least separation\n[m]",
        "least distance\nfrom a zone [m]",
        "out of a tube",
        "landed",
        "not all\narrived",
        "last arrival\np50, max [s]",
    ]
    shown = {"random missions": TextTable(headings, rows)}
    faults = [
        [
            f"seed {each.seed}",
            each.network,
            f"{each.least_m:.3f}",
            f"{each.clear_m:.3f}",
            str(each.late),
        ]
        for each in flights
        if each.least_m < asked_m or each.was_in_zone or (each.late and not options.harsh)
    ]
    if faults:
        headings = ["fault", "network", "least separation [m]", "from a zone [m]", "not arrived"]
        shown["faults"] = TextTable(headings, faults)
    return shown


# -- vehicles that swap places --------------------------------------------------------------


def swap_scenario(network: str, options: SwapOptions, seed: int) -> Scenario:
    swap = reading.load(options.shape)
    way = SWAP_NETWORKS[network]
    reference = msgspec.structs.replace(
        swap.reference, shape=f"{options.shape}({options.vehicles})"
    )
    return msgspec.structs.replace(
        swap,
        seed=seed,
        duration=options.duration,
        reference=reference,
        network=NetworkConfig(uplink=way, downlink=way),
    )


def fly_swap(options: SwapOptions, cell: tuple[int, str]) -> MissionFlight:
    seed, network = cell
    when = deaths(seed, options.duration) if network == MORTAL else []
    scenario = swap_scenario(network, options, seed)
    return fly_mission(scenario, options.vehicles, deaths=when, goal_at_s=0.0)


def swap_cells(seeds: int) -> list[tuple[int, str]]:
    # Seeds in the outer loop, so that more flights only add cells at the end.
    return list(product(range(1, seeds + 1), SWAP_NETWORKS))


def swap_tables(flown: Sequence[MissionFlight]) -> dict[str, TextTable]:
    rows = []
    for i, network in enumerate(SWAP_NETWORKS):
        flights = flown[i :: len(SWAP_NETWORKS)]
        figures = (
            f"{min(each.least_m for each in flights):.3f}",
            f"{sum(not each.late for each in flights)} of {len(flights)}",
            arrivals(flights),
            f"{np.mean([each.packets for each in flights]):.2f}",
            sum(each.left for each in flights),
        )
        rows.append([network, *map(str, figures)])
    headings = [
        "network",
        "least separation\n[m]",
        "flights\nin which all arrived",
        "last arrival\np50, max [s]",
        "packets/s\na vehicle",
        "out of a tube",
    ]
    return {"swap": TextTable(headings, rows)}


# -- tasks of published planners -------------------------------------------------------------


class Task(NamedTuple):
    vehicles: int
    separation_m: float
    """Distance below which two vehicles count as crashed [m]."""
    tube_m: float
    """Half of the additional distance that the authors' plans keep [m]."""
    stretch: float
    """Factor of the distance between vehicles that fly one above the other."""
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    """Corners of the box of random positions [m]."""
    circle_m: float = 0.0
    """Radius of the circle on which vehicles swap places [m]; 0: random positions."""


TASKS = {
    "Luis 2020: four cross": Task(4, 0.2, 0.05, 2.0, (0, 0, 1), (0, 0, 1), np.sqrt(2.0)),
    "Luis 2020: 20 in 4 m³": Task(
        20, 0.2, 0.05, 2.0, (-0.7937, -0.7937, 0.2), (0.7937, 0.7937, 1.7874)
    ),
    "Luis 2020: 30 in 18 m³": Task(30, 0.2, 0.05, 2.0, (-1.5, -1.5, 0.2), (1.5, 1.5, 2.2)),
    "DMPC-Swarm: 6 on a circle": Task(6, 0.2, 0.1, 4.0, (0, 0, 1), (0, 0, 1), 1.5),
    "DMPC-Swarm: 15 random": Task(15, 0.2, 0.1, 4.0, (-1.9, -1.9, 0.4), (1.9, 1.9, 2.9)),
}


def places(task: Task, rng: np.random.Generator) -> tuple[Array, Array]:
    """Starts and goals of the vehicles [m]; two of shape (vehicles, 3)."""
    if task.circle_m:
        angle = 2.0 * np.pi * (np.arange(task.vehicles) / task.vehicles) + np.pi / 4.0
        on = task.circle_m * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        return on + np.array(task.low_m), -on + np.array(task.low_m)
    keep_m = task.separation_m + 2.0 * task.tube_m
    scale = np.array([1.0, 1.0, 1.0 / task.stretch])
    return _spread(task, rng, keep_m, scale), _spread(task, rng, keep_m, scale)


def _spread(task: Task, rng: np.random.Generator, keep_m: float, scale: Array) -> Array:
    while True:
        chosen = np.zeros((0, 3))
        for _ in range(20_000):
            place = rng.uniform(task.low_m, task.high_m)
            if (np.linalg.norm((chosen - place) * scale, axis=1) > keep_m + 1e-3).all():
                chosen = np.append(chosen, place[None], axis=0)
            if len(chosen) == task.vehicles:
                return chosen


def published_scenario(
    task: Task, network: str, duration: float, seed: int, folder: Path
) -> Scenario:
    """Scenario of a task; its table of goals is written to a folder."""
    goals = np.stack(places(task, stream(seed, "published")))
    table = mission_scenario("sphere", seed, duration, goals, folder)
    table["mission"] |= {
        "separation_m": task.separation_m,
        "height_m": task.separation_m * task.stretch,
        "tube_m": task.tube_m - 0.5 * MARGIN_M,  # Skytether's plans add MARGIN_M
        "acceleration_mps2": 1.0,
    }
    # A vehicle above another one must not land.
    table["vehicle"] |= {"wind": 0.0, "land_after_s": 0.0}
    table["sensor"] |= {"position_noise_m": 0.00228682, "velocity_noise_mps": 0.0109302}
    way, table["link"]["join_s"] = PUBLISHED_NETWORKS[network]
    table["network"] |= {"uplink": way, "downlink": way}
    return reading.check(table, "published")


def fly_published(options: PublishedOptions, cell: tuple[int, tuple[str, str]]) -> MissionFlight:
    seed, (name, network) = cell
    with tempfile.TemporaryDirectory() as folder:
        task = TASKS[name]
        scenario = published_scenario(task, network, options.duration, seed, Path(folder))
        return fly_mission(scenario, task.vehicles, arrived_m=PUBLISHED_ARRIVED_M)


PUBLISHED = tuple(product(TASKS, PUBLISHED_NETWORKS))


def published_cells(seeds: int) -> list[tuple[int, tuple[str, str]]]:
    return list(product(range(1, seeds + 1), PUBLISHED))


def published_tables(flown: Sequence[MissionFlight]) -> dict[str, TextTable]:
    rows = []
    for i, (name, network) in enumerate(PUBLISHED):
        flights = flown[i :: len(PUBLISHED)]
        figures = (
            f"{TASKS[name].separation_m:g}",
            f"{min(each.least_m for each in flights):.3f}",
            f"{sum(not each.late for each in flights)} of {len(flights)}",
            arrivals(flights),
        )
        rows.append([f"{name}, {network}", *figures])
    headings = [
        "task, network",
        "a crash\nbelow [m]",
        "least separation\n[m]",
        "flights\nin which all arrived",
        "last arrival\np50, max [s]",
    ]
    return {"published": TextTable(headings, rows)}


Options = (
    Annotated[RandomOptions, tyro.conf.subcommand("random")]
    | Annotated[SwapOptions, tyro.conf.subcommand("swap")]
    | Annotated[PublishedOptions, tyro.conf.subcommand("published")]
)


def study_of(options: Any) -> Study[Any, MissionFlight]:
    """Study of the missions of some options."""
    parts: tuple[Any, Any, Any] = published_cells, fly_published, published_tables
    if isinstance(options, RandomOptions):
        parts = partial(random_cells, options), fly_random, partial(random_tables, options)
    elif isinstance(options, SwapOptions):
        parts = swap_cells, fly_swap, swap_tables
    cells, fly, tables = parts
    common = StudyOptions.__dataclass_fields__
    settings = {key: value for key, value in asdict(options).items() if key not in common}
    flying = partial(fly, options)
    return Study(__doc__, cells, flying, MissionFlight, tables, options.seeds, settings)


def main(argv: Sequence[str]) -> None:
    options = tyro.cli(cast(Any, Options), args=argv, description=__doc__)
    study_of(options).show(options)


if __name__ == "__main__":
    sys.exit(command.main(main, sys.argv[1:], "missions"))
