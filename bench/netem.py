"""Timing error of netem: 20 000 packets/s through a real netem process on 127.0.0.1.

A sender numbers and timestamps its packets; the kernel timestamps them at the receiver. netem's
record contains the delay drawn for each packet. So the error of the added delay is

    (received - sent) - drawn

and includes two passages through the kernel. The machine's share is measured as well: how late a
process that only sleeps wakes, and how long netem waited for a core.

The sender sends in batches, four a millisecond: no process can sleep for 50 µs. With several flows
it sends from one socket after the other. A first packet from each, which is not counted, opens the
flows; the receiver answers one, because netem looks closer until a server has answered.
"""

import contextlib
import gc
import multiprocessing
import signal
import socket
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.children import HOST, ChildProcess
from bench.harness import TextTable, median, progress, quantile_ms, sleep_until
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.events.processes import Counted
from skytether.shared.telemetry.parts import read
from skytether.shared.telemetry.record import DOWNLINK
from skytether.shell.host.udp import open_socket

HEAD = struct.Struct("<qq")
"""Header of a packet: its number and time of sending [ns]; the rest is zeros."""
BATCH_NS = MILLISECOND_NS // 4
SO_TIMESTAMPNS = 35
QUIET_S = 2
"""Silence after which no packet is in flight any more [s]: the paper's delays are far shorter."""
PATIENCE_S = 90.0
"""Longest wait for an answer [s]; the longest run takes 60 s."""

SPAWN = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class NetemBenchmarkOptions:
    runs: int = 5
    seconds: int = 5
    rate: int = 20_000
    size: int = 600
    """UDP payload of each packet [B]."""
    flows: int = 1
    """Number of the clients' addresses."""
    loads: tuple[tuple[int, int], ...] = (
        (50_000, 1),
        (80_000, 1),
        (100_000, 1),
        (20_000, 10),
        (20_000, 1000),
    )
    """Other values of `rate` and `flows` that are measured too, each in as many runs."""

    @property
    def packets(self) -> int:
        return self.rate * self.seconds


FULL, QUICK = (
    NetemBenchmarkOptions(),
    NetemBenchmarkOptions(runs=1, seconds=1, loads=((20_000, 10),)),
)


@dataclass(frozen=True)
class NetemRun:
    sent: int
    received: int
    unread: int
    """Number of packets that netem never read, because its receive buffer was full."""
    error_ms_p50: float
    error_ms_p99: float
    error_ms_max: float
    netem_cpu: float
    """Share of a core that netem used."""
    netem_waited: float
    """Share of the time that netem was ready to run, but waited for a core."""
    wake_ms_p50: float
    """Median lateness of a sleeping process in the same seconds [ms]."""
    wake_ms_p99: float
    wake_ms_max: float
    """Largest lateness of the sleeping process [ms]."""


def work(task: Callable[..., object], pipe: Connection, *args: object) -> None:
    """Run a task in this process, send its result, and wait to be killed.

    The end of a Python process takes a core for 20 ms, which would disturb the measurement.
    """
    gc.disable()
    pipe.send(task(pipe, *args))
    signal.pause()


def send(pipe: Connection, options: NetemBenchmarkOptions, port: int) -> int:
    """Number, timestamp and send packets by absolute deadlines; returns their number."""
    socks = [open_blocking() for _ in range(options.flows)]
    for flow, sock in enumerate(socks):
        sock.connect((HOST, port))
        sock.send(HEAD.pack(flow, 0))  # netem takes equal packets from many addresses for a loop
    packet, number = bytearray(options.size), 0
    pipe.send("ready")
    start_ns = pipe.recv()
    for batch_ns in range(BATCH_NS, options.seconds * SECOND_NS + 1, BATCH_NS):
        sleep_until(start_ns + batch_ns)
        while number < options.rate * batch_ns // SECOND_NS:
            HEAD.pack_into(packet, 0, number, time.monotonic_ns())
            socks[number % options.flows].send(packet)
            number += 1
    return number


