"""Impairments over real UDP compared with theory; and netem beside other user-space relays.

    python -m skytether.lab.benchmarks.impairments

Packets go through a real netem process on 127.0.0.1. Measured delays are compared with the
requested distribution (Kolmogorov-Smirnov, after subtracting the median of netem's own error), the
share lost with its 95 % interval, and received bytes with the rate. A second table has the added
delay and CPU use of other relays that are installed on this machine.
"""

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tyro
from scipy import stats

from skytether.lab.benchmarks import netem
from skytether.lab.benchmarks.harness import CONSOLE, TextTable, progress, quantile_ms
from skytether.lab.benchmarks.netem import (
    HEAD,
    HOST,
    NetemBenchmarkOptions,
    answer,
    receive,
    scheduled_ns,
    send,
    start,
    start_netem,
)
from skytether.shared.base.units import HEADER_BYTES, SECOND_NS
from skytether.shared.law.model import Array
from skytether.shared.scenario.air.path import path
from skytether.shared.telemetry.record import DOWNLINK, read

DELAYS = {
    "paper(0.4, 0.02, 2)": None,
    "uniform(0.02, 0.1)": stats.uniform(0.02, 0.08),
    "normal(0.1, 0.02)": stats.norm(0.1, 0.02),
    "gamma(0.02, 0.06, 0.02)": stats.gamma(4, loc=0.02, scale=0.01),
    "lognormal(0.02, 0.06, 0.03)": stats.lognorm(
        np.sqrt(np.log(1 + 0.75**2)), 0.02, 0.04 / np.sqrt(1 + 0.75**2)
    ),
}
"""Delay laws, and their distributions if continuous."""
LOSSES = ("loss(0.1)", "gilbert_elliott(0.2, 0.1)", "outages(1, 0.25)")
RATES = ("rate(50000)", "rate(50000, drop=codel)", "rate(50000, serve=fair)")
RELAY = """
import asyncio, socket, sys
loop, server, delay = asyncio.new_event_loop(), (sys.argv[1], int(sys.argv[2])), float(sys.argv[3])
class Relay(asyncio.DatagramProtocol):
    def connection_made(self, transport): self.transport = transport
    def datagram_received(self, data, peer):
        if delay: loop.call_later(delay, self.transport.sendto, data, server)
        else: self.transport.sendto(data, server)
transport, _ = loop.run_until_complete(
    loop.create_datagram_endpoint(Relay, local_addr=("127.0.0.1", 0)))
print(transport.get_extra_info("sockname")[1], flush=True)
loop.run_forever()
"""
"""Typical self-written relay: asyncio with one timer per packet."""


@dataclass(frozen=True)
class ImpairmentsBenchmarkOptions:
    """Options of this benchmark."""

    seconds: int = 10
    """Duration of each run [s]."""
    rate: int = 1000
    """Number of packets per second; the relays also carry ten times as many."""


@dataclass(frozen=True)
class Passage:
    """Packets received in a run."""

    delays_s: Array
    """Measured delays of the received packets [s]; shape (n,)."""
    numbers: Array
    """Numbers of the received packets; shape (n,)."""
    sent: int
    took_s: float
    """Time from the first arrival to the last [s]."""
    cpu: float
    """Share of a core that the relay used."""


def carried(
    stack: ExitStack, options: NetemBenchmarkOptions, port: int, receiver: Any, pid: int
) -> Passage:
    """Send packets to a port, and receive them at the other end."""
    sender = start(stack, send, options, port)
    answer(sender)
    used_ns, start_ns = scheduled_ns(pid), time.monotonic_ns() + SECOND_NS // 10
    for pipe in (receiver, sender):
        pipe.send(start_ns)
    sent = answer(sender)
    used_ns = scheduled_ns(pid) - used_ns
    heads, arrivals, _ = answer(receiver)
    numbers, stamps = np.frombuffer(heads, "<i8").reshape(-1, 2).T
    took_s = float(np.ptp(arrivals)) / SECOND_NS if len(arrivals) else 0.0
    delays_s = (np.array(arrivals) - stamps) / SECOND_NS
    return Passage(delays_s, numbers, sent, took_s, used_ns[0] / SECOND_NS / options.seconds)


def through_netem(text: str, options: NetemBenchmarkOptions) -> tuple[Passage, Array]:
    """Packets through netem, and the delays that netem recorded, by number [s]; NaN for lost
    ones.
    """
    with ExitStack() as stack:
        receiver = start(stack, receive, options)
        record = Path(stack.enter_context(TemporaryDirectory())) / "netem.rec"
        flags = ("--network.downlink", text, "--network.uplink", "constant(0)")
        process, port = start_netem(stack, answer(receiver), 1, record, flags)
        passage = carried(stack, options, port, receiver, process.pid)
        process.terminate()
        process.communicate(timeout=netem.PATIENCE_S)
        rows = read(record)
    rows = rows[(rows["direction"] == DOWNLINK) & ~rows["lost"]]
    drawn_s = np.full(passage.sent, np.nan)
    drawn_s[rows["number"]] = rows["delay_ns"] / SECOND_NS
    return passage, drawn_s


def through_relay(command: Sequence[str], options: NetemBenchmarkOptions) -> Passage:
    """Packets through another relay, which prints its port, or gets it as {port}."""
    with ExitStack() as stack:
        receiver = start(stack, receive, options)
        to = answer(receiver)
        with netem.open_blocking() as free:
            port = free.getsockname()[1]
        filled = [word.replace("{to}", str(to)).replace("{port}", str(port)) for word in command]
        relay = subprocess.Popen(filled, stdout=subprocess.PIPE, text=True)
        stack.callback(relay.wait)
        stack.callback(relay.kill)
        assert relay.stdout is not None
        if "{port}" in " ".join(command):
            time.sleep(0.5)  # this relay prints nothing: wait until it listens
        else:
            port = int(relay.stdout.readline())
        return carried(stack, options, port, receiver, relay.pid)


