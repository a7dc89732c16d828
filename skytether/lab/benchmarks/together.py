"""Vehicles that swap places over bad networks, and what happens without the guarantee.

    python -m skytether.lab.benchmarks.together

Each cell is so many flights of the scenario `swap` in virtual time: how near two vehicles came, how
often nearer than asked for, and when the last arrived. In one the server dies three times a flight,
for 0.5 to 20 s, and begins anew without memory. Beside it flies a planner for vehicles that, when
they hear nothing, may brake anywhere on their way, and need not fly it to its end. Two more forget
what may be flown: one keeps apart from the newest motion of each vehicle, as if every packet
arrived, and one from nothing, as vehicles do that fly to their goals by themselves.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import msgspec
import numpy as np
import tyro

from skytether.lab.benchmarks.harness import TextTable
from skytether.lab.benchmarks.kept import flights
from skytether.server.endpoint import Server
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.server.missions.possible_motions import KNOTS
from skytether.server.missions.unconstrained_motion import UnconstrainedPlanner
from skytether.server.missions.vehicle_motions import VehicleMotions
from skytether.shared.base import files
from skytether.shared.base.chance import stream
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.core.endpoint import Datagram, Endpoint
from skytether.shared.core.events import Event
from skytether.shared.law.model import Flags
from skytether.shared.law.motion import SPACING, Clearances, Motion
from skytether.shared.scenario import reading
from skytether.shared.scenario.mission import Mission
from skytether.shared.scenario.schema import DirectionConfig, NetworkConfig, Scenario
from skytether.shared.telemetry.summary import least_separation
from skytether.shell import command
from skytether.sim import flight

NETWORKS = {
    "no loss": "paper(0.4, 0.02, 2)",
    "10 % lost": "paper(0.4, 0.02, 2) & loss(0.1)",
    "30 %": "paper(0.4, 0.02, 2) & loss(0.3)",
    "50 %": "paper(0.4, 0.02, 2) & loss(0.5)",
    "30 %, bursts of 2 s": "paper(0.4, 0.02, 2) & gilbert_elliott(0.3, 2)",
    "10 %, all links cut for 5 s every 20 s": "paper(0.4, 0.02, 2) & loss(0.1) & outages(20, 5)",
    "10 %, a server that dies": "paper(0.4, 0.02, 2) & loss(0.1)",
}
"""Networks, both ways alike."""
MORTAL = "10 %, a server that dies"
"""Network with which the server dies."""
DEATHS, DOWN_S = 3, (0.5, 20.0)
"""Number of times that the server dies, and shortest and longest time that it is down [s]."""
ALL, BRAKING = "all that may be flown", "the same, braked anywhere"
NEWEST, NOTHING = "the newest alone", "nothing"
PLANNERS = (ALL, BRAKING, NEWEST, NOTHING)
"""Motions of others that each planner keeps apart from."""
SWAP = reading.load("swap")
"""Scenario that is flown."""
ARRIVED_M = 0.3
"""Distance from its goal at which a vehicle has arrived [m]."""


@dataclass(frozen=True)
class TogetherOptions:
    """Amount to fly."""

    flights: int = 30
    """Flights of each cell."""
    guaranteed: bool = False
    """Whether to fly only what keeps apart from all that may be flown."""
    shape: Literal["swap", "sphere"] = "swap"
    """Whether vehicles on a circle swap places, or on a sphere."""
    vehicles: int = 16
    duration: float = 120.0
    """Length of a flight [s]."""
    workers: int = 2
    """Number of processes."""
    out: Path | None = None
    """Folder that keeps the flights: after Ctrl-C, or with more, the same command goes on."""
    markdown: Path | None = None
    """File for the table as Markdown."""


class Swap(NamedTuple):
    """Result of a flight."""

    least_m: float
    """Smallest distance between two vehicles [m]."""
    arrived_s: float | None
    """Time at which the last vehicle was at its goal for good [s]; None if one never was."""
    packets: float
    """Packets a second both ways, of a vehicle."""
    left: int
    """Observations of a vehicle outside its tube."""


class MortalServer(Endpoint):
    """A server that is not there at some times, and begins anew after each without its memory.

    Args:
        scenario: what is flown.
        room: number of vehicles.
        deaths: when it dies and begins anew, since it began [s], in order.
    """

    def __init__(
        self, scenario: Scenario, room: int, deaths: Sequence[tuple[float, float]]
    ) -> None:
        super().__init__()
        self._scenario, self._room = scenario, room
        self._deaths = [(seconds_to_ns(from_s), seconds_to_ns(to_s)) for from_s, to_s in deaths]
        self._epoch_ns: int | None = None
        self._lives = 0
        self._left = 0
        """Observations outside a tube in lives that are over."""
        self._server: Server | None = self._begin()

    def _begin(self) -> Server:
        self._lives += 1
        entropy = stream(self._scenario.seed, "mortal", self._lives).bytes
        return Server(self._scenario, boot_id=self._lives, entropy=entropy, room=self._room)

    def _alive(self, now_ns: int) -> Server | None:
        """The server that lives now; None while there is none."""
        if self._epoch_ns is None:
            self._epoch_ns = now_ns
        while self._deaths and now_ns >= self._epoch_ns + self._deaths[0][0]:
            if self._server:
                self._left += self._server.figures()["counts"].get("left_tube", 0)
            self._server = None
            if now_ns < self._epoch_ns + self._deaths[0][1]:
                return None
            self._deaths.pop(0)
            self._server = self._begin()
        return self._server

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """See `Endpoint`."""
        if server := self._alive(now_ns):
            server.receive(datagram, now_ns=now_ns)

    def wake(self, *, now_ns: int) -> None:
        """See `Endpoint`."""
        if server := self._alive(now_ns):
            server.wake(now_ns=now_ns)

    def next_wake_ns(self) -> int | None:
        """See `Endpoint`."""
        due_ns = self._server.next_wake_ns() if self._server else None
        if not self._deaths or self._epoch_ns is None:
            return due_ns
        changes_ns = self._epoch_ns + self._deaths[0][self._server is None]
        return changes_ns if due_ns is None else min(due_ns, changes_ns)

    def outbox(self) -> list[Datagram]:
        """See `Endpoint`."""
        return self._server.outbox() if self._server else []

    def events(self) -> Sequence[Event]:
        """See `Endpoint`."""
        return self._server.events() if self._server else ()

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`; observations outside a tube are those of all lives."""
        told = self._server.figures() if self._server else {"counts": {}}
        told["counts"]["left_tube"] = self._left + told["counts"].get("left_tube", 0)
        return told


