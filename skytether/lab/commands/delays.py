"""Measurement of the true delays of packets through netem, over UDP on loopback."""

import asyncio
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from skytether.cli.processes import started
from skytether.shared.base import files
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.flight import address_text
from skytether.shared.law.model import Array
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.parts import read
from skytether.shared.telemetry.record import DOWNLINK, UPLINK

EVERY_S = 0.002
BYTES = 350
"""Size of a packet [B], about that of a horizon."""
LAST_S = 1.0
"""Time to wait for the last packets, in addition to the mean delay [s]."""


class _End(asyncio.DatagramProtocol):
    """Receiving end of the path; records each packet's delay by its number and timestamp."""

    def __init__(self, answers: bool) -> None:
        self._answers = answers
        self._sent = 0
        self.delays_ns: dict[int, int] = {}
        """Delay of each received packet [ns], by its sequence number."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def send(self, peer: Address) -> None:
        stamp = self._sent.to_bytes(8) + time.monotonic_ns().to_bytes(8)
        self.transport.sendto(stamp.ljust(BYTES, b"."), peer)  # type: ignore[attr-defined]
        self._sent += 1

    def datagram_received(self, data: bytes, peer: Address) -> None:
        now_ns = time.monotonic_ns()
        number, sent_ns = int.from_bytes(data[:8]), int.from_bytes(data[8:16])
        self.delays_ns[number] = now_ns - sent_ns
        if self._answers:
            self.send(peer)


def measure(
    scenario: Scenario, folder: Path, packets: int, on_second: Callable[[float], None]
) -> Array:
    """Send packets through netem in one direction, and an answer to each packet in the other.

    Args:
        folder: folder for the scenario file that netem reads, and for netem's record.
        on_second: called often with the elapsed time [s].

    Returns:
        Delays of the received packets, measured and drawn by netem [ms]; shape (packets, 2).

    Raises:
        CommandError: netem failed.
    """
    files.write(folder / "scenario.toml", to_toml(scenario))
    return asyncio.run(_measure(scenario, folder, packets, on_second))


async def _measure(
    scenario: Scenario, folder: Path, packets: int, on_second: Callable[[float], None]
) -> Array:
    loop = asyncio.get_running_loop()
    loopback = ("127.0.0.1", 0)
    back, server = await loop.create_datagram_endpoint(lambda: _End(True), local_addr=loopback)
    forth, client = await loop.create_datagram_endpoint(lambda: _End(False), local_addr=loopback)
    at = address_text(*back.get_extra_info("sockname"))
    file, record = folder / "scenario.toml", folder / "netem.rec"
    arguments = [str(file), "--bind", "127.0.0.1:0", "--server", at, "--record", str(record)]
    try:
        async with started("netem", *arguments) as netem:
            began_s = loop.time()
            for number in range(packets):
                await asyncio.sleep(began_s + number * EVERY_S - loop.time())
                client.send(netem.address)
                on_second(loop.time() - began_s)
            await asyncio.sleep(2.0 * scenario.uplink.mean_s + LAST_S)
    finally:
        back.close()
        forth.close()
    # Rows of netem's record are in order of entry, which is the order of sequence numbers.
    drawn, rows = read(record), []
    for direction, end in ((DOWNLINK, server), (UPLINK, client)):
        of = drawn[drawn["direction"] == direction]
        for number, delay_ns in zip(of["number"].tolist(), of["delay_ns"].tolist(), strict=True):
            if number in end.delays_ns:
                rows.append((end.delays_ns[number], delay_ns))
    return np.array(rows, dtype=np.float64).reshape(-1, 2) / MILLISECOND_NS
