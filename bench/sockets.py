"""Cost of the shell to receive an observation and send a horizon, by number of vehicles.

Two shells drive the same endpoint in one process, by turns in an order drawn anew each time. One
makes a system call for each datagram, the other reads and sends datagrams in batches where many
come (`shell.batch`). In a turn so many sockets send one datagram each; the CPU time counts from
then until the last of them is answered, with all that the event loop does for it. The vehicles'
own calls do not count.
"""

import asyncio
import socket
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.harness import Lateness, TextTable, figures_us, progress, us, without_gc
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.core.endpoint import Address, Datagram, Endpoint
from skytether.shell.batch import Batch
from skytether.shell.driver import Shell, new_event_loop
from skytether.shell.udp import allow_sockets, open_socket

HOST = "127.0.0.1"
UP, DOWN = bytes(99), bytes(435)
"""Payloads as long as an OBSERVATION and a HORIZON of 50 inputs on two axes."""
VEHICLES = (1, 8, 64, 1000)
"""Numbers of vehicles, a socket each."""


@dataclass(frozen=True)
class SocketCounts:
    """Size of the benchmark."""

    datagrams: int = 20_000
    """Number of datagrams that each shell receives for each number of vehicles."""
    turns: int = 100
    """Fewest turns of each, however many vehicles there are."""


FULL, QUICK = SocketCounts(), SocketCounts(datagrams=500, turns=5)


class Answering(Endpoint):
    """Endpoint that answers every datagram."""

    patience_ns = MILLISECOND_NS

    def __init__(self) -> None:
        super().__init__()
        self._left = 0
        self._answered: asyncio.Future[None]

    def expect(self, count: int, answered: "asyncio.Future[None]") -> None:
        """Finish a future once so many more datagrams have come."""
        self._left, self._answered = count, answered

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        """See `Endpoint`."""
        self.send(DOWN, datagram.peer)
        self._left -= 1
        if self._left == 0:
            self._answered.set_result(None)

    def wake(self, *, now_ns: int) -> None:
        """See `Endpoint`."""

    def next_wake_ns(self) -> int | None:
        """See `Endpoint`."""
        return None


class PlainShell(Shell):
    """Shell that makes a system call for each datagram."""

    def _batch(self, sock: socket.socket) -> Batch | None:  # noqa: ARG002
        return None

    def _send_together(self, row: Sequence[Datagram]) -> int:  # noqa: ARG002
        return 0


SHELLS: Mapping[str, type[Shell]] = {"plain": PlainShell, "batches": Shell}


def measure(counts: SocketCounts) -> dict[str, Any]:
    """CPU time per datagram and answer, by number of vehicles and kind of shell."""
    lateness, rng = Lateness(), np.random.default_rng(1)
    allow_sockets(max(VEHICLES))
    spent: dict[str, dict[str, list[float]]] = {}
    with ExitStack() as stack:
        runner = stack.enter_context(asyncio.Runner(loop_factory=new_event_loop))
        loop = runner.get_loop()
        ends: dict[str, tuple[Answering, Address]] = {}
        for name, kind in SHELLS.items():
            endpoint = Answering()
            shell = kind(endpoint, (HOST, 0))
            task = loop.create_task(shell.run())
            stack.callback(task.cancel)
            ends[name] = endpoint, shell.address
        vehicles = [stack.enter_context(open_socket((HOST, 0))) for _ in range(max(VEHICLES))]
        with without_gc():
            for count in progress(VEHICLES, "sockets"):
                each = spent[str(count)] = {name: [] for name in SHELLS}
                for _ in range(max(counts.turns, counts.datagrams // count)):
                    for name in rng.permutation(list(SHELLS)).tolist():
                        endpoint, address = ends[name]
                        lateness.sleep(0.0005)
                        for vehicle in vehicles[:count]:
                            vehicle.sendto(UP, address)
                        answered = loop.create_future()
                        endpoint.expect(count, answered)
                        start_ns = time.process_time_ns()
                        loop.run_until_complete(answered)
                        each[name].append((time.process_time_ns() - start_ns) / count)
                        for vehicle in vehicles[:count]:
                            assert len(vehicle.recv(len(DOWN) + 1)) == len(DOWN)
    figures = {
        count: {name: figures_us(durations) for name, durations in each.items()}
        for count, each in spent.items()
    }
    return {"vehicles": figures, "wake": lateness.figures()}


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    """Table with a row for each number of vehicles."""
    rows = []
    for count, figures in result["vehicles"].items():
        plain, batches = (figures[name] for name in SHELLS)
        row = [count]
        for each in (plain, batches):
            row += [us(each[share]) for share in ("p50_us", "p99_us")]
        rows.append([*row, f"{batches['p50_us'] / plain['p50_us']:.2f}"])
    headings = ["vehicles", "plain p50 [µs]", "p99", "in batches p50 [µs]", "p99", "ratio of p50"]
    return {"sockets": TextTable(headings, rows)}
