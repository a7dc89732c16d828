"""Runs over real UDP and TCP: servers, and the robots behind `skytether netem run`."""

import itertools
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from bench.policies import forks
from bench.policies.robot import LATE_S, Flown, RobotRun, cpu_s
from bench.policies.runs import NETWORKS, Cell, Result, seconds_of
from bench.policies.tasks import TASKS
from bench.policies.wire import HEADER_BYTES
from skytether.shell.commandline import command

SKYTETHER = (sys.executable, "-P", "-m", "skytether")
MODULES = ("bench.policies.robot", "skytether.netem.emulator", "skytether.policy.command")
"""Modules that all runs import."""
FAULT_CHARACTERS = 400
PATIENCE_S = 60.0
"""Longest time for a program behind `netem run` to start and end, besides its flight [s]."""
PAUSE_S = 0.001
"""Sleep of `Pauses` [s]."""


class Meter:
    """CPU time of servers, divided among the robots that are served at the same time."""

    def __init__(self) -> None:
        self._lock, self._active, self._used = (
            threading.Lock(),
            dict[int, int](),
            dict[int, float](),
        )
        self._before = dict[int, float]()

    def _count(self, server: int) -> None:
        now_s = cpu_s([server]) - cpu_s([])
        robots = [each for each, at in self._active.items() if at == server]
        for robot in robots:
            self._used[robot] += (now_s - self._before[server]) / len(robots)
        self._before[server] = now_s

    @contextmanager
    def metered(self, robot: int, server: int) -> Iterator[dict[int, float]]:
        """In the block, a robot is served; yields the CPU time of each robot [s]."""
        with self._lock:
            self._count(server)
            self._active[robot], self._used[robot] = server, 0.0
        try:
            yield self._used
        finally:
            with self._lock:
                self._count(server)
                del self._active[robot]


class Pauses(threading.Thread):
    """Thread that sleeps for 1 ms repeatedly, and records by how much it wakes late."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.long: list[tuple[float, float]] = []
        """Time of each late wake, and its lateness [s]."""

    def run(self) -> None:
        while True:
            before_s = time.monotonic()
            time.sleep(PAUSE_S)
            if (late_s := time.monotonic() - before_s - PAUSE_S) > PAUSE_S:
                self.long.append((before_s, late_s))

    def longest_s(self, begin_s: float, end_s: float) -> float:
        return max((late for at, late in self.long if begin_s <= at <= end_s), default=0.0)


@dataclass
class Servers:
    """Policy servers and `policy serve` processes, and what their runs share."""

    forks: str
    """Socket of the process that forks the programs."""
    ports: dict[tuple[str, str], int] = field(default_factory=dict)
    """UDP port by task and system."""
    processes: dict[tuple[str, str], int] = field(default_factory=dict)
    meter: Meter = field(default_factory=Meter)
    pauses: Pauses = field(default_factory=Pauses)
    numbers: Iterator[int] = field(default_factory=lambda: itertools.count(1))
    running: set["subprocess.Popen[bytes]"] = field(default_factory=set)
    """Processes of runs, which end with the servers."""

    def run(self, line: Sequence[str], patience_s: float) -> bytes:
        """Output of a command; raises SubprocessError with its errors."""
        # In a new session, Ctrl-C reaches only this process, which then ends the runs.
        with subprocess.Popen(
            line,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        ) as running:
            self.running.add(running)
            try:
                said, errors = running.communicate(timeout=patience_s)
            finally:
                running.terminate()
                self.running.discard(running)
        if running.returncode:
            raise subprocess.SubprocessError(errors.decode()[-FAULT_CHARACTERS:])
        return said


@contextmanager
def serving(cells: Sequence[Cell]) -> Iterator[Servers]:
    """Start the servers that some cells need; raises CommandError if `netem run` cannot start."""
    rows = {"ours": (), "ours-rows": ("--give-rows",)}
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        servers = Servers(f"{folder}/forks")
        try:
            servers.run([*SKYTETHER, "netem", "run", "--log", "json", "--", "true"], PATIENCE_S)
        except subprocess.SubprocessError as error:
            raise command.CommandError(str(error).strip()) from None
        servers.pauses.start()
        modules = ["gym_pusht"] * any(cell.task == "pusht" for cell in cells)
        stack.enter_context(forks.forking(servers.forks, [*modules, *MODULES]))
        for task in dict.fromkeys(cell.task for cell in cells):
            line = [sys.executable, "-P", "-m", "bench.policies.servers", task]
            ports = json.loads(stack.enter_context(process(line))[0])
            for system in dict.fromkeys(cell.system for cell in cells):
                servers.ports[task, system] = ports["wire"]
                if system not in rows:
                    continue
                line = [*SKYTETHER, "policy", "serve", "--bind", "127.0.0.1:0", "--log", "json"]
                line += ["--upstream", f"ws://127.0.0.1:{ports['tcp']}", *rows[system]]
                said, pid = stack.enter_context(process(line))
                servers.ports[task, system] = json.loads(said)["event"]["port"]
                servers.processes[task, system] = pid
        try:
            yield servers
        finally:
            for running in tuple(servers.running):
                running.terminate()


@contextmanager
def process(line: Sequence[str]) -> Iterator[tuple[str, int]]:
    """Run a command; yields the first line of its output, and its process ID."""
    with subprocess.Popen(
        line, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as running:
        assert running.stdout
        try:
            said = running.stdout.readline()
            threading.Thread(target=running.stdout.read, daemon=True).start()
            yield said, running.pid
        finally:
            running.terminate()


def fly_real(servers: Servers, seconds: float | None, cell: Cell) -> Result:
    """One run over a real network."""
    number, place = next(servers.numbers), (cell.task, cell.system)
    network, seconds = NETWORKS[cell.network], seconds_of(cell, seconds)
    run = RobotRun(cell.task, cell.system, cell.seed, seconds, servers.ports[place], number)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        counted = Path(folder, "netem.json")
        line = ["netem", "run", "--to-program", network, "--from-program", network]
        line += ["--seed", str(cell.seed), "--json", str(counted), "--log", "json", "--"]
        program = [msgspec.json.encode(run).decode()]
        line += forks.line(servers.forks, "bench.policies.robot:main", program)
        line = forks.line(servers.forks, "skytether.__main__:main", line)
        used = {number: 0.0}
        if server := servers.processes.get(place):
            used = stack.enter_context(servers.meter.metered(number, server))
        try:
            figures = msgspec.json.decode(servers.run(line, seconds + PATIENCE_S), type=Flown)
        except (subprocess.SubprocessError, msgspec.DecodeError) as error:
            return Result(cell, None, str(error))
        stack.close()
        counts = json.loads(counted.read_text())
    # TCP without the wire has no headers of the wire.
    extra = 0 if server else HEADER_BYTES
    sent, received = (
        counts[way]["bytes"] - extra * counts[way]["packets"]
        for way in ("from_program", "to_program")
    )
    paused = 0
    for late in figures.late:
        begin_s = late.at_s - late.by_s - TASKS[cell.task].deadline_s
        paused += late.by_s - LATE_S <= late.waited_s + servers.pauses.longest_s(begin_s, late.at_s)
    return Result(cell, figures, "", sent, received, used[number], paused)