def deaths(seed: int, duration: float) -> list[tuple[float, float]]:
    """Times at which a server dies and is started again, drawn from a seed [s]."""
    rng = stream(seed, "deaths")
    begins = rng.uniform(np.arange(DEATHS), np.arange(DEATHS) + 1.0) * duration / DEATHS
    for_s = rng.uniform(*DOWN_S, DEATHS)
    ends = np.minimum(begins + for_s, np.append(begins[1:], np.inf) - 1.0)
    return [(b, e) for b, e in zip(begins.tolist(), ends.tolist(), strict=True) if e > b]


@contextmanager
def planning(planner: str) -> Iterator[None]:
    """Have the server keep apart from some motions alone."""
    motions, clearances = VehicleMotions.motions, cast(property, Scenario.clearances)
    hits, straight = MissionPlanner._conflicts, UnconstrainedPlanner.motions

    def newest(self: VehicleMotions) -> list[Motion]:
        return motions(self)[-1:]

    def braked_too(self: VehicleMotions) -> list[Motion]:
        found, since = motions(self), self.in_force.step if self.in_force else 0
        return found + [stop for motion in found for stop in stops(motion, since)]

    def also_braked(self: MissionPlanner, row: int, motion: Motion, k: int) -> Flags:
        each = (motion, *stops(motion, k))
        return np.logical_or.reduce([hits(self, row, flown, k) for flown in each])

    def touching(self: Scenario) -> Clearances:
        return cast(Clearances, clearances.__get__(self))._replace(apart_m=-1.0)

    vehicle, scenario = cast(Any, VehicleMotions), cast(Any, Scenario)
    planner_type, unconstrained = cast(Any, MissionPlanner), cast(Any, UnconstrainedPlanner)
    if planner == BRAKING:
        vehicle.motions, planner_type._conflicts = braked_too, also_braked
        unconstrained.motions = lambda *_: []  # of a vehicle that is not braked
    if planner == NEWEST:
        vehicle.motions = newest
    if planner == NOTHING:
        scenario.clearances = property(touching)
    try:
        yield
    finally:
        vehicle.motions, scenario.clearances = motions, clearances
        planner_type._conflicts, unconstrained.motions = hits, straight


