"""Observer of a flight who copies each packet and forwards the answers."""

import math
from dataclasses import dataclass, field

import pytest

import skytether.shared.wire.channel
from helpers import Idle
from skytether.client.endpoint import Client
from skytether.client.secure import SecureLink
from skytether.client.simulated.vehicle import simulated
from skytether.server.endpoint import Server
from skytether.server.secure import SecureGate
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.events.flight import Event, ModeChanged
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import MemoryRecorder, client_columns
from skytether.shared.telemetry.summary import summarise
from skytether.sim.sealed import make_keys
from skytether.sim.world import World

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


def fly(flown: Scenario, *, attacked: bool, restart_s: float) -> Outcome:
    keyring, outcome = make_keys(flown.seed, 1), Outcome(math.nan)
    steps = MemoryRecorder(client_columns(flown.model.axes))
    entropy = stream(flown.seed, "entropy", int(attacked)).bytes

    def server(life: int) -> Server:
        gate = SecureGate(keyring, entropy=entropy)
        return Server(flown, boot_id=life, entropy=entropy, gate=gate)

    def hear(_: int, host: str, event: Event) -> None:
        if host == "client" and isinstance(event, ModeChanged):
            outcome.changes.append((event.after, event.reason))

    link = SecureLink(keyring.of(1), entropy=entropy)
    used, seal = set(), link.seal

    def noted(payload: bytes) -> bytes:
        used.add(link._current)
        return seal(payload)

    link.seal = noted  # type: ignore[method-assign]
    world = World(hear)
    observer = Observer(world.add("server", server(1)), attacks=attacked)
    client = Client(
        flown,
        simulated(flown, 1),
        server=world.add("observer", observer),
        vehicle=1,
        boot_id=1,
        link=link,
        recorder=steps,
    )
    world.add("client", client)
    restart_ns = round(restart_s * SECOND_NS)
    world.at(restart_ns, lambda: world.restart("server", server(2)))  # it is killed
    world.run(lambda: client.finished, limit_ns=round((flown.duration + 20.0) * SECOND_NS))
    assert client.finished
    summary = summarise(flown, "test", steps.rows())
    assert summary.rmse_xy is not None
    outcome.rmse_m, outcome.keys, outcome.copied = summary.rmse_xy, len(used), observer.copied
    return outcome


def test_an_observer_who_can_send_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restarts and new keys every 15 s work as without the observer; two flights, compared."""
    monkeypatch.setattr(skytether.shared.wire.channel, "FRESH_NS", 15 * SECOND_NS)
    table = reading.to_table(reading.load("demo")) | {"duration": 60.0}
    table["vehicle"]["report"] = "always"  # many packets to copy
    flown = reading.check(table, "test")
    alone, attacked = (fly(flown, attacked=each, restart_s=25.0) for each in (False, True))
    assert attacked.changes == alone.changes
    assert [after for after, _ in attacked.changes].count("track") == 2
    assert attacked.keys == alone.keys >= 4
    assert attacked.copied > 1000
    assert attacked.rmse_m == alone.rmse_m
