"""Floods of a server during a flight over real UDP: forged packets, and HELLOs from many ports.

Five vehicles of `demo-committed` fly on a sealed link, 100 observations a second; the network is
not impaired, so every loss is due to the flood. An attacker on the path has recorded packets, and
floods the server's port. Of forged packets, half have the header, length and channel of a vehicle's
packet, and half are random bytes. Of HELLOs, half are random bytes under a valid header, and half
are repetitions of real ones, each from its own port. During the flood another vehicle starts. The
same flight without a flood is measured for comparison.

The flood is sent by absolute deadlines, one batch per millisecond.
"""

import math
import socket
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from bench.children import HOST, PATIENCE_S, ChildProcess, Lab
from bench.harness import TextTable, WakeLateness, progress, sleep_until
from bench.netem import answer, scheduled_ns, start
from bench.problems import derive
from skytether.netem.proxy import Proxy
from skytether.server.secure import FORMS
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.events.flight import Flying
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry import parts
from skytether.shared.telemetry.summary import position_error
from skytether.shared.wire import channel, handshake
from skytether.shell.driving import driver
from skytether.shell.host.batch import BATCH_MAX, DatagramBatch, pack_address

VEHICLES = 5
NEWCOMER = VEHICLES + 1
"""Number of the vehicle that starts during the flood."""
AFTER_S = 2.0
"""Time of flight after the flood [s]."""
POOL = 4096
"""Number of different packets, which are sent repeatedly."""
PORTS_MAX = 500
"""Number of sockets that a sender of HELLOs keeps open, so that answers reach no other process."""
NONE, FORGED, HELLOS = KINDS = ("none", "forged packets", "HELLOs")
HANDLED, SESSION_S, GROWTH_BYTES = 0.999, 3.0, 5_000_000
"""Targets: share of valid packets handled, time to a session [s], growth of memory [B]."""


@dataclass(frozen=True)
class FloodCounts:
    seconds: int
    forged: int
    """Number of forged packets a second."""
    hellos: int
    """Number of HELLOs a second."""
    lead_s: float = 6.0
    """Time of flight before the flood [s]."""


FULL, QUICK = FloodCounts(30, 100_000, 10_000), FloodCounts(3, 20_000, 2000)


@dataclass(frozen=True)
class Flood:
    kind: str
    sent: float
    """Flood packets sent per second."""
    read: float
    """Flood packets per second that the server read and dropped."""
    kept_out: float
    """Flood packets per second that the kernel's filter rejected."""
    unread: float
    """Datagrams per second that the kernel dropped because the receive buffer was full."""
    good: int
    lost: int
    """Number of sent observations that the server never handled."""
    share: float
    """Share of the observations sent during the flood that the server handled."""
    missed: int
    """Number of ticks missed during the flood."""
    rmse_m: float
    """RMSE of the vehicles during the flood [m]."""
    session_s: float
    """Time from the first HELLO to the session of the vehicle that starts during the flood [s]."""
    growth_bytes: int
    """Growth of the server's memory [B]."""
    server_cpu: float
    """Share of a core that the server used."""
    server_waited: float
    """Share of the time that the server was ready to run, but waited for a core."""
    sender_cpu: float
    """Share of a core that the senders used."""


# -- recording packets -----------------------------------------------------------------------------


class Tap(Proxy):
    """Relay to the server that keeps one packet of each type."""

    def __init__(self, scenario: Scenario, server: tuple[str, int]) -> None:
        super().__init__(scenario, server=server)
        self.recorded: dict[int, bytes] = {}

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        if datagram.socket == 0:
            self.recorded[channel.kind(datagram.payload)] = datagram.payload
        super().receive(datagram, now_ns=now_ns)


def tap(pipe: Connection, port: int) -> None:
    """Forward packets to the server's port; sends its own port, and on request the kept packets."""
    endpoint = Tap(derive("demo", network={"uplink": "", "downlink": ""}), (HOST, port))
    shell = driver.Shell(endpoint, (HOST, 0), [(HOST, port)])
    pipe.send(shell.address[1])

    def answer_request() -> None:
        if pipe.poll():
            pipe.recv()
            pipe.send(endpoint.recorded)

    driver.run([shell], on_second=answer_request)


# -- packets of the flood --------------------------------------------------------------------------


