"""Start-up time and memory of the commands.

A command that ends is measured until its end, with its peak memory; a server until it reports that
it listens, and a client until its first packet arrives. *Warm* starts find bytecode and the machine
code of kernels on disk; *cold* starts find neither, as after an installation. The commands take
turns. CPU time is reported besides elapsed time, because it depends less on other load.
"""

import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from bench.children import HOST, PATIENCE_S
from bench.harness import TextTable, median, progress
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import address_text
from skytether.shared.events.processes import Listening
from skytether.shell.processes.log import line_of
from skytether.shell.processes.workers import die_with_parent

MB = 1_000_000
POLL_S = 0.01
"""Interval at which the memory of a command is sampled until the command ends [s]."""


class Start(NamedTuple):
    command: str
    """Arguments of the command line."""
    warm_s: float | None = None
    """Target of a warm start [s]."""
    memory_mb: float | None = None
    """Target of the memory [MB]."""
    cold_s: float | None = None
    """Target of a cold start [s]."""


STARTS = (
    Start("--help"),
    Start("list scenarios"),
    Start("server --help"),
    Start("server demo", warm_s=0.5, memory_mb=120, cold_s=8),
    Start("server paper", warm_s=0.5, memory_mb=120, cold_s=8),
    Start("client demo", memory_mb=40),
    Start("fly demo --virtual --duration 10", warm_s=1),
)


@dataclass(frozen=True)
class StartingCounts:
    warm: int = 9
    cold: int = 1


FULL = StartingCounts()
QUICK = StartingCounts(2, 0)


class StartCost(NamedTuple):
    wall_s: float
    """Elapsed time [s]."""
    cpu_s: float
    """CPU time of all threads [s]."""
    memory_bytes: float
    """Resident memory [B]: at the end of the measurement, or the peak of a command that ended."""


def measure(counts: StartingCounts) -> dict[str, Any]:
    """Costs of each start, as medians of the warm starts and of the cold starts."""
    costs_of: dict[tuple[str, str], list[StartCost]] = {}
    # The first warm start fills the caches on disk, and is not measured.
    turns = [("warm", turn) for turn in range(counts.warm + 1)]
    turns += [("cold", turn + 1) for turn in range(counts.cold)]
    for (kind, turn), (name, *_) in progress([*product(turns, STARTS)], "starting"):
        with tempfile.TemporaryDirectory() as folder:
            nothing = {"NUMBA_CACHE_DIR": f"{folder}/kernels", "PYTHONPYCACHEPREFIX": folder}
            cost = started(name, nothing if kind == "cold" else {})
        if turn:
            costs_of.setdefault((name, kind), []).append(cost)
    costs: dict[str, dict[str, Any]] = {start.command: {} for start in STARTS}
    for (name, kind), kind_costs in costs_of.items():
        costs[name][kind] = StartCost(*map(median, zip(*kind_costs, strict=True)))._asdict()
    return {"starts": costs}


def started(command: str, environment: Mapping[str, str]) -> StartCost:
    """Start a command, and measure its cost.

    Args:
        environment: variables besides those of this process.

    Raises:
        TimeoutError: the process is not ready in time.
        RuntimeError: the command has failed.
    """
    name, *rest = command.split()
    inherited = {key: it for key, it in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    with ExitStack() as stack:
        sink = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        sink.settimeout(PATIENCE_S)
        sink.bind((HOST, 0))
        if ends := name not in ("server", "client") or "--help" in rest:
            more = []
        elif name == "server":
            more = ["--bind", f"{HOST}:0", "--log", "json"]
        else:
            more = ["--server", address_text(*sink.getsockname())]
        began_ns = time.monotonic_ns()
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "skytether", name, *rest, *more],
            env={**inherited, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            preexec_fn=die_with_parent,  # noqa: PLW1509 - one call of the kernel, which takes no lock
        )
        stack.callback(process.wait)
        stack.callback(process.kill)
        assert process.stdout is not None
        stack.enter_context(process.stdout)
        if ends:
            memory_bytes = _peak_bytes(process)
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            if process.returncode:
                raise RuntimeError(f"skytether {command}: exit code {process.returncode}")
        elif name == "server":
            lines = map(line_of, process.stdout)
            if not any(line and isinstance(line.event, Listening) for line in lines):
                raise RuntimeError(f"skytether {command}: ended before it listened")
        else:
            sink.recv(1)
        wall_s = (time.monotonic_ns() - began_ns) / SECOND_NS
        if ends:
            return StartCost(wall_s, used.ru_utime + used.ru_stime, memory_bytes)
        proc = Path(f"/proc/{process.pid}")
        spent_ns = sum(int(each.read_text().split()[0]) for each in proc.glob("task/*/schedstat"))
        pages = int((proc / "statm").read_text().split()[1])
        return StartCost(wall_s, spent_ns / SECOND_NS, pages * os.sysconf("SC_PAGE_SIZE"))


def _peak_bytes(process: subprocess.Popen[bytes]) -> float:
    """Peak memory of a process until it closes its output [B].

    It is read from /proc while the process runs: the kernel's figure for an ended process includes
    memory shared with the parent before `exec`.
    """
    assert process.stdout is not None
    output, status, most_kb = process.stdout.fileno(), Path(f"/proc/{process.pid}/status"), 0
    while True:
        ready, _, _ = select.select([output], [], [], POLL_S)
        fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
        most_kb = max(most_kb, int(fields.get("VmHWM", "0 kB").split()[0]))
        if ready and not os.read(output, 1 << 16):
            return 1024.0 * most_kb


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    rows = []
    for start in STARTS:
        costs = result["starts"][start.command]
        warm, cold = costs["warm"], costs.get("cold")
        row = [
            f"`skytether {start.command}`",
            _shown(f"{warm['wall_s']:.2f}", start.warm_s),
            f"{warm['cpu_s']:.2f}",
            _shown(f"{warm['memory_bytes'] / MB:.0f}", start.memory_mb),
        ]
        if cold:
            row += [_shown(f"{cold['wall_s']:.1f}", start.cold_s), f"{cold['cpu_s']:.1f}"]
        rows.append(row if cold else [*row, "", ""])
    headings = ["start", "warm [s]", "CPU [s]", "memory [MB]", "cold [s]", "CPU [s]"]
    return {"starting": TextTable(headings, rows)}


def _shown(figure: str, target: float | None) -> str:
    return figure if target is None else f"{figure} (≤ {target:g})"
