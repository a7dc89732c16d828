"""Cells of the benchmark, and results of their runs."""

from typing import NamedTuple

import msgspec

from bench.policies.robot import Flown
from bench.policies.tasks import TASKS

REAL = ("openpi", "lerobot", "drtc", "ours", "ours-rows")
"""Systems over a real network."""
VIRTUAL = ("emulated", "emulated-rows", "networked", "networked-rows")
"""Systems in virtual time; those with rows keep the committed rows, as `ours-rows`."""
BOUNDS = ("oracle", "nothing sent")
OF_BOUNDS = "bounds"
"""Network of the bounds."""
NETWORKS = {
    "none": "none",
    **{
        f"{delay} ms, {loss} %": f"constant({delay / 2:g}ms) & loss({loss}%)"
        for delay in (20, 100, 250)
        for loss in (0, 5, 10)
    },
    "100 ms, outage of 2 s": "constant(50ms) & outage(5, 2)",
    "40 ms, 4 Mbit/s": "constant(20ms) & rate(4mbit)",
}
"""Network impairments of each direction, by name."""


class Cell(NamedTuple):
    task: str
    network: str
    system: str
    seed: int


class Result(msgspec.Struct, frozen=True):
    """Result of a run."""

    cell: Cell
    flown: Flown | None
    fault: str = ""
    """Reason for a run without figures."""
    sent: int = 0
    received: int = 0
    """IP bytes from and to the robot [B]."""
    serve_cpu_s: float = 0.0
    """CPU time of `policy serve`, divided among the robots that it serves at a time [s]."""
    paused: int = 0
    """Number of late answers that are explained by pauses of the machine."""


def seconds_of(cell: Cell, seconds: float | None) -> float:
    """Duration of a run [s]; `seconds`, if given."""
    return seconds or TASKS[cell.task].seconds
