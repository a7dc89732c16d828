"""Robot programs of the compared systems, which use the same policies.

    openpi      openpi's client: a call waits for its answer, and rows are executed between calls
    lerobot     LeRobot's asynchronous inference: a queue of rows, averaged with those of new
                chunks; observations are sent while at most half of a chunk is left; the last target
                stays while the queue is empty
    drtc        DRTC: the newest row of each step; an observation is sent if a quarter of a chunk
                was executed, and the chunk of the last observation is overdue; the policy keeps the
                rows that are executed meanwhile, which are sent with the observation
    ours        openpi's client with `policy join` and `policy serve`
    ours-rows   the same with `--give-rows`: the policy keeps the committed rows

`lerobot` and `drtc` are implemented from public descriptions. They send raw images, and do not wait
for answers: threads send the newest observation, and receive chunks.

`python -m bench.policies.robot JSON` runs one of them over a real network, within `skytether netem
run`, and prints its figures.
"""

import json
import os
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np
from openpi_client import msgpack_numpy
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from bench.policies import forks, wire
from bench.policies.servers import PORT
from bench.policies.tasks import TASKS, Robot, Task
from skytether.__main__ import main as skytether
from skytether.policy.players import Freshest, Held, Player, Queue
from skytether.shared.base.units import SECOND_NS

LATE_S = 0.005
"""Time after the deadline from which an answer is late [s]."""
GATEWAY = "10.0.2.2"
"""Address of this machine within `netem run`."""
DELAYS = 16
"""Number of newest chunks whose largest delay is DRTC's delay bound."""


class RobotRun(msgspec.Struct, frozen=True):
    """Run of a robot program over a real network."""

    task: str
    system: str
    seed: int
    seconds: float
    port: int
    """UDP port of the wire or of `policy serve`."""
    number: int
    """Number of the robot, new for each run."""


class Late(NamedTuple):
    at_s: float
    """Time of the answer, by the monotonic clock [s]."""
    by_s: float
    """Time after the deadline [s]."""
    waited_s: float
    """Time of the call in which the program or `policy join` waited for a core [s]."""


class Flown(msgspec.Struct, frozen=True):
    """Figures of a run."""

    score: float
    seconds: float
    """Duration, which is shorter if the task was solved [s]."""
    freeze_s: float
    """Longest time without a row of the policy [s]."""
    calls: int
    errors: int
    wait_s_max: float
    """Longest wait for an answer [s]."""
    late: list[Late]
    woke_late_s: float = 0.0
    """Longest time by which the program woke late from a sleep, by pauses of the machine [s]."""
    cpu_s: float = 0.0
    """CPU time of the program, without the simulation of the robot, and of `policy join` [s]."""


class World(Protocol):
    """Clock and policy connection of a robot program."""

    def now_s(self) -> float: ...

    def sleep_until(self, at_s: float) -> None: ...

    def infer(self, observation: dict[str, Any]) -> Any:
        """Reply to an observation; raises RuntimeError if the call is answered with an error."""

    def waited_s(self) -> float:
        """Time so far that the program was ready, but without a core [s]."""


class Real:
    """Real clock and openpi's client.

    Args:
        others: process IDs of the other processes on the robot.
    """

    def __init__(self, url: str, others: Sequence[int]) -> None:
        self.infer = WebsocketClientPolicy(url).infer
        self.now_s = time.monotonic
        self._stats = [Path(f"/proc/{pid}/schedstat") for pid in (os.getpid(), *others)]

    def sleep_until(self, at_s: float) -> None:
        time.sleep(max(0.0, at_s - time.monotonic()))

    def waited_s(self) -> float:
        return sum(int(each.read_text().split()[1]) for each in self._stats) / SECOND_NS


