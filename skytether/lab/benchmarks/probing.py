"""Results of `skytether probe` on known networks.

    python -m skytether.lab.benchmarks.probing

Each setting is a netem network in virtual time, with equal impairments both ways and a listener
whose clock is an hour ahead and drifts. The measurement is compared with the network's settings,
and with the fate of every packet, from netem's record.
"""

import re
import sys
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import msgspec
import tyro

from skytether.client.link import PlainLink
from skytether.lab.benchmarks.harness import TextTable, progress
from skytether.netem.proxy import Proxy
from skytether.probe.listener import Listener
from skytether.probe.outcome import PathTold, WayTold, outcome
from skytether.probe.prober import MeasuredPath, Prober
from skytether.probe.wire import NONCE_BYTES
from skytether.server.gate import PlainGate
from skytether.shared.base import files
from skytether.shared.base.units import HEADER_BYTES, SECOND_NS
from skytether.shared.scenario.air.path import path
from skytether.shared.scenario.schema import DirectionConfig, NetworkConfig, Scenario
from skytether.shared.telemetry.record import PACKET_COLUMNS, Recorder, Rows, parse
from skytether.sim.world import Clock, World

SETTINGS = (
    "constant(0.05) & loss(0.02)",
    "uniform(0.02, 0.1) & loss(0.3)",
    "normal(0.1, 0.015) & gilbert_elliott(0.1, 0.5)",
    "gamma(0.02, 0.06, 0.02) & loss(0.1)",
    "gamma(0.1, 0.13, 0.03) & gilbert_elliott(0.2, 1)",
    "lognormal(0.02, 0.06, 0.04) & loss(0.05)",
    "lognormal(0.1, 0.15, 0.02) & gilbert_elliott(0.05, 0.3)",
    "paper(0.4, 0.02, 2) & loss(0.1)",
    "gamma(0.02, 0.04, 0.01) & loss(0.05) & rate(50000)",
    "lognormal(0.01, 0.02, 0.005) & gilbert_elliott(0.1, 0.4) & rate(12500, queue=20000)",
)
"""Networks, equal both ways."""
CLOCK = Clock(3600 * SECOND_NS, 20_000)
"""Clock of the listener: an hour ahead, and 20 ppm fast."""


@dataclass(frozen=True)
class ProbingOptions:
    """Options of this benchmark."""

    seconds: float = 600.0
    """Length of each measurement [s]."""
    rate: float = 20.0
    """Packets a second."""
    bytes: int = 400
    """UDP payload of each packet [B]."""
    seed: int = 1
    settings: tuple[str, ...] = SETTINGS
    """Networks to measure."""
    markdown: Path | None = None
    """File for the table as Markdown."""


def measure(
    uplink: str,
    downlink: str,
    *,
    seconds: float,
    rate: float = 20.0,
    size: int = 400,
    seed: int = 1,
    clock: Clock = CLOCK,
) -> tuple[MeasuredPath, Rows]:
    """Measure a netem network in virtual time.

    Args:
        uplink, downlink: impairments.
        seconds: length of the measurement [s].
        rate: packets a second.
        size: UDP payload of each packet [B].
        seed: seed of the network.
        clock: clock of the listener.

    Returns:
        The measurement, and netem's rows.
    """
    network = NetworkConfig(
        uplink=DirectionConfig(impairments=uplink), downlink=DirectionConfig(impairments=downlink)
    )
    sink, world = BytesIO(), World()
    listener = world.add("listener", Listener(PlainGate(), b"secret" * 5), clock=clock)
    recorder = Recorder(PACKET_COLUMNS, sink)
    scenario = msgspec.structs.replace(Scenario(), network=network, seed=seed)
    netem = world.add("netem", Proxy(scenario, server=listener, recorder=recorder))
    prober = Prober(
        PlainLink(),
        netem,
        bytes(range(NONCE_BYTES)),
        probes=round(seconds * rate),
        period_ns=round(SECOND_NS / rate),
        size=size,
    )
    world.add("prober", prober)
    world.run(lambda: prober.finished, limit_ns=round((seconds + 120.0) * SECOND_NS))
    return prober.measured(), parse(sink.getvalue())


def number(text: str, name: str, place: int) -> float | None:
    """Argument of an impairment in a text; None if the text lacks that impairment."""
    found = re.search(rf"\b{name}\(([^)]*)\)", text)
    return float(found[1].split(",")[place]) if found else None


def against(found: float | None, asked: float | None, form: str) -> str:
    """Figure with its error relative to the set value; a dash if there is none."""
    if not found or not asked:
        return "-"
    return f"{found:{form}} ({found / asked - 1.0:+.1%})"


def models(text: str) -> set[str]:
    """Names of the delays and losses in a text."""
    return {name for name, _ in path(text).impairments} - {"rate", "ordered"}


def row(text: str, told: PathTold, name: str) -> list[str]:
    """Measured figures of a direction, beside the set ones.

    Args:
        text: impairments of both directions.
        told: measured figures.
        name: uplink or downlink.
    """
    way: WayTold = getattr(told, name)
    rate = number(text, "rate", 0)
    mean_s = path(text).mean_s + ((told.bytes + HEADER_BYTES) / rate if rate else 0.0)
    found, asked = (number(each, "gilbert_elliott", 1) for each in (way.text, text))
    return [
        f"`{text}`, {name}",
        f"{told.round_trip_mean_s / 2 / mean_s - 1:+.2%}",
        against(1e3 * way.mean_s, 1e3 * mean_s, ".2f"),
        f"{way.loss:.2%} ({way.loss_low:.2%} to {way.loss_high:.2%})",
        against(found, asked, ".3f"),
        against(way.rate_bytes_per_s, rate, ".0f"),
        "yes" if models(text) == models(way.text) else way.text,
    ]


def table(options: ProbingOptions) -> TextTable:
    """Measure every network; a row for each direction."""
    rows = []
    for text in progress(options.settings, "networks"):
        measured, _ = measure(
            text,
            text,
            seconds=options.seconds,
            rate=options.rate,
            size=options.bytes,
            seed=options.seed,
        )
        told = outcome(measured, "virtual", secure=False).told
        rows += [row(text, told, name) for name in ("downlink", "uplink")]
    delays = ["round trip,\nmean", "one way, mean\n[ms]"]
    losses = ["lost,\n95 % interval", "burst\n[s]", "rate\n[B/s]"]
    return TextTable(["network", *delays, *losses, "best models\nare the true ones"], rows)


def main() -> int:
    """Measure as the command line says, and print the table."""
    options = tyro.cli(ProbingOptions, description=__doc__)
    found = table(options)
    found.show(f"probed for {options.seconds:g} s, {options.rate:g} packets a second")
    if options.markdown:
        files.write(options.markdown, found.markdown().encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