def forgeries(good: bytes) -> list[bytes]:
    """Forged packets: random bytes under the header of the packet `good`, and bare random bytes."""
    rng = np.random.default_rng(1)
    packets = []
    for number in range(POOL):
        if number % 2:
            packets.append(rng.bytes(len(good)))
            continue
        vehicle, used = channel.address(good)
        # Counters ahead of the newest packet's: an old one would be refused for its age.
        counter = 10_000 + int(rng.integers(100_000))
        header = channel.HEADER.pack(channel.VERSION, channel.DATA, vehicle, used, counter)
        packets.append(header + rng.bytes(len(good) - len(header)))
    return packets


def hellos(good: bytes) -> list[bytes]:
    """INITIATIONs: a real one, and random ones with its header."""
    rng, head = np.random.default_rng(1), good[: handshake.HEADER.size]
    return [
        good if number % 2 else head + rng.bytes(len(good) - len(head)) for number in range(POOL)
    ]


def flood(
    pipe: Connection, port: int, packets: list[bytes], rate: int, seconds: int
) -> tuple[int, int]:
    """Send packets, many per system call; returns their number, and the CPU time [ns]."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    batch, peer = DatagramBatch(socket.AF_INET), pack_address((HOST, port))
    sent, used_ns = 0, 0
    for due in _batches(pipe, rate, seconds):
        used_ns = used_ns or time.process_time_ns()
        while sent < due:
            first = sent % len(packets)
            chunk = packets[first : first + min(due - sent, BATCH_MAX)]
            sent += batch.send(sock, chunk, [peer] * len(chunk))
    return sent, time.process_time_ns() - used_ns


def call(
    pipe: Connection, port: int, packets: list[bytes], rate: int, seconds: int
) -> tuple[int, int]:
    """Send each packet from its own port; returns their number, and the CPU time [ns]."""
    sockets: deque[socket.socket] = deque()
    sent, used_ns = 0, 0
    for due in _batches(pipe, rate, seconds):
        used_ns = used_ns or time.process_time_ns()
        while sent < due:
            if len(sockets) == PORTS_MAX:
                sockets.popleft().close()
            sockets.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            sockets[-1].sendto(packets[sent % len(packets)], (HOST, port))
            sent += 1
    return sent, time.process_time_ns() - used_ns


def _batches(pipe: Connection, rate: int, seconds: int) -> Iterator[int]:
    """Number of packets due by each millisecond; missed batches are not caught up with."""
    pipe.send("ready")
    pipe.recv()
    start_ns, end_ns = time.monotonic_ns(), seconds * SECOND_NS
    while (passed_ns := time.monotonic_ns() - start_ns) < end_ns:
        yield rate * passed_ns // SECOND_NS
        sleep_until(start_ns + (passed_ns // MILLISECOND_NS + 1) * MILLISECOND_NS)


# -- the flight ------------------------------------------------------------------------------------


def measure(counts: FloodCounts) -> dict[str, Any]:
    """Figures of a flight without a flood, and with each flood."""
    lateness = WakeLateness()
    floods = [_fly(kind, counts, lateness) for kind in progress(KINDS, "floods")]
    return {
        "counts": asdict(counts),
        "floods": [asdict(each) for each in floods],
        "wake": lateness.figures(),
    }


@dataclass(frozen=True)
class _State:
    time_ns: int
    dropped: int
    """Number of datagrams that the server has dropped."""
    gone: int
    """Number of datagrams that the kernel has dropped."""
    missed: int
    bytes: int
    used_ns: int
    """CPU time of the server."""
    waited_ns: int
    """Time for which the server has waited for a core."""

    @classmethod
    def of(cls, server: ChildProcess) -> "_State":
        resident, figures = server.resident_bytes(), server.figures()
        return cls(
            time.monotonic_ns(),
            sum(figures["dropped"].values()),
            figures["kernel_drops"],
            figures["missed"],
            resident,
            *scheduled_ns(server.process.pid).tolist(),
        )


def _fly(kind: str, counts: FloodCounts, lateness: WakeLateness) -> Flood:
    duration_s = counts.lead_s + counts.seconds + AFTER_S
    # The vehicle reports at every step, so that each missing report counts as lost.
    scenario = derive(
        "demo-committed", duration=duration_s, settle=0.0, vehicle={"report": "always"}
    )
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="skytether-")))
        lab = Lab(stack, folder, scenario, range(1, NEWCOMER + 1))
        server = lab.server()
        port = server.address[1]
        way = start(stack, tap, port)
        fleet = lab.client((HOST, answer(way)), folder / "fleet", 1, "--vehicles", str(VEHICLES))
        fleet.wait_for(Flying, VEHICLES)
        lateness.sleep(counts.lead_s)
        way.send("what has passed?")
        packets = _packets(kind, answer(way))
        sender = _sender(stack, kind, counts, port, packets)

        before = _State.of(server)
        if sender:
            sender.send("go")
        newcomer = lab.client(server.address, folder / "newcomer", NEWCOMER)
        lateness.sleep(counts.seconds)
        sent, sender_ns = answer(sender) if sender else (0, 0)
        after = _State.of(server)

        session_s = math.inf
        if flies := newcomer.all(Flying):
            session_s = (flies[0].time_ns - newcomer.listening_ns()) / SECOND_NS
            newcomer.stop()
        fleet.process.wait(PATIENCE_S)
        end = server.figures()
        rows = [parts.read(folder / "fleet")]
        rows += [parts.read(folder / "newcomer")] if flies else []
        passed_ns = after.time_ns - before.time_ns
    good, gone = sum(map(len, rows)), after.gone - before.gone
    strange = sum(not is_admitted(packet) for packet in packets)
    kept_out = min(gone, sent * strange // POOL)
    lost = good - end["observations"]
    times_s = [each["step"] * scenario.control.dt for each in rows]
    meanwhile = [
        each[(t >= counts.lead_s) & (t < counts.lead_s + counts.seconds)]
        for each, t in zip(rows, times_s, strict=True)
    ]
    error = position_error(scenario, meanwhile[0])
    return Flood(
        kind=kind,
        sent=sent / counts.seconds,
        read=(after.dropped - before.dropped) / counts.seconds,
        kept_out=kept_out / counts.seconds,
        unread=(gone - kept_out) / counts.seconds,
        good=good,
        lost=lost,
        share=1.0 - lost / max(1, sum(map(len, meanwhile))),
        missed=after.missed - before.missed,
        rmse_m=float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())),
        session_s=session_s,
        growth_bytes=after.bytes - before.bytes,
        server_cpu=(after.used_ns - before.used_ns) / passed_ns,
        server_waited=(after.waited_ns - before.waited_ns) / passed_ns,
        sender_cpu=sender_ns / SECOND_NS / counts.seconds,
    )


def is_admitted(packet: bytes) -> bool:
    """Whether the kernel's filter of a server with keys accepts a packet."""
    return any(
        packet.startswith(form.head) and form.least <= len(packet) <= form.most for form in FORMS
    )