def theory_table(options: NetemBenchmarkOptions) -> TextTable:
    """Results of each impairment beside the requested values."""
    rows = []
    for text in progress([*DELAYS, *LOSSES, *RATES], "impairments"):
        passage, drawn_s = through_netem(text, options)
        error_s = passage.delays_s - drawn_s[passage.numbers]
        error_s = error_s[np.isfinite(error_s)]
        rows.append([text, *judged(text, passage, float(np.median(error_s)), options)])
        rows[-1] += [f"{quantile_ms(error_s * SECOND_NS, share):.2f}" for share in (0.5, 0.99)]
    headings = ["impairment", "asked for", "seen", "verdict", "error [ms]\np50", "\np99"]
    return TextTable(headings, rows)


def judged(
    text: str, passage: Passage, error_s: float, options: NetemBenchmarkOptions
) -> tuple[str, str, str]:
    """Requested value, measured value, and how likely the difference is."""
    delays_s, law = passage.delays_s - error_s, DELAYS.get(text)
    if text in DELAYS:
        asked, seen = f"{path(text).mean_s * 1e3:.1f} ms", f"{delays_s.mean() * 1e3:.1f} ms"
        if law is not None:
            return asked, seen, f"KS p = {stats.kstest(delays_s, law.cdf).pvalue:.3f}"
        slots = np.clip(np.rint((delays_s - 0.4) / 0.02), 0, 7).astype(int)
        shares = [*stats.poisson.pmf(range(7), 2), stats.poisson.sf(6, 2)]
        counts = np.bincount(slots, minlength=8)
        p = stats.chisquare(counts, np.multiply(shares, len(slots))).pvalue
        return asked, seen, f"χ² p = {p:.3f}"
    if text in LOSSES:
        lost = passage.sent - len(passage.numbers)
        asked, seen = f"{path(text).loss:.3f} lost", f"{lost / passage.sent:.3f} lost"
        if text.startswith("loss"):
            interval = stats.binomtest(lost, passage.sent).proportion_ci()
            return asked, seen, f"95 %: {interval.low:.3f} to {interval.high:.3f}"
        edges = np.diff(np.flatnonzero(np.diff(passage.numbers, prepend=0) > 1))
        return asked, seen, f"{len(edges) + 1} bursts"
    queue = path(text).queue
    assert queue is not None
    rate = (len(passage.numbers) - 1) * (options.size + HEADER_BYTES) / passage.took_s
    share = rate / queue.bytes_per_s - 1.0
    return f"{queue.bytes_per_s:.0f} B/s", f"{rate:.0f} B/s", f"{share:+.2%}"


def relays_table(options: NetemBenchmarkOptions) -> TextTable:
    """Relays side by side: without a delay, and with one of 50 ms."""
    relay = (sys.executable, "-c", RELAY, HOST, "{to}")
    socat = ("socat", f"UDP4-LISTEN:{{port}},bind={HOST}", f"UDP4:{HOST}:{{to}}")
    rows = []
    for many in (1, 10):
        each = NetemBenchmarkOptions(1, options.seconds, options.rate * many, options.size)
        for delay_s in (0.0, 0.05):
            runs: dict[str, Callable[[], Passage]] = {}
            runs["netem"] = lambda: through_netem(f"constant({delay_s})", each)[0]  # noqa: B023
            runs["asyncio, a timer each"] = lambda: through_relay((*relay, str(delay_s)), each)  # noqa: B023
            if not delay_s and shutil.which("socat"):
                runs["socat"] = lambda: through_relay(socat, each)  # noqa: B023
            for name, run in progress(list(runs.items()), f"{each.rate} packets/s"):
                passage = run()
                late_ns = (passage.delays_s - delay_s) * SECOND_NS
                rows.append(
                    [
                        name,
                        f"{each.rate}",
                        f"{delay_s * 1e3:g}",
                        *(f"{quantile_ms(late_ns, share):.2f}" for share in (0.5, 0.99)),
                        f"{passage.cpu / each.rate * 1e6:.1f}",
                        f"{passage.sent - len(passage.numbers)}",
                    ]
                )
    headings = ["relay", "packets/s", "delay\n[ms]", "added [ms]\np50", "\np99"]
    return TextTable([*headings, "CPU a packet\n[µs]", "lost"], rows)


def has_kernel_netem() -> bool:
    """Whether this machine's kernel has `tc … netem`."""
    tried = ["tc", "qdisc", "add", "dev", "lo", "root", "netem", "delay", "0ms"]
    if not shutil.which("tc"):
        return False
    done = subprocess.run(["unshare", "-n", *tried], capture_output=True, check=False)
    return done.returncode == 0


def main() -> int:
    """Measure as the command line says, and print two tables."""
    given = tyro.cli(ImpairmentsBenchmarkOptions, description=__doc__)
    options = NetemBenchmarkOptions(1, given.seconds, given.rate, 100)
    assert options.size >= HEAD.size
    theory_table(options).show(f"impairments over UDP, {options.packets} packets each")
    relays_table(options).show("relays on 127.0.0.1")
    if not has_kernel_netem():
        CONSOLE.print("tc netem: not compared, this machine's kernel does not have it")
    return 0


if __name__ == "__main__":
    sys.exit(main())
