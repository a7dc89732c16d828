"""A vehicle that the server refuses: each reason, told at both ends."""

from typing import Any

from helpers import packaged
from skytether.client.endpoint import Client
from skytether.client.simulated.vehicle import simulated
from skytether.server.endpoint import Server
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import Event
from skytether.sim.world import World


class Ground:
    """A server with room for one vehicle, and what it told."""

    def __init__(self) -> None:
        flown = packaged("demo")
        self.told: list[str] = []
        self.world = World(self._hear)
        entropy = stream(1, "entropy").bytes
        server = Server(flown, boot_id=1, entropy=entropy, capacity=1)
        self.address = self.world.add("server", server)

    def _hear(self, _: int, host: str, event: Event) -> None:
        if host == "server" and "refused" in str(event):
            self.told.append(str(event))

    def flies(self, vehicle: int, *, boot_id: int, **changes: Any) -> Client:
        flown = packaged("demo", {"settle": 0.0}, changes)
        plant = simulated(flown, vehicle)
        client = Client(flown, plant, server=self.address, vehicle=vehicle, boot_id=boot_id)
        self.world.add(f"client {boot_id}", client)
        return client

    def run(self, until_s: float) -> None:
        now_ns = round(until_s * SECOND_NS)
        ended: list[bool] = []
        self.world.at(now_ns, lambda: ended.append(True))
        self.world.run(lambda: bool(ended), limit_ns=now_ns + SECOND_NS)


def test_a_client_of_another_scenario_names_each_key_and_both_values() -> None:
    ground = Ground()
    client = ground.flies(1, boot_id=1, control={"dt": 0.02, "horizon": 50})
    ground.run(3.0)
    assert str(client.failure) == (
        "vehicle 1 is refused, it flies another scenario: control.dt is 0.02 here and 0.05 "
        "at the other end; control.horizon is 50 here and 80 at the other end"
    )
    assert "control.dt is 0.05 here and 0.02 at the other end" in ground.told[0]


def test_a_client_too_many_and_one_under_a_number_in_flight_are_told_why() -> None:
    ground = Ground()
    flying = ground.flies(1, boot_id=1)
    ground.run(3.0)
    soon = {"link": {"connect_s": 1.5}}
    same, other = ground.flies(1, boot_id=2, **soon), ground.flies(2, boot_id=3, **soon)
    ground.run(7.0)
    host, port = ground.address
    refused = f"is refused by {host}:{port}"
    assert str(same.failure) == (
        f"vehicle 1 {refused}: another client flies under this number; see --id"
    )
    assert str(other.failure) == f"vehicle 2 {refused}: the server is full; see its --vehicles"
    assert flying.failure is None
    assert any("another client flies" in line for line in ground.told)
    assert any("the server is full (room for 1)" in line for line in ground.told)
