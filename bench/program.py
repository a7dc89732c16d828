"""Programs of others under `netem run`: what ping and iperf3 find, beside what was asked for.

They talk to this machine's loopback, through netem and slirp4netns.
Needs ping, iperf3, and what `netem run` needs. TCP without impairments is also measured through
slirp4netns alone, whose own device in a namespace takes the place of netem.
"""

import json
import math
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bench.children import HOST
from bench.harness import TextTable, median, progress

GATEWAY = "10.0.2.2"
"""Address of this machine's loopback within."""
RATE_BPS = 1e6
"""Finite rate asked for [bit/s], of whole packets of IP."""
HEADERS = {"udp": 28, "tcp": 52}
"""Headers of IP and UDP; of IP and TCP with the options that Linux sends [B]."""
DATAGRAM, SEGMENT = 1400, 1448
"""Payload of a datagram and of a full segment [B]."""
ONE_WAY_S = 0.05
LOST_UP, LOST_DOWN = 0.1, 0.05
SIGMAS = 1.96
"""Half width of the 95 % interval of a count, in standard deviations."""
ALONE = """
ip link set lo up
echo $$ > {at}/pid
while ! ip link show tap0 2>/dev/null | grep -q UP; do sleep 0.05; done
exec {line}
"""
"""Script of a program in a namespace that has slirp4netns alone."""


@dataclass(frozen=True)
class ProgramCounts:
    echoes: int = 4000
    timed: int = 200
    """Echoes whose round trip is measured."""
    seconds: int = 20
    """Length of a transfer at a finite rate, and without impairments [s]."""
    lossy_s: int = 60
    """Length of a transfer over losses [s]."""
    losses: tuple[float, ...] = (0.01, 0.02, 0.03)


FULL = ProgramCounts()
QUICK = ProgramCounts(echoes=200, timed=20, seconds=2, lossy_s=2, losses=(0.02,))


def missing() -> str:
    """What this machine lacks for it, in a line, or empty."""
    for each in ("ping", "iperf3", "unshare"):
        if shutil.which(each) is None:
            return f"{each} is missing"
    line = [sys.executable, "-P", "-m", "skytether", "netem", "run", "--", "true"]
    return subprocess.run(line, capture_output=True, text=True, check=False).stderr.strip()


def run(command: Sequence[str], *options: str) -> tuple[str, dict[str, Any]]:
    """Output of a program under `netem run`, and netem's counters."""
    with TemporaryDirectory() as folder:
        counts = Path(folder) / "counts.json"
        line = [sys.executable, "-P", "-m", "skytether", "netem", "run", f"--json={counts}"]
        done = subprocess.run(
            [*line, *options, "--", *command], stdout=subprocess.PIPE, text=True, check=True
        )
        return done.stdout, json.loads(counts.read_text())


def round_trip_ms(count: int, *options: str) -> float:
    """Median of the round trips of `ping` [ms]."""
    said, _ = run(["ping", "-c", str(count), "-i", "0.02", GATEWAY], *options)
    return median(map(float, re.findall(r"time=([\d.]+)", said)))


def echoes_lost(count: int) -> int:
    ways = f"--to-program=loss({LOST_UP})", f"--from-program=loss({LOST_DOWN})"
    said, _ = run(["ping", "-q", "-c", str(count), "-i", "0.005", GATEWAY], *ways)
    (received,) = re.findall(r"(\d+) received", said)
    return count - int(received)