def stops(motion: Motion, since: int) -> list[Motion]:
    """Motions of a vehicle that brakes on its way, from each knot after a step on.

    A failsafe takes about as far, with the time constant and the deceleration of the scenario.
    """
    dt_s, found = SWAP.control.dt, []
    T, slower = SPACING * dt_s, SPACING * dt_s * SWAP.mission.acceleration_mps2
    for knot in range(max(-(-(since - motion.first) // SPACING), 0), len(motion.position) - 1):
        position, velocity = [*motion.position[: knot + 1]], [*motion.velocity[: knot + 1]]
        while velocity[-1].any():
            v = np.sign(velocity[-1]) * np.maximum(np.abs(velocity[-1]) - slower, 0.0)
            position.append(position[-1] + 0.5 * T * (velocity[-1] + v))
            velocity.append(v)
        if motion.velocity[knot].any() and len(position) <= KNOTS:
            found.append(Motion(motion.first, np.array(position), np.array(velocity)))
    return found


def scenario(network: str, options: TogetherOptions, seed: int) -> Scenario:
    """A flight of a cell."""
    swap = reading.load(options.shape)
    way = DirectionConfig(impairments=NETWORKS[network])
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


def fly(options: TogetherOptions, cell: tuple[str, str, int]) -> Swap:
    """Fly one."""
    network, planner, seed = cell
    flown = scenario(network, options, seed)
    with planning(planner):
        server = None
        if network == MORTAL:
            server = MortalServer(flown, options.vehicles, deaths(seed, options.duration))
        record = flight.fly(flown, vehicles=options.vehicles, server=server)
    told = record.figures["client"]["by_vehicle"]
    client, dt_s = record.client, flown.control.dt
    each = [client[client["vehicle"] == number] for number in np.unique(client["vehicle"])]
    began_s = [told[str(rows["vehicle"][0])]["began_s"] for rows in each]
    least = least_separation(each, began_s, dt_s, flown.mission.height_scale)
    goals = flown.make_reference()
    assert isinstance(goals, Mission)
    assert least is not None
    arrived_s, is_late = [], False
    for rows, began in zip(each, began_s, strict=True):
        goal = goals.of(int(rows["vehicle"][0]))(np.array(options.duration))[:, 0]
        away = np.flatnonzero(np.linalg.norm(rows["state"][:, :, 0] - goal, axis=1) > ARRIVED_M)
        last = int(away.max(initial=-1)) + 1
        arrived_s.append(began + last * dt_s)
        is_late |= last == len(rows)
    packets = sum(record.figures["netem"][way]["packets"] for way in ("uplink", "downlink"))
    left = record.figures["server"]["counts"].get("left_tube", 0)
    share = options.vehicles * options.duration
    return Swap(least, None if is_late else max(arrived_s) - min(began_s), packets / share, left)


def table(options: TogetherOptions) -> TextTable:
    """Fly every cell."""
    planners = PLANNERS[: 1 if options.guaranteed else None]
    kinds = [(network, planner) for planner in planners for network in NETWORKS]
    # By seeds first, so that more flights only add to the end.
    cells = [(*kind, seed) for seed in range(1, options.flights + 1) for kind in kinds]
    settings = {
        "guaranteed": options.guaranteed,
        "shape": options.shape,
        "vehicles": options.vehicles,
        "duration": options.duration,
    }
    done = flights(partial(fly, options), cells, Swap, settings, options.out, options.workers)
    asked = reading.load(options.shape).mission.separation_m
    rows = []
    for i, (network, planner) in enumerate(kinds):
        flown = done[i :: len(kinds)]
        least = np.array([each.least_m for each in flown])
        arrived = [each.arrived_s for each in flown if each.arrived_s is not None]
        rows.append(
            [
                f"{planner}, {network}",
                f"{least.min():.3f}",
                f"{int((least < asked).sum())} of {len(flown)}",
                f"{len(arrived)}",
                f"{np.median(arrived):.0f}, {max(arrived):.0f}" if arrived else "-",
                f"{np.mean([each.packets for each in flown]):.2f}",
                f"{sum(each.left for each in flown)}",
            ]
        )
    headings = [
        "kept apart from, network",
        "least separation\n[m]",
        "flights\nnearer than asked",
        "flights\nin which all arrived",
        "last arrival\np50, max [s]",
        "packets/s\na vehicle",
        "out of a tube",
    ]
    return TextTable(headings, rows)


def main(argv: Sequence[str]) -> None:
    """Fly as the command line says, and print a table."""
    options = tyro.cli(TogetherOptions, args=argv, description=__doc__)
    found = table(options)
    found.show(f"{options.vehicles} vehicles swap places, {options.flights} flights a cell")
    if options.markdown:
        files.write(options.markdown, found.markdown().encode())


if __name__ == "__main__":
    sys.exit(command.main(main, sys.argv[1:], "together"))