def _packets(kind: str, recorded: Mapping[int, bytes]) -> list[bytes]:
    if kind == FORGED:
        return forgeries(recorded[channel.DATA])
    return hellos(recorded[handshake.INITIATION]) if kind == HELLOS else []


def _sender(
    stack: ExitStack, kind: str, counts: FloodCounts, port: int, packets: list[bytes]
) -> Connection | None:
    match kind:
        case "forged packets":
            sender = start(stack, flood, port, packets, counts.forged, counts.seconds)
        case "HELLOs":
            sender = start(stack, call, port, packets, counts.hellos, counts.seconds)
        case _:
            return None
    answer(sender)
    return sender


def floods_of(result: Mapping[str, Any]) -> list[Flood]:
    return [Flood(**each) for each in result["floods"]]


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    floods = floods_of(result)
    rows = {
        "packets of the flood sent [1/s]": [f"{each.sent:.0f}" for each in floods],
        "read and refused [1/s]": [f"{each.read:.0f}" for each in floods],
        "rejected by the kernel's filter [1/s]": [f"{each.kept_out:.0f}" for each in floods],
        "dropped by a full buffer [1/s]": [f"{each.unread:.0f}" for each in floods],
        "observations sent": [str(each.good) for each in floods],
        "observations never handled": [str(each.lost) for each in floods],
        f"share handled during the flood (≥ {HANDLED:.1%})": [
            f"{each.share:.2%}" for each in floods
        ],
        "ticks missed": [str(each.missed) for each in floods],
        "RMSE [m]": [f"{each.rmse_m:.4f}" for each in floods],
        f"session of a new vehicle after [s] (≤ {SESSION_S:g})": [
            f"{each.session_s:.2f}" for each in floods
        ],
        f"growth of the server's memory [MB] (< {GROWTH_BYTES / 1e6:g})": [
            f"{each.growth_bytes / 1e6:.1f}" for each in floods
        ],
        "server, share of a core": [f"{each.server_cpu:.0%}" for each in floods],
        "server waited for a core": [f"{each.server_waited:.0%}" for each in floods],
        "sender, share of a core": [f"{each.sender_cpu:.0%}" for each in floods],
    }
    headings = ["flood", *(each.kind for each in floods)]
    return {"flood": TextTable(headings, [[name, *cells] for name, cells in rows.items()])}