@contextmanager
def iperf_server() -> Iterator[str]:
    """Server of iperf3 for one client; its port."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        port = str(probe.getsockname()[1])
    line = ["iperf3", "--server", "--one-off", "--bind", HOST, "--port", port, "--forceflush"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            if not any("listening" in line for line in server.stdout):
                raise RuntimeError(f"iperf3 does not listen on port {port}")
            yield port
        finally:
            server.terminate()


def client(port: str, seconds: int, *more: str) -> list[str]:
    at = "--client", GATEWAY, "--port", port, "--time", str(seconds)
    return ["iperf3", *at, "--json", *more]


def received_bps(said: str) -> float:
    return float(json.loads(said)["end"]["sum_received"]["bits_per_second"])


def paced(way: str, protocol: str, seconds: int) -> dict[str, float]:
    """Rate of payload through a finite rate in one direction, asked for and received [bit/s]."""
    more = ["--omit", "2"] if way == "from" else ["--omit", "2", "--reverse"]
    payload = {"udp": DATAGRAM, "tcp": SEGMENT}[protocol]
    if protocol == "udp":
        more += ["--udp", "--bitrate", f"{1.1 * RATE_BPS:.0f}", "--length", str(DATAGRAM)]
    with iperf_server() as port:
        said, _ = run(
            client(port, seconds, *more), f"--{way}-program=rate({RATE_BPS / 8:.0f}, queue=30000)"
        )
    asked = RATE_BPS * payload / (payload + HEADERS[protocol])
    return {"asked": asked, "came": received_bps(said)}


def over_loss(share: float, seconds: int) -> dict[str, float]:
    """Rate of a TCP connection (Reno) from the program over losses, beside the formula of Mathis et
    al. (1997), MSS / RTT · √(3 / (2 p)), for the losses and round trips that it had [bit/s].
    """
    delay = f"constant({ONE_WAY_S})"
    with iperf_server() as port:
        said, counts = run(
            client(port, seconds, "--congestion", "reno"),
            f"--to-program={delay}",
            f"--from-program={delay} & loss({share})",
        )
    down = counts["from_program"]
    rtt_s = json.loads(said)["end"]["streams"][0]["sender"]["mean_rtt"] / 1e6
    had = down["lost"] / down["packets"]
    formula = 8 * SEGMENT / rtt_s * math.sqrt(1.5 / had) if had else math.inf
    return {"asked": formula, "came": received_bps(said)}


def unimpaired(seconds: int, *more: str) -> dict[str, float]:
    """Rate of a TCP connection through slirp4netns alone, and under `netem run` [bit/s]."""
    with iperf_server() as port:
        alone = received_bps(without_netem(client(port, seconds, *more)))
    with iperf_server() as port:
        said, _ = run(client(port, seconds, *more))
    return {"asked": alone, "came": received_bps(said)}


def without_netem(command: Sequence[str]) -> str:
    """Output of a program in a namespace with slirp4netns alone."""
    with TemporaryDirectory() as folder, ExitStack() as stack:
        script, pid_file = ALONE.format(at=folder, line=" ".join(command)), Path(folder, "pid")
        program = subprocess.Popen(
            ["unshare", "--user", "--map-root-user", "--net", "sh", "-c", script],
            stdout=subprocess.PIPE,
            text=True,
        )
        stack.callback(program.kill)
        while program.poll() is None and not (
            pid_file.exists() and pid_file.read_text().endswith("\n")
        ):
            time.sleep(0.01)
        line = ["slirp4netns", "--configure", "--mtu=1500", pid_file.read_text().strip(), "tap0"]
        slirp = subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        stack.callback(slirp.wait)
        stack.callback(slirp.kill)
        return program.communicate()[0]


def measure(counts: ProgramCounts) -> dict[str, Any]:
    bare_ms = round_trip_ms(counts.timed)
    ways = f"--to-program=constant({ONE_WAY_S / 2})", f"--from-program=constant({ONE_WAY_S / 2})"
    rates = {
        f"{protocol} {way}": paced(way, protocol, counts.seconds)
        for way, protocol in progress(
            [("from", "udp"), ("to", "udp"), ("from", "tcp"), ("to", "tcp")],
            "finite rates",
        )
    }
    return {
        "counts": asdict(counts),
        "bare_ms": bare_ms,
        "delayed_ms": round_trip_ms(counts.timed, *ways),
        "lost": echoes_lost(counts.echoes),
        "rates": rates,
        "losses": {
            str(each): over_loss(each, counts.lossy_s) for each in progress(counts.losses, "losses")
        },
        "unimpaired": {
            "from": unimpaired(counts.seconds),
            "to": unimpaired(counts.seconds, "--reverse"),
        },
    }


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    echoes = result["counts"]["echoes"]
    share = LOST_UP + LOST_DOWN - LOST_UP * LOST_DOWN
    mean, half = echoes * share, SIGMAS * math.sqrt(echoes * share * (1 - share))
    rows = [
        ["round trip of `ping` without delays, p50", "-", f"{result['bare_ms']:.1f} ms"],
        [
            f"with {1e3 * ONE_WAY_S / 2:g} ms each way",
            f"{1e3 * ONE_WAY_S:g} ms",
            f"{result['delayed_ms']:.1f} ms",
        ],
        [
            f"lost of {echoes} echoes over loss({LOST_UP}) and loss({LOST_DOWN})",
            f"{mean:.0f} ± {half:.0f}",
            f"{result['lost']}",
        ],
    ]
    rows += [
        [
            f"{protocol.upper()} {way} the program, over {RATE_BPS / 1e6:g} Mbit/s",
            f"{found['asked'] / 1e3:.0f} kbit/s",
            f"{found['came'] / 1e3:.0f} kbit/s",
        ]
        for (protocol, way), found in ((n.split(), f) for n, f in result["rates"].items())
    ]
    rows += [
        [
            f"TCP (Reno) from the program over loss({loss}), by Mathis' formula",
            *(f"{found[each] / 1e6:.2f} Mbit/s" for each in ("asked", "came")),
        ]
        for loss, found in result["losses"].items()
    ]
    rows += [
        [
            f"TCP {way} the program without impairments, by slirp4netns alone",
            *(f"{found[each] / 1e6:.0f} Mbit/s" for each in ("asked", "came")),
        ]
        for way, found in result["unimpaired"].items()
    ]
    return {"program": TextTable(["", "expected", "measured"], rows)}