class Plant:
    """Robot that is advanced by the clock: it repeats its action until the next one."""

    def __init__(self, task: Task, seed: int) -> None:
        self.robot: Robot = task.make()
        self.observation, _ = self.robot.reset(seed=seed)
        self.action: Any = None
        self.cpu_s = 0.0
        """CPU time of the simulation [s]."""
        self.woke_late_s = 0.0
        self._step_s, self._began_s, self._steps = task.step_s, 0.0, 0

    def begin(self, now_s: float, action: Any) -> None:
        self._began_s, self.action = now_s, action

    @property
    def next_s(self) -> float:
        """Time at which the present step ends [s]."""
        return self._began_s + (self._steps + 1) * self._step_s

    def wake(self, due_s: float, now_s: float) -> None:
        """Pass the time of a sleep that was due to end at `due_s`."""
        self.woke_late_s = max(self.woke_late_s, now_s - due_s)
        self.pass_time(now_s)

    def pass_time(self, now_s: float) -> None:
        began_s = time.thread_time()
        while self.next_s <= now_s + 1e-9:
            self.observation, *_ = self.robot.step(self.action)
            self._steps += 1
        self.cpu_s += time.thread_time() - began_s


def waiting(world: World, task: Task, plant: Plant, seconds: float, played: int) -> Flown:
    """Program that waits for the answer to each call, and executes `played` rows of it."""
    rows = world.infer(plant.observation)["actions"]
    waits, late, failed = list[float](), list[Late](), 0
    plant.begin(world.now_s(), rows[0])
    until_s = world.now_s() + seconds
    while world.now_s() < until_s and not plant.robot.is_over:
        for row in rows[:played]:
            plant.action = row
            due_s = max(plant.next_s, world.now_s())
            world.sleep_until(due_s)
            plant.wake(due_s, world.now_s())
        asked_s, waited_s = world.now_s(), world.waited_s()
        try:
            rows = world.infer(plant.observation)["actions"]
        except RuntimeError:  # the program stops the robot
            failed += 1
            rows = [plant.action * (not task.is_cost)]
        now_s = world.now_s()
        waits.append(now_s - asked_s)
        if (by_s := waits[-1] - task.deadline_s) > LATE_S:
            late.append(Late(now_s, by_s, world.waited_s() - waited_s))
        plant.pass_time(now_s)
    return flown(task, plant, seconds, len(waits), failed, max(waits, default=0.0), late)


def flown(
    task: Task,
    plant: Plant,
    seconds: float,
    calls: int,
    errors: int = 0,
    wait_s_max: float = 0.0,
    late: Sequence[Late] = (),
) -> Flown:
    return Flown(
        score=task.score(plant.robot, seconds),
        seconds=task.step_s * len(plant.robot.rewards),
        freeze_s=task.step_s * plant.robot.longest_freeze,
        calls=calls,
        errors=errors,
        wait_s_max=wait_s_max,
        late=[*late],
        woke_late_s=plant.woke_late_s,
    )


class Rule(Protocol):
    """Rule that decides when `queueing` sends an observation."""

    def is_due(self, step: int, left: int) -> bool:
        """Whether an observation is sent at a step at which `left` rows remain."""

    def arrived(self, steps: int) -> None:
        """Note that a chunk has arrived `steps` after its observation."""

    @property
    def committed(self) -> int:
        """Number of next rows that are sent with the observation."""


class AtHalf:
    """LeRobot's rule: observations are sent while at most half of a chunk is left."""

    committed = 0

    def __init__(self, rows: int) -> None:
        self._rows = rows

    def is_due(self, step: int, left: int) -> bool:  # noqa: ARG002
        return 2 * left <= self._rows

    def arrived(self, steps: int) -> None: ...