def receive(pipe: Connection, options: NetemBenchmarkOptions) -> tuple[bytes, list[int]]:
    """Receive packets; returns headers, and arrival times [ns]."""
    sock = open_blocking()
    pipe.send(sock.getsockname()[1])
    sock.sendto(b"", sock.recvfrom(1)[1])
    for _ in range(1, options.flows):
        sock.recv(1)
    pipe.send("flows are open")
    pipe.recv()
    # The kernel's own time-out: Python's would call poll() before every packet.
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", QUIET_S, 0))
    sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    packet, heads = bytearray(options.size), bytearray()
    arrivals: list[int] = []
    with contextlib.suppress(BlockingIOError):  # no packet for QUIET_S
        while len(arrivals) < options.packets:
            _, ((_, _, stamp),), _, _ = sock.recvmsg_into([packet], 64)
            seconds, ns = struct.unpack("ll", stamp)
            # The kernel's timestamps are on the wall clock.
            wall_to_monotonic_ns = time.monotonic_ns() - time.time_ns()
            arrivals.append(seconds * SECOND_NS + ns + wall_to_monotonic_ns)
            heads += packet[: HEAD.size]
    return bytes(heads), arrivals


def sleep(pipe: Connection, options: NetemBenchmarkOptions) -> list[int]:
    """Sleep until every fourth deadline of the sender; returns the lateness of each wake [ns]."""
    pipe.send("ready")
    start_ns, late_ns = pipe.recv(), []
    for due_ns in range(start_ns, start_ns + options.seconds * SECOND_NS, 4 * BATCH_NS):
        sleep_until(due_ns)
        late_ns.append(time.monotonic_ns() - due_ns)
    return late_ns


def open_blocking() -> socket.socket:
    sock = open_socket((HOST, 0))
    sock.setblocking(True)
    return sock


def measure_once(options: NetemBenchmarkOptions, seed: int) -> NetemRun:
    """Run once, with netem, sender, receiver and sleeper as processes that end with the run."""
    with ExitStack() as stack:
        receiver = start(stack, receive, options)
        record = Path(stack.enter_context(TemporaryDirectory())) / "netem.rec"
        netem = start_netem(stack, answer(receiver), seed, record, options.flows)
        port = netem.address[1]
        sender, sleeper = start(stack, send, options, port), start(stack, sleep, options)
        answer(sender), answer(sleeper), answer(receiver)

        used_ns, start_ns = scheduled_ns(netem.process.pid), time.monotonic_ns() + SECOND_NS // 10
        for pipe in (receiver, sleeper, sender):
            pipe.send(start_ns)
        sent = answer(sender)
        used_ns = scheduled_ns(netem.process.pid) - used_ns
        (heads, arrivals), late_ns = answer(receiver), answer(sleeper)

        netem.stop()
        drawn_ns = drawn_delays_ns(record, sent, options.flows)

    numbers, stamps = np.frombuffer(heads, "<i8").reshape(-1, 2).T
    counted = netem.all(Counted)[-1].event
    assert isinstance(counted, Counted)
    read_packets = counted.figures["downlink"]["packets"] - options.flows
    # A packet that netem never read has no row in the record, and shifts the numbers after it.
    counted_until = sent if read_packets == sent else first_missing(numbers)
    error_ns = (np.array(arrivals) - stamps - drawn_ns[numbers])[numbers < counted_until]
    return NetemRun(
        sent=sent,
        received=len(numbers),
        unread=sent - read_packets,
        error_ms_p50=quantile_ms(error_ns, 0.5),
        error_ms_p99=quantile_ms(error_ns, 0.99),
        error_ms_max=quantile_ms(error_ns, 1.0),
        netem_cpu=used_ns[0] / SECOND_NS / options.seconds,
        netem_waited=used_ns[1] / SECOND_NS / options.seconds,
        wake_ms_p50=quantile_ms(late_ns, 0.5),
        wake_ms_p99=quantile_ms(late_ns, 0.99),
        wake_ms_max=quantile_ms(late_ns, 1.0),
    )


