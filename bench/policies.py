"""A policy far from its robot over real UDP and TCP: openpi's client alone, and behind `policy`.

The robot is a pendulum that moves on while its program waits; the policy swings it up. Both drive
the same program with openpi's own client. Alone it speaks TCP through netem's relay, where a piece
that is lost is sent again after 200 ms; with `policy join` and `policy serve` it is UDP.
"""

import asyncio
import json
import math
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from openpi_client import msgpack_numpy
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from bench.harness import TextTable
from skytether.shared.base import files

STEP_S, ROWS, PLAYED = 0.05, 20, 2
"""Step of the pendulum [s], rows of a chunk, and rows that the program plays of each."""
DEADLINE_S = 0.1
TORQUE_MAX, GRAVITY = 2.0, 10.0
SKYTETHER = (sys.executable, "-P", "-m", "skytether")
System = Literal["openpi alone", "policy"]
SYSTEMS: tuple[System, ...] = ("openpi alone", "policy")


@dataclass(frozen=True)
class Cell:
    name: str
    network: str
    """Impairments of each direction."""
    thinking_s: float = 0.02
    camera: bool = False
    """Whether an observation has two images of 224²."""


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
    runs: int = 5
    seconds: float = 10.0
    together: int = 3
    """Number of runs at once."""


FULL, QUICK = PoliciesCounts(), PoliciesCounts(runs=1, seconds=3.0)


class Pendulum:
    """Gymnasium's Pendulum, which moves on by the clock."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.angle, self.speed = math.pi + 0.2 * rng.standard_normal(), 0.1 * rng.standard_normal()
        self.torque = 0.0
        self.costs: list[float] = []
        self._began_s = time.monotonic()

    def pass_time(self) -> None:
        """Step until now, with the present torque."""
        while self._began_s + len(self.costs) * STEP_S < time.monotonic():
            cost = _folded(self.angle) ** 2 + 0.1 * self.speed**2 + 0.001 * self.torque**2
            self.costs.append(cost)
            self.angle, self.speed = stepped(self.angle, self.speed, self.torque)

    def sleep_until_step(self) -> None:
        time.sleep(max(0.0, self._began_s + len(self.costs) * STEP_S - time.monotonic()))
        self.pass_time()


def stepped(angle: float, speed: float, torque: float) -> tuple[float, float]:
    speed += (1.5 * GRAVITY * math.sin(angle) + 3.0 * torque) * STEP_S
    speed = min(max(speed, -8.0), 8.0)
    return angle + speed * STEP_S, speed


def _folded(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def swing_up(observation: dict[str, Any]) -> dict[str, Any]:
    """Torques of the next ROWS steps: energy first, then a linear rule near the top."""
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
    """Port of a server with openpi's protocol, in a thread of this process."""
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
    """A command of Skytether; its address."""
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
    """One run; its figures."""
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
            figures = program(f"ws://{at}", cell, seed, seconds)
        counts = json.loads(counted.read_text())
    sent = sum(
        counts[way]["bytes"] for way in ("to_server", "to_client") if isinstance(counts[way], dict)
    )
    return figures | {"kbit_per_s": 8e-3 * sent / seconds}


def program(url: str, cell: Cell, seed: int, seconds: float) -> dict[str, float]:
    """The robot's program: openpi's client, and the pendulum."""
    client = WebsocketClientPolicy(url)
    images = {}
    if cell.camera:
        shade = np.add.outer(np.arange(224), np.arange(224)).astype(np.uint8)
        images = {f"image_{i}": np.stack([shade, shade.T, shade + i * 80], axis=2) for i in (1, 2)}
    client.infer({"state": np.array([math.pi, 0.0]), **images})
    robot, waits, freezes, failed = Pendulum(seed), list[float](), list[float](), 0
    until_s = time.monotonic() + seconds
    fresh_s = time.monotonic()
    while time.monotonic() < until_s:
        robot.pass_time()
        asked_s = time.monotonic()
        try:
            rows = client.infer({"state": np.array([robot.angle, robot.speed]), **images})[
                "actions"
            ]
        except RuntimeError:  # the robot's own stop
            failed += 1
            rows = np.zeros((1, 1))
        waits.append(time.monotonic() - asked_s)
        robot.pass_time()
        freezes.append(time.monotonic() - fresh_s)
        for row in rows[:PLAYED]:
            robot.torque = float(row[0])
            robot.sleep_until_step()
        fresh_s = time.monotonic()
    late = sum(wait > DEADLINE_S + 0.005 for wait in waits)
    return {
        "cost": float(np.mean(robot.costs)),
        "upright": float(np.mean(np.array(robot.costs[len(robot.costs) // 2 :]) < 0.5)),
        "calls": len(waits),
        "late": late,
        "wait_ms_p50": 1e3 * float(np.median(waits)),
        "wait_ms_max": 1e3 * max(waits),
        "freeze_ms_max": 1e3 * max(freezes),
        "errors": failed,
    }


def measure(counts: PoliciesCounts, cells: Sequence[Cell] = CELLS) -> dict[str, Any]:
    runs = [
        (system, cell, seed)
        for seed in range(1, counts.runs + 1)
        for cell in cells
        for system in SYSTEMS
    ]
    with ThreadPoolExecutor(counts.together) as pool:
        flown = list(pool.map(lambda run: fly(run[0], run[1], run[2], counts.seconds), runs))
    rows = [
        {"system": system, "cell": cell.name, "seed": seed} | figures
        for (system, cell, seed), figures in zip(runs, flown, strict=True)
    ]
    return {"counts": asdict(counts), "runs": rows}


def tables(result: dict[str, Any]) -> dict[str, TextTable]:
    cells = list(dict.fromkeys(run["cell"] for run in result["runs"]))
    rows = []
    for cell in cells:
        row = [cell]
        for system in SYSTEMS:
            runs = [run for run in result["runs"] if (run["system"], run["cell"]) == (system, cell)]
            mean = {
                name: float(np.mean([run[name] for run in runs]))
                for name in ("cost", "upright", "kbit_per_s", "wait_ms_p50")
            }
            late, calls = (sum(run[name] for run in runs) for name in ("late", "calls"))
            freeze = max(run["freeze_ms_max"] for run in runs)
            row += [
                f"{mean['cost']:.2f}",
                f"{100 * mean['upright']:.0f} %",
                f"{late} of {calls}",
                f"{freeze:.0f}",
                f"{mean['kbit_per_s']:.0f}",
            ]
        rows.append(row)
    head = (
        "cost",
        "upright",
        f"later than {1e3 * DEADLINE_S:.0f} ms",
        "longest wait [ms]",
        "kbit/s",
    )
    headings = ["network", *(f"{each}, {system}" for system in SYSTEMS for each in head)]
    return {"policies": TextTable(headings, rows)}


def main() -> None:
    quick = "--quick" in sys.argv[1:]
    result = measure(QUICK if quick else FULL)
    for title, table in tables(result).items():
        table.show(title)
    if not quick:
        out = Path(__file__).with_name("policies.json")
        files.write(out, json.dumps(result, indent=1).encode())


if __name__ == "__main__":
    main()
