"""Observer of a flight over real UDP who copies each packet and forwards the answers."""

import asyncio
import io
from contextlib import AsyncExitStack
from dataclasses import dataclass, field

import pytest

import skytether.client.failsafe
import skytether.shared.wire.channel
from helpers import LOOPBACK, Idle, driven
from skytether.client.endpoint import Client
from skytether.client.secure import SecureLink
from skytether.client.simulated.vehicle import simulated
from skytether.server.endpoint import Server
from skytether.server.secure import SecureGate
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.endpoint import Address, Datagram
from skytether.shared.core.events import Event, ModeChanged
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Recorder, client_columns, parse
from skytether.shared.telemetry.summary import summarise
from skytether.shell.driver import Shell
from skytether.sim.flight import make_keys

pytestmark = pytest.mark.long

SERVER_SIDE, OWN, ADDRESSES = 1, 2, 50
"""Socket towards the server, first of the observer's own, and number of these."""


class Observer(Idle):
    """Observer that passes on everything at once between a vehicle and its server.

    Args:
        server: address of the server.
        attacks: whether copies of the vehicle's packets go to the server from other addresses,
            before the originals, and all packets from the server go to the vehicle twice more, from
            the server's address and from another one, as do the answers to the copies.
    """

    def __init__(self, server: Address, *, attacks: bool) -> None:
        super().__init__()
        self._server, self._attacks = server, attacks
        self._vehicle: Address | None = None
        self.copied = 0

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        payload, peer, socket = datagram
        own = OWN + self.copied % ADDRESSES
        if socket == 0:
            self._vehicle = peer
            if self._attacks:
                self.copied += 1
                self.send(payload, self._server, own)
            self.send(payload, self._server, SERVER_SIDE)
            return
        assert self._vehicle is not None
        if socket == SERVER_SIDE:
            self.send(payload, self._vehicle)
        if self._attacks:
            self.send(payload, self._vehicle)
            self.send(payload, self._vehicle, own)


@dataclass
class Outcome:
    rmse_m: float
    changes: list[tuple[str, str]] = field(default_factory=list)
    keys: int = 0
    """Number of channels in which the vehicle has sent."""
    copied: int = 0


async def fly(flown: Scenario, *, attacked: bool, restart_s: float) -> Outcome:
    keyring, sink, changes = make_keys(flown.seed, 1), io.BytesIO(), []
    entropy = stream(flown.seed, "entropy", int(attacked)).bytes

    def server(life: int, bind: Address) -> Shell:
        gate = SecureGate(keyring, entropy=entropy)
        return Shell(Server(flown, boot_id=life, entropy=entropy, gate=gate), bind)

    def hear(event: Event) -> None:
        if isinstance(event, ModeChanged):
            changes.append((event.after, event.reason))

    first = server(1, LOOPBACK)
    observer = Observer(first.address, attacks=attacked)
    between = Shell(observer, LOOPBACK, [first.address])
    link = SecureLink(keyring.of(1), entropy=entropy)
    recorder = Recorder(client_columns(flown.model.axes), sink)
    client = Client(
        flown,
        simulated(flown, 1),
        server=between.address,
        vehicle=1,
        boot_id=1,
        link=link,
        recorder=recorder,
    )
    used = set()
    seal = link.seal

    def noted(payload: bytes) -> bytes:
        used.add(link._current)
        return seal(payload)

    link.seal = noted  # type: ignore[method-assign]
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(driven(between))
        life = asyncio.create_task(first.run())
        flight = asyncio.create_task(Shell(client, LOOPBACK).run(hear))
        await asyncio.sleep(restart_s)
        first.endpoint.close = lambda **_: None  # type: ignore[method-assign]  # it is killed
        life.cancel()
        await asyncio.gather(life, return_exceptions=True)
        await stack.enter_async_context(driven(server(2, first.address)))
        await asyncio.wait_for(flight, flown.duration + 20.0)
    summary = summarise(flown, "test", parse(sink.getvalue()))
    assert summary.rmse_xy is not None
    return Outcome(summary.rmse_xy, changes, len(used), observer.copied)


async def test_an_observer_who_can_send_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restarts and new keys every 15 s work as without the observer; two flights, compared."""
    monkeypatch.setattr(skytether.shared.wire.channel, "FRESH_NS", 15 * SECOND_NS)
    monkeypatch.setattr(skytether.client.failsafe, "STALL_NS", 60 * SECOND_NS)  # busy machines
    table = reading.to_table(reading.load("demo")) | {"duration": 60.0}
    table["vehicle"]["report"] = "always"  # many packets to copy
    flown = reading.check(table, "test")
    alone, attacked = await asyncio.gather(
        fly(flown, attacked=False, restart_s=25.0), fly(flown, attacked=True, restart_s=25.0)
    )
    rmse_m = f"{alone.rmse_m:.4f} m alone, {attacked.rmse_m:.4f} m attacked"
    print(f"RMSE {rmse_m}; {attacked.copied} copies; {attacked.changes}")
    assert attacked.changes == alone.changes
    assert [after for after, _ in attacked.changes].count("track") == 2
    assert attacked.keys >= alone.keys >= 4
    assert attacked.copied > 1000
    assert attacked.rmse_m == pytest.approx(alone.rmse_m, rel=0.1)
