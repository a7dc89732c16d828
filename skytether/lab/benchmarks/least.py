"""Lower bounds of a server's cost per vehicle and step: memory, system calls and cipher.

    python -m skytether.lab.benchmarks.least

Beside each bound stands the cost of the corresponding part of Skytether, measured alternately in
the same run: planning beside copying the memory that planning reads and writes, everything between
two datagrams beside sending and receiving them, and sealing packets beside the cipher.
"""

import socket
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import tyro
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from skytether.lab.benchmarks import tick
from skytether.lab.benchmarks.airspace import Airspace, PlannedFleet
from skytether.lab.benchmarks.harness import TextTable, progress, us
from skytether.lab.benchmarks.wire import messages
from skytether.shared.wire.protocol import Horizon, Observation, decode, encode

SYSTEM_CALLS = "two system calls: receive an observation, send a horizon"
UNCOUNTED = 5
"""Number of warm-up turns, which are not counted."""


@dataclass(frozen=True)
class LeastOptions:
    """Size of the benchmark."""

    vehicles: int = 1000
    turns: int = 100


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, and print the table."""
    options = tyro.cli(LeastOptions, args=argv, description=__doc__)
    measure(options).show("the least, and what is needed")
    return 0


def measure(options: LeastOptions) -> TextTable:
    """Table of lower bounds and measured costs per vehicle and step [µs]."""
    n, scenario = options.vehicles, tick.mixes()["rarely"]
    terms = scenario.terms()
    fleet = PlannedFleet(scenario, n)
    # Memory of a plan: both MPCs' inputs and the generator's states, read before, written after.
    axes, H = terms.axes, terms.horizon
    numbers = np.zeros((n, axes, 2 * H + 2 * (H + 1)))
    space, told = Airspace(scenario, n), {type(each): each for each in messages(terms)}
    observation, horizon = encode(told[Observation]), encode(told[Horizon])
    cipher, nonce = ChaCha20Poly1305(bytes(32)), bytes(12)
    sealed = cipher.encrypt(nonce, observation, b"")
    least: dict[str, Callable[[], object]] = {
        "memory of a plan, copied once": numbers.copy,
        "planning": fleet.plan,
        SYSTEM_CALLS: lambda: _exchange(ends, observation, horizon, n),
        "a tick of the server": space.wake,
        "decoding an observation": lambda: [decode(observation, terms) for _ in range(n)],
        "cipher: open one packet, seal one": lambda: [
            (cipher.decrypt(nonce, sealed, b""), cipher.encrypt(nonce, horizon, b""))
            for _ in range(n)
        ],
    }
    spent: dict[str, list[float]] = {name: [] for name in least}
    ends = tuple(socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    with ends[0], ends[1]:
        for end in ends:
            end.bind(("127.0.0.1", 0))
        for turn in progress(range(options.turns + UNCOUNTED), "the least"):
            space.prepare()
            for name, work in least.items():
                start_ns = time.process_time_ns()
                work()
                if turn >= UNCOUNTED:
                    spent[name].append((time.process_time_ns() - start_ns) / n)
            fleet.fly()
    rows = [[name, us(float(np.median(values)) / 1e3)] for name, values in spent.items()]
    return TextTable(["a vehicle and step", "CPU time [µs]"], rows)


def _exchange(ends: Sequence[socket.socket], up: bytes, down: bytes, count: int) -> None:
    """Send and receive half of the packets that so many vehicles' server does, from both ends."""
    here, there = ends
    to_here, to_there = here.getsockname(), there.getsockname()
    for _ in range(count // 2):
        there.sendto(up, to_here)
        here.recvfrom(2048)
        here.sendto(down, to_there)
        there.recvfrom(2048)


if __name__ == "__main__":
    sys.exit(main())