def start(stack: ExitStack, task: Callable[..., object], *args: object) -> Connection:
    """Run a task in a process that ends with the stack; returns the pipe to it."""
    ours, theirs = SPAWN.Pipe()
    process = SPAWN.Process(target=work, args=(task, theirs, *args), daemon=True)
    process.start()
    theirs.close()
    stack.callback(process.join)
    stack.callback(process.kill)
    return ours


def start_netem(
    stack: ExitStack, server_port: int, seed: int, record: Path, flows: int
) -> ChildProcess:
    at = f"--bind={HOST}:0", f"--server={HOST}:{server_port}", f"--record={record}"
    arguments = f"--seed={seed}", f"--flows={flows}", "--network.downlink.loss=0"
    return ChildProcess(stack, "netem", "paper", *at, *arguments)


def answer(pipe: Connection) -> Any:
    """Result of a task's process; waits for it."""
    if not pipe.poll(PATIENCE_S):
        raise TimeoutError("a process of the benchmark does not answer")
    return pipe.recv()


def scheduled_ns(pid: int) -> NDArray[np.int64]:
    """CPU time of a process, and the time that it has waited for a core [ns]; shape (2,)."""
    return np.array(Path(f"/proc/{pid}/schedstat").read_text().split()[:2], dtype=np.int64)


def drawn_delays_ns(record: Path, count: int, flows: int) -> NDArray[np.int64]:
    """Delays that netem drew for the packets to the server, by number [ns]; shape (count,)."""
    rows, drawn_ns = read(record), np.zeros(count, np.int64)
    rows = rows[(rows["direction"] == DOWNLINK) & (rows["number"] > 0)]
    drawn_ns[(rows["number"].astype(np.int64) - 1) * flows + rows["flow"]] = rows["delay_ns"]
    return drawn_ns


def first_missing(numbers: NDArray[np.int64]) -> int:
    present = np.zeros(numbers.max(initial=-1) + 2, bool)
    present[numbers] = True
    return int(present.argmin())


def measure(options: NetemBenchmarkOptions) -> dict[str, Any]:
    """Medians over the runs, at each load."""
    first = options.rate, options.flows
    loads, wake = [], list[NetemRun]()
    for rate, flows in (first, *options.loads):
        runs = measure_all(replace(options, rate=rate, flows=flows))
        loads.append({"rate": rate, "flows": flows, **medians(runs)})
        wake = wake or runs
    return {
        "options": asdict(options),
        "loads": loads,
        "wake": {
            "p50_ms": median(run.wake_ms_p50 for run in wake),
            "p99_ms": median(run.wake_ms_p99 for run in wake),
            "max_ms": max(run.wake_ms_max for run in wake),
        },
    }


def measure_all(options: NetemBenchmarkOptions) -> list[NetemRun]:
    seeds = range(1, options.runs + 1)
    return [
        measure_once(options, seed)
        for seed in progress(seeds, f"netem, {options.rate} packets/s, {options.flows} flows")
    ]


def medians(runs: Sequence[NetemRun]) -> dict[str, float]:
    return {name: median(getattr(run, name) for run in runs) for name in asdict(runs[0])}


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    loads = []
    for load in result["loads"]:
        read_packets = load["sent"] - load["unread"]
        packet_s = load["netem_cpu"] * result["options"]["seconds"] / read_packets
        loads.append(
            [
                f"{load['rate']:.0f}",
                f"{load['flows']:.0f}",
                f"{packet_s * 1e6:.1f}",
                f"{load['error_ms_p50']:.2f}",
                f"{load['error_ms_p99']:.2f}",
                f"{load['error_ms_max']:.1f}",
                f"{load['wake_ms_p50']:.2f}",
                f"{load['wake_ms_p99']:.2f}",
                f"{load['wake_ms_max']:.1f}",
                f"{load['netem_cpu']:.0%}",
                f"{load['netem_waited']:.0%}",
                f"{1 - load['received'] / load['sent']:.1%}",
            ]
        )
    titles = ["packets/s", "flows", "CPU a packet [µs]", "error p50 [ms]", "p99", "max"]
    titles += ["machine p50 [ms]", "p99", "max", "netem CPU", "waited", "lost"]
    return {"netem-loads": TextTable(titles, loads)}
