"""Benchmark of a policy on another machine: openpi's client with and without `skytether policy`.

The robot is a pendulum that keeps moving during a call; the policy swings it up. Over real sockets,
openpi's client alone uses TCP through netem's relay, which repeats a lost piece after 200 ms;
`policy join` and `policy serve` use UDP through netem. In virtual time, the same two ends are
compared over the same networks with a blocking call that retransmits lost datagrams.
"""

import argparse
import asyncio
import json
import math
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from openpi_client import msgpack_numpy
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from bench.harness import TextTable
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.netem.impairments.draws import SLOT_NS
from skytether.policy import values
from skytether.policy.images import Compressor, Unpacker
from skytether.policy.robot import RobotOptions
from skytether.policy.virtual import Emulated
from skytether.shared.base import files
from skytether.shared.base.units import SECOND_NS, seconds_to_ns

STEP_S, ROWS, PLAYED = 0.05, 20, 2
"""Control step [s], rows of an action chunk, and rows that the program executes of each answer."""
DEADLINE_S = 0.1
"""Deadline of a call [s]."""
TORQUE_MAX, GRAVITY = 2.0, 10.0
"""Largest torque [N·m] and gravity [m/s²], as in Gymnasium."""
SKYTETHER = (sys.executable, "-P", "-m", "skytether")
UPRIGHT = 0.5
"""Cost of a step below which the pendulum counts as upright."""
RETRY_S = 0.2
"""Retransmission time-out of a lost datagram [s]: Linux's smallest for TCP."""
System = Literal["openpi alone", "policy"]
SYSTEMS: tuple[System, ...] = ("openpi alone", "policy")


@dataclass(frozen=True)
class Cell:
    """Condition of the benchmark."""

    name: str
    network: str
    """Network impairments of each direction."""
    thinking_s: float = 0.02
    """Computation time of the policy [s]."""
    camera: bool = False
    """Whether an observation has two images of 224 × 224 pixels."""


RATES = {"4 Mbit/s, two cameras, 86 ms": 500_000.0}
"""Rate limit by cell, for `Blocking` [B/s]: `Fates` does not model it."""
CELLS = (
    Cell("no network", "none"),
    *(
        Cell(f"{delay} ms, loss {loss} %", f"constant({delay / 2}ms) & loss({loss}%)")
        for delay in (20, 100, 250)
        for loss in (0, 5, 10)
    ),
    Cell("100 ms, an outage of 2 s", "constant(50ms) & outage(5, 2)"),
    Cell("4 Mbit/s, two cameras, 86 ms", "constant(20ms) & rate(4mbit)", 0.086, camera=True),
)


@dataclass(frozen=True)
class PoliciesCounts:
    virtual: int = 50
    """Number of runs of each cell in virtual time."""
    real: int = 5
    """Number of runs of each cell over real sockets."""
    seconds: float = 10.0
    """Duration of a run [s]."""
    together: int = 2
    """Number of parallel runs."""


FULL, QUICK = PoliciesCounts(), PoliciesCounts(virtual=2, real=1, seconds=3.0)


class Pendulum:
    """Pendulum of Gymnasium, advanced by the clock."""

    def __init__(self, seed: int, now_s: float) -> None:
        rng = np.random.default_rng(seed)
        self.angle, self.speed = math.pi + 0.2 * rng.standard_normal(), 0.1 * rng.standard_normal()
        self.torque = 0.0
        self.costs: list[float] = []
        self._began_s = now_s

    @property
    def next_s(self) -> float:
        """Time of the next control step [s]."""
        return self._began_s + len(self.costs) * STEP_S

    def pass_time(self, now_s: float) -> None:
        """Simulate until `now_s` with constant torque."""
        while self.next_s < now_s:
            cost = _folded(self.angle) ** 2 + 0.1 * self.speed**2 + 0.001 * self.torque**2
            self.costs.append(cost)
            self.angle, self.speed = stepped(self.angle, self.speed, self.torque)


