"""Live point moved through the control socket over real UDP, and the same in virtual time.

The point follows the path of a target with the scenario's seed: 20 times a second its position and
velocity are sent to the server's socket, as `skytether set` sends them once. In virtual time the
same values change at the same times. Target and wind are equal in both, to the last bit. But
packets enter the network at other milliseconds, and so have other fates: the spread due to chance
alone is measured by more flights in virtual time, each with another network and wind.

`python -m skytether.lab.benchmarks.lead` flies three seeds of 60 s, which takes about four minutes.
"""

import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import msgspec
import numpy as np
import tyro

from skytether.cli import processes
from skytether.lab.benchmarks.harness import CONSOLE, TextTable, sleep_until
from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.events import Flying
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry import record
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.shell import command
from skytether.shell.control import Caller, ControlError
from skytether.shell.log import LogLine
from skytether.sim.flight import fly

RATE_HZ = 20
"""Rate at which the point is moved [1/s]."""
WITHIN = 0.05
"""Largest allowed relative difference of the figures of all seeds together."""
HEADINGS = ["seed", "UDP", "virtual", "mean", "s.d.", "UDP / virtual", "UDP / mean", "moves", "ms"]
"""Headings: RMSE over UDP and in virtual time, mean and spread over networks, and the moves."""


@dataclass(frozen=True)
class LeadBenchmarkOptions:
    """Options of this benchmark."""

    seeds: tuple[int, ...] = (1, 2, 3)
    """Seeds of target, wind and network."""
    duration: float = 60.0
    """Length of each flight [s]."""
    networks: int = 20
    """Number of networks in virtual time, for each seed; the first is that of the seed."""
    scenario: str = "target-committed"
    """Scenario whose target's path the point follows."""


def main() -> int:
    """Fly and print a table; the exit code is 1 if UDP deviates from the mean of all."""
    options = tyro.cli(LeadBenchmarkOptions, description=__doc__)
    rows: list[list[str]] = []
    each: list[tuple[float, float, float]] = []
    for seed in options.seeds:
        base = msgspec.structs.replace(
            reading.load(options.scenario), seed=seed, duration=options.duration
        )
        led, way = live(base), states(base)
        networks = [seed, *(1000 * seed + other for other in range(1, options.networks))]
        virtual = [
            error(virtually(msgspec.structs.replace(led, seed=network), way))
            for network in networks
        ]
        summary, answered_ms = really(led, way)
        real, expected = error(summary), mean(virtual)
        each.append((real, virtual[0], expected))
        rows.append(
            [
                *(str(seed), f"{real:.4f}", f"{virtual[0]:.4f}", f"{expected:.4f}"),
                *(f"{stdev(virtual):.4f}", f"{real / virtual[0]:.3f}", f"{real / expected:.3f}"),
                *(str(len(answered_ms)), f"{np.median(answered_ms):.1f}"),
            ]
        )
        CONSOLE.print(*HEADINGS, sep=", ")
        CONSOLE.print(*rows[-1], sep=", ")
    together = np.sqrt(np.square(each).mean(axis=0))
    ratios = together[0] / together[1:]
    numbers = [*(f"{value:.4f}" for value in together), "", *(f"{ratio:.3f}" for ratio in ratios)]
    rows.append(["all", *numbers, "", ""])
    title = f"{options.scenario}, led at {RATE_HZ} Hz for {options.duration:g} s"
    TextTable(HEADINGS, rows).show(f"{title}: RMSE xy [m]")
    return int(abs(together[0] / together[2] - 1.0) > WITHIN)


def error(summary: Summary) -> float:
    """RMSE in the plane [m]."""
    assert summary.rmse_xy is not None
    return summary.rmse_xy


def live(base: Scenario) -> Scenario:
    """Scenario with a live point in place of its target, at rest at the origin at first."""
    origin = (0.0,) * base.model.axes
    reference = msgspec.structs.replace(
        base.reference, shape="live", points_m=(origin,), velocity_mps=origin
    )
    table = reading.to_table(msgspec.structs.replace(base, reference=reference))
    return reading.check(table, "benchmarks.lead")


def states(base: Scenario) -> Array:
    """States of the target at each move [m, m/s]; shape (moves, axes, 2)."""
    return base.make_reference()(np.arange(0.0, base.duration, 1.0 / RATE_HZ))


def moved(state: Array) -> dict[str, Any]:
    """Keys and values that move the point."""
    position, velocity = state.T.tolist()
    return {"reference.points_m": [position], "reference.velocity_mps": velocity}


def virtually(led: Scenario, way: Array) -> Summary:
    """Fly in virtual time; the point moves from the moment that the vehicle flies."""
    short = msgspec.structs.replace(led, duration=led.control.dt, settle=0.0)
    began_s = began(fly(short))
    changes = [(began_s + i / RATE_HZ, moved(state)) for i, state in enumerate(way)]
    flown = fly(led, changes=changes)
    return summarise(led, "live", flown.client, flown.server, flown.netem)


def began(flown: Record) -> float:
    """Time at which the vehicle began to fly [s]."""
    times_s = (told.time_ns / SECOND_NS for told in flown.events if isinstance(told.event, Flying))
    return next(times_s)


def really(led: Scenario, way: Array) -> tuple[Summary, Sequence[float]]:
    """Fly over UDP; returns also the response time of each move [ms]."""
    answered_ms: list[float] = []
    flying, over = threading.Event(), threading.Event()

    def hear(line: LogLine) -> None:
        if isinstance(line.event, Flying):
            flying.set()

    def lead(path: Path) -> None:
        flying.wait()
        began_ns = time.monotonic_ns()
        with closing(Caller(path)) as caller:
            for i, state in zip(count(), way, strict=False):
                sleep_until(began_ns + i * SECOND_NS // RATE_HZ)
                if over.is_set():
                    return
                asked_ns = time.monotonic_ns()
                try:
                    answer = caller.ask(moved(state))
                except ControlError:  # the flight has ended
                    return
                assert not answer.refused, answer.refused
                answered_ms.append((time.monotonic_ns() - asked_ns) / 1e6)

    with tempfile.TemporaryDirectory(prefix="skytether-") as folder:
        parts = Path(folder)
        leader = threading.Thread(target=lead, args=(parts / "sockets" / "server",), daemon=True)
        (parts / "sockets").mkdir()
        leader.start()
        with command.interruptible() as interrupted:
            processes.run(
                led,
                parts,
                on_second=lambda _: None,
                interrupted=interrupted,
                on_event=hear,
                control=parts / "sockets",
            )
        over.set()
        flying.set()
        leader.join()
        client, server, netem = (record.read(parts / name) for name in processes.NAMES)
    return summarise(led, "live", client, server, netem), answered_ms


if __name__ == "__main__":
    sys.exit(main())