class Cooldown:
    """DRTC's rule: a quarter of a chunk was executed, and the last requested chunk is overdue."""

    def __init__(self, rows: int) -> None:
        self._rows, self._ready, self._delays = rows, 0, deque[int](maxlen=DELAYS)

    @property
    def committed(self) -> int:
        return min(max(self._delays, default=0), self._rows // 2)

    def is_due(self, step: int, left: int) -> bool:
        if step < self._ready or 4 * left > 3 * self._rows:
            return False
        self._ready = step + self.committed + 1
        return True

    def arrived(self, steps: int) -> None:
        self._delays.append(steps)


class Threads:
    """Connection to a policy server; sending and receiving do not block the program."""

    def __init__(self, url: str) -> None:
        self._socket = connect(url, compression=None, max_size=None)
        self._socket.recv()  # the metadata
        self._newest, self._due = list[Any](), threading.Event()
        self.arrived = deque[Any]()
        for run in (self._send, self._receive):
            threading.Thread(target=run, daemon=True).start()

    def ask(self, observation: dict[str, Any]) -> None:
        self._newest[:] = [observation]
        self._due.set()

    def _send(self) -> None:
        packer = msgpack_numpy.Packer()
        with suppress(ConnectionClosed):
            while True:
                self._due.wait()
                self._due.clear()
                if self._newest:  # not sent since it replaced the one before
                    self._socket.send(packer.pack(self._newest.pop()))

    def _receive(self) -> None:
        with suppress(ConnectionClosed):
            for message in self._socket:
                self.arrived.append(msgpack_numpy.unpackb(message))


def queueing(
    threads: Threads, task: Task, plant: Plant, seconds: float, player: Player, rule: Rule
) -> Flown:
    """Program that executes a row at each step, and does not wait for chunks."""
    threads.ask({**plant.observation, "number": 0})
    asked = {0: (0, 0)}  # of each observation: its step, and the number of its first row
    while not threads.arrived:
        time.sleep(0.001)
    began_s = time.monotonic()
    plant.begin(began_s, None)
    for step in range(round(seconds / task.step_s)):
        while threads.arrived:
            chunk = threads.arrived.popleft()
            asked_step, first = asked[chunk["number"]]
            player.accept(Held(chunk["number"] + 1, first, chunk["actions"]), step)
            rule.arrived(step - asked_step)
        coming = np.concatenate([each.rows for each in player.held] or [np.zeros((0, 1))])
        if rule.is_due(step, len(coming)):
            number = len(asked)
            asked[number] = step, player.number(step)
            own = {"number": number, "committed": coming[: rule.committed]}
            threads.ask({**plant.observation, **own})
        if (row := player.row(step)) is not None:
            plant.action = row
        due_s = max(plant.next_s, time.monotonic())
        time.sleep(max(0.0, due_s - time.monotonic()))
        plant.wake(due_s, time.monotonic())
        if plant.robot.is_over:
            break
    return flown(task, plant, seconds, len(asked) - 1)


def main(argv: Sequence[str]) -> None:
    run = msgspec.json.decode(argv[0], type=RobotRun)
    task = TASKS[run.task]
    plant = Plant(task, run.seed)
    with ExitStack() as stack:
        others = list[int]()
        if run.system.startswith("ours"):
            url, joined = stack.enter_context(_joined(run, task))
            others.append(joined)
        else:
            carrier = socket.socket(type=socket.SOCK_DGRAM)
            carrier.connect((GATEWAY, run.port))
            wire.lay(wire.robot_address(run.number), carrier, {wire.SERVER: (GATEWAY, run.port)})
            url = f"ws://{wire.SERVER}:{PORT}"
        if run.system in ("lerobot", "drtc"):
            threads = Threads(url)
            player: Player = Queue("average") if run.system == "lerobot" else Freshest()
            rule: Rule = (AtHalf if run.system == "lerobot" else Cooldown)(task.rows)
            before_s = cpu_s(others)
            figures = queueing(threads, task, plant, run.seconds, player, rule)
        else:
            world, before_s = Real(url, others), cpu_s(others)
            played = task.calls if others else task.played
            figures = waiting(world, task, plant, run.seconds, played)
        used_s = cpu_s(others) - before_s - plant.cpu_s
    sys.stdout.buffer.write(msgspec.json.encode(msgspec.structs.replace(figures, cpu_s=used_s)))


@contextmanager
def _joined(run: RobotRun, task: Task) -> Iterator[tuple[str, int]]:
    """URL of `policy join`, and its process."""
    options = {
        "--listen": "127.0.0.1:8000",
        "--actions": "absolute",
        "--step": f"{task.step_s:g}s",
        "--deadline": f"{task.deadline_s:g}s",
        "--rows": f"{task.calls}",
        "--when": task.when,
        "--id": f"{run.number}",
        "--log": "json",
    }
    line = ["policy", "join", f"{GATEWAY}:{run.port}", "--plays-on", "--insecure"]
    line += [part for pair in options.items() for part in pair]
    with forks.forked(partial(skytether, line)) as (joined, output):
        json.loads(output.readline())  # it listens
        threading.Thread(target=output.read, daemon=True).start()
        yield f"ws://{options['--listen']}", joined


def cpu_s(others: Sequence[int]) -> float:
    """CPU time of this process and of others [s]."""
    spent = time.process_time()
    for pid in others:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        spent += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return spent


if __name__ == "__main__":
    main(sys.argv[1:])