def stepped(angle: float, speed: float, torque: float) -> tuple[float, float]:
    """Angle [rad] and angular velocity [rad/s] after a control step with a torque [N·m]."""
    speed += (1.5 * GRAVITY * math.sin(angle) + 3.0 * torque) * STEP_S
    speed = min(max(speed, -8.0), 8.0)
    return angle + speed * STEP_S, speed


def _folded(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def swing_up(observation: dict[str, Any]) -> dict[str, Any]:
    """Policy: predicted torques of the next ROWS steps; energy control, linear near the top."""
    angle, speed = (float(each) for each in observation["state"])
    rows = np.zeros((ROWS, 1), np.float32)
    for row in range(ROWS):
        error = _folded(angle)
        if abs(error) < 0.6 and abs(speed) < 4.0:
            torque = -12.0 * error - 3.5 * speed
        else:
            energy = speed**2 / 6.0 + 5.0 * (math.cos(angle) - 1.0)
            torque = -2.0 * energy * (speed or 0.1)
        rows[row] = torque = min(max(torque, -TORQUE_MAX), TORQUE_MAX)
        angle, speed = stepped(angle, speed, torque)
    return {"actions": rows}


@contextmanager
def policy_server(thinking_s: float) -> Iterator[int]:
    """Run a policy server in a thread of this process; its port."""
    ready, ports = threading.Event(), list[int]()

    async def handle(connection: ServerConnection) -> None:
        packer = msgpack_numpy.Packer()
        with suppress(ConnectionClosed):
            await connection.send(packer.pack({}))
            async for message in connection:
                reply = packer.pack(swing_up(msgpack_numpy.unpackb(message)))
                await asyncio.sleep(thinking_s)
                await connection.send(reply)

    async def run() -> None:
        end.append((asyncio.get_running_loop(), done := asyncio.Event()))
        async with serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
            ports.append(next(iter(server.sockets)).getsockname()[1])
            ready.set()
            await done.wait()

    end: list[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = []
    thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    thread.start()
    ready.wait()
    yield ports[0]
    loop, done = end[0]
    loop.call_soon_threadsafe(done.set)
    thread.join()


@contextmanager
def process(*argv: str) -> Iterator[str]:
    """Run a command of Skytether; its listening address."""
    line = [*SKYTETHER, *argv]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout
        address = ""
        for said in running.stdout:
            if "listening on" in said:
                address = said.partition("listening on ")[2].partition(",")[0]
                break
        threading.Thread(target=running.stdout.read, daemon=True).start()
        try:
            yield address
        finally:
            running.terminate()


def fly(system: System, cell: Cell, seed: int, seconds: float) -> dict[str, float]:
    """One run over real sockets; its figures."""
    anywhere = "127.0.0.1:0"
    ways = ("--to-server", cell.network, "--to-client", cell.network, "--seed", str(seed))
    with ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        port = stack.enter_context(policy_server(cell.thinking_s))
        counted = Path(folder, "netem.json")
        netem = ("netem", "--bind", anywhere, *ways, "--json", str(counted))
        with ExitStack() as ends:
            if system == "openpi alone":
                at = ends.enter_context(process(*netem, "--tcp", "--server", f"127.0.0.1:{port}"))
            else:
                upstream = f"ws://127.0.0.1:{port}"
                serving = ("policy", "serve", "--upstream", upstream, "--bind", anywhere)
                server = ends.enter_context(process(*serving))
                through = ends.enter_context(process(*netem, "--server", server))
                join = ("policy", "join", through, "--listen", anywhere, "--actions", "absolute")
                more = ("--step", f"{STEP_S}s", "--plays-on", "--deadline", f"{DEADLINE_S}s")
                at = ends.enter_context(process(*join, *more))
            figures = program(Real(f"ws://{at}"), cell, seed, seconds)
        counts = json.loads(counted.read_text())
    sent = sum(
        counts[way]["bytes"] for way in ("to_server", "to_client") if isinstance(counts[way], dict)
    )
    return figures | {"kbit_per_s": 8e-3 * sent / seconds}


class World(Protocol):
    """Clock and policy connection of a robot program."""

    def now_s(self) -> float: ...

    def sleep_until(self, at_s: float) -> None: ...

    def infer(self, observation: dict[str, Any]) -> Any:
        """Reply to an observation; raises RuntimeError if the call is answered with an error."""


class Real:
    """Real clock and openpi's client."""

    def __init__(self, url: str) -> None:
        self._client = WebsocketClientPolicy(url)
        self.infer = self._client.infer
        self.now_s = time.monotonic

    def sleep_until(self, at_s: float) -> None:
        time.sleep(max(0.0, at_s - time.monotonic()))


class Virtual:
    """Robot end and policy end in virtual time."""

    def __init__(self, cell: Cell, seed: int) -> None:
        options = RobotOptions(
            "absolute",
            seconds_to_ns(DEADLINE_S),
            step_ns=seconds_to_ns(STEP_S),
            plays_on=True,
        )
        self._ends = Emulated(
            swing_up,
            options,
            to_policy=cell.network,
            to_robot=cell.network,
            thinking=cell.thinking_s,
            seed=seed,
            compress=Compressor(),
            unpacker=Unpacker,
        )
        self._ends.connect()
        self.infer = self._ends.infer

    def now_s(self) -> float:
        return self._ends.now_ns / SECOND_NS

    def sleep_until(self, at_s: float) -> None:
        self._ends.run(seconds_to_ns(at_s))


class Blocking:
    """Blocking call in virtual time: a model of TCP in which each lost datagram of a message is
    retransmitted after RETRY_S.
    """

    def __init__(self, cell: Cell, seed: int) -> None:
        self._thinking_s, self._now_s = cell.thinking_s, 0.0
        ways = (impairments(cell.network, ()) for _ in range(2))
        self._fates = [Fates(way, seed, name, 0) for way, name in zip(ways, "ud", strict=True)]
        self._rate = RATES.get(cell.name)

    def now_s(self) -> float:
        return self._now_s

    def sleep_until(self, at_s: float) -> None:
        self._now_s = max(self._now_s, at_s)

    def _arrives_s(self, fates: Fates, size: int, at_s: float) -> float:
        """Time at which the last datagram of a message arrives [s]."""
        last_s = at_s
        for rank in range(-(-size // 1448)):
            sent_s, tries = at_s, 0
            if self._rate:
                at_s = sent_s = at_s + min(size, 1448) / self._rate
            while (fate := fates.at(seconds_to_ns(sent_s) // SLOT_NS, rank + 1000 * tries)).lost:
                sent_s, tries = sent_s + RETRY_S, tries + 1
            last_s = max(last_s, sent_s + fate.delay_ns / SECOND_NS)
        return last_s

    def infer(self, observation: dict[str, Any]) -> Any:
        up, down = self._fates
        reply = swing_up(observation)
        asked_s = self._arrives_s(up, len(values.pack(observation)), self._now_s)
        answered_s = asked_s + self._thinking_s
        self._now_s = self._arrives_s(down, len(values.pack(reply)), answered_s)
        return reply


def program(world: World, cell: Cell, seed: int, seconds: float) -> dict[str, float]:
    """Run the robot program with the pendulum; figures of the run."""
    images = {}
    if cell.camera:
        shade = np.add.outer(np.arange(224), np.arange(224)).astype(np.uint8)
        images = {f"image_{i}": np.stack([shade, shade.T, shade + i * 80], axis=2) for i in (1, 2)}
    world.infer({"state": np.array([math.pi, 0.0]), **images})
    robot, waits, failed = Pendulum(seed, world.now_s()), list[float](), 0
    until_s = world.now_s() + seconds
    while world.now_s() < until_s:
        robot.pass_time(world.now_s())
        asked_s = world.now_s()
        try:
            state = np.array([robot.angle, robot.speed])
            rows = world.infer({"state": state, **images})["actions"]
        except RuntimeError:  # the program stops the robot
            failed += 1
            rows = np.zeros((1, 1))
        waits.append(world.now_s() - asked_s)
        robot.pass_time(world.now_s())
        for row in rows[:PLAYED]:
            robot.torque = float(row[0])
            world.sleep_until(robot.next_s)
            robot.pass_time(world.now_s() + 1e-9)
    half = robot.costs[len(robot.costs) // 2 :]
    return {
        "cost": float(np.mean(robot.costs)),
        "upright": float(np.mean(np.array(half) < UPRIGHT)),
        "calls": len(waits),
        "late": sum(wait > DEADLINE_S + 0.005 for wait in waits),
        "wait_ms_p50": 1e3 * float(np.median(waits)),
        "wait_ms_max": 1e3 * max(waits),
        "errors": failed,
    }


def fly_virtual(run: tuple[str, Cell, int, float]) -> dict[str, float]:
    """One run in virtual time; its figures."""
    system, cell, seed, seconds = run
    world: World = Virtual(cell, seed) if system == "policy" else Blocking(cell, seed)
    return program(world, cell, seed, seconds)


def measure(counts: PoliciesCounts, cells: Sequence[Cell] = CELLS) -> dict[str, Any]:
    """All runs, in virtual time and over real sockets."""

    def runs(count: int) -> list[tuple[System, Cell, int, float]]:
        seeds = range(1, count + 1)
        return [
            (system, cell, seed, counts.seconds)
            for seed in seeds
            for cell in cells
            for system in SYSTEMS
        ]

    def rows(flown: Sequence[tuple[System, Cell, int, float]], figures: Any) -> list[Any]:
        each = zip(flown, figures, strict=True)
        return [
            {"system": run[0], "cell": run[1].name, "seed": run[2]} | found for run, found in each
        ]

    virtual, real = runs(counts.virtual), runs(counts.real)
    with ProcessPoolExecutor(counts.together) as processes:
        found = list(processes.map(fly_virtual, virtual, chunksize=4))
    with ThreadPoolExecutor(counts.together) as threads:
        measured = list(threads.map(lambda run: fly(*run), real))
    return {
        "counts": asdict(counts),
        "virtual": rows(virtual, found),
        "real": rows(real, measured),
    }


def tables(result: dict[str, Any]) -> dict[str, TextTable]:
    titles = {"virtual": "in virtual time", "real": "over real UDP and TCP"}
    return {titles[kind]: _table(result[kind]) for kind in titles}


def _table(runs: Sequence[dict[str, Any]]) -> TextTable:
    rows = []
    for cell in dict.fromkeys(run["cell"] for run in runs):
        row = [str(cell)]
        for system in SYSTEMS:
            own = [run for run in runs if (run["system"], run["cell"]) == (system, cell)]
            costs = [run["cost"] for run in own]
            spread = 1.96 * float(np.std(costs, ddof=1)) / math.sqrt(len(own)) if own[1:] else 0.0
            upright = 100 * float(np.mean([run["upright"] for run in own]))
            late, calls, errors = (
                sum(run[key] for run in own) for key in ("late", "calls", "errors")
            )
            row += [
                f"{np.mean(costs):.2f} ± {spread:.2f}",
                f"{upright:.0f} %",
                f"{late} of {calls}",
                f"{max(run['wait_ms_max'] for run in own):.0f}",
                f"{errors}",
            ]
        rows.append(row)
    head = ("cost", "upright", "late", "longest wait [ms]", "errors")
    return TextTable(
        ["network", *(f"{each}, {system}" for system in SYSTEMS for each in head)], rows
    )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.policies", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few runs; nothing is written")
    quick = parser.parse_args().quick
    result = measure(QUICK if quick else FULL)
    for title, table in tables(result).items():
        table.show(title)
    if not quick:
        out = Path(__file__).with_name("policies.json")
        files.write(out, json.dumps(result, indent=1).encode())


if __name__ == "__main__":
    main()
