"""A flight with a standby server: servers die, and the vehicle flies on."""

from collections.abc import Callable
from functools import partial
from typing import Any

import msgspec
import numpy as np
import pytest

from helpers import packaged
from skytether.client.standby.leadership import Leadership
from skytether.client.standby.servers import Servers
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shared.endpoints.change import Running
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.events.flight import ModeChanged, SessionEnded
from skytether.shared.events.standby import LeaderChanged
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire.protocol import Mode
from skytether.sim.flight import SERVER, fly
from skytether.sim.standby import STANDBY
from skytether.sim.world import World

SECONDS, DIES_S = 18.0, 7.3


def scenario(name: str = "demo", **changes: Any) -> Scenario:
    layer = {"duration": SECONDS, "settle": 4.0}
    return packaged(name, layer, changes)


def stops(name: str) -> Callable[[World], None]:
    return lambda world: world.stop(name)


def brakes(record: Record) -> int:
    events = (each.event for each in record.events)
    return sum(isinstance(each, ModeChanged) and each.after == "brake" for each in events)


def changes(record: Record) -> list[float]:
    """Times at which another server came to lead [s]."""
    return [each.time_ns / 1e9 for each in record.events if isinstance(each.event, LeaderChanged)]


def rmse_m(flown: Scenario, record: Record) -> float:
    found = summarise(flown, "standby", record.client, record.server, record.netem)
    assert found.rmse_xy is not None
    return found.rmse_xy


@pytest.mark.parametrize(
    ("name", "secure"),
    [("demo", True), ("demo-committed", False), ("demo-paper", False), ("target", False)],
)
def test_the_server_dies_and_the_flight_goes_on(name: str, *, secure: bool) -> None:
    """The new leader sends its first plan twice."""
    flown = scenario(name)
    record = fly(flown, standby=True, secure=secure, actions=[(DIES_S, stops(SERVER[0]))])
    (changed_s,) = changes(record)
    assert DIES_S < changed_s < DIES_S + 2.0 * flown.link.timeout_s
    assert brakes(record) == 0
    assert record.failure is None
    assert rmse_m(flown, record) < max(2.0 * rmse_m(flown, fly(flown)), 0.05)
    (*_, taken) = np.flatnonzero(np.diff(record.server["step"]) > 1)
    assert record.server["event"][taken + 1 : taken + 3].all()


def test_without_a_standby_it_brakes() -> None:
    assert brakes(fly(scenario(), actions=[(DIES_S, stops(SERVER[0]))])) == 1


def test_the_standby_dies_and_nothing_happens_until_the_server_dies_too() -> None:
    dies = [(DIES_S, stops(STANDBY[0])), (DIES_S + 4.0, stops(SERVER[0]))]
    record = fly(scenario(), standby=True, actions=dies)
    (braked,) = [each for each in record.events if getattr(each.event, "after", "") == "brake"]
    assert braked.time_ns / 1e9 > DIES_S + 4.0
    assert changes(record) == []


def test_a_vehicle_that_does_not_wait_for_the_answer_brakes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The delay there and back is almost a time-out: the question alone comes too late."""
    slow = {
        "network": {"uplink": "constant(0.45)", "downlink": "constant(0.45)"},
        "link": {"timeout_s": 1.0},
    }
    flown = scenario(**slow)
    dies = [(DIES_S, stops(SERVER[0]))]
    assert brakes(fly(flown, standby=True, actions=dies)) == 0
    monkeypatch.setattr(Servers, "_is_alone", lambda *_: True)
    assert brakes(fly(flown, standby=True, actions=dies)) == 1


def test_a_server_that_was_frozen_is_the_standby(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it sends on, believing that it leads, is not flown."""
    freezes = [
        (DIES_S, lambda world: world.freeze(SERVER[0])),
        (DIES_S + 4.0, lambda world: world.thaw(SERVER[0])),
    ]
    flown = scenario()
    record = fly(flown, standby=True, actions=freezes)
    assert (brakes(record), len(changes(record))) == (0, 1)
    assert rmse_m(flown, record) < 0.05
    monkeypatch.setattr(Leadership, "successor", lambda *_: None)
    assert brakes(fly(flown, standby=True, actions=freezes)) == 1


def test_a_flight_with_a_standby_that_leads_never_costs_little() -> None:
    flown = scenario()
    alone, with_standby = fly(flown), fly(flown, standby=True)
    assert len(with_standby.netem) < 1.25 * len(alone.netem)
    assert changes(with_standby) == []


def battered(seed: int) -> tuple[Scenario, Record, int]:
    """A flight in which both servers and both networks fail at random until 40 s, and the number of
    faults.
    """
    rng = np.random.default_rng(seed)
    flown = msgspec.structs.replace(scenario(), duration=60.0, seed=seed)
    actions: list[tuple[float, Callable[[World], None]]] = []
    for name in (SERVER[0], STANDBY[0]):
        at_s = 5.0
        while (at_s := at_s + float(rng.exponential(6.0))) < 35.0:
            for_s = min(float(rng.exponential(4.0)), 40.0 - at_s)
            acts = (world_stop, renewed(flown, rng)) if rng.random() < 0.5 else (freeze, thaw)
            actions += zip((at_s, at_s + for_s), (partial(act, name) for act in acts), strict=True)
            at_s += for_s
    actions.sort(key=lambda each: each[0])
    return flown, fly(flown, standby=True, actions=actions), len(actions) // 2


def world_stop(name: str, world: World) -> None:
    world.stop(name)


def freeze(name: str, world: World) -> None:
    world.freeze(name)


def thaw(name: str, world: World) -> None:
    world.thaw(name)


def renewed(flown: Scenario, rng: np.random.Generator) -> Callable[[str, World], None]:
    def act(name: str, world: World) -> None:
        boot_id = int(rng.integers(2**62))
        world.restart(name, Server(flown, boot_id=boot_id, entropy=rng.bytes))

    return act


@pytest.mark.parametrize(
    "seed", [pytest.param(seed, marks=[pytest.mark.long] * (seed > 2)) for seed in range(1, 9)]
)
def test_whatever_fails_it_flies_again_at_the_end(seed: int) -> None:
    flown, record, faults = battered(seed)
    assert record.failure is None
    assert len(changes(record)) <= 2 * faults
    late = record.client["step"] * flown.control.dt > 52.0
    assert set(record.client["mode"][late]) <= {Mode.TRACK, Mode.COAST}
    wanted = flown.make_reference()(record.client["step"][late] * flown.control.dt)
    assert np.abs(record.client["state"][late] - wanted)[..., 0].max() < 0.3


def test_a_leader_that_hears_nothing_is_replaced() -> None:
    """Its heartbeats arrive, and say that it cannot plan."""
    deaf = {"network.downlink": "loss(1)"}
    flown = scenario("target")
    record = fly(flown, standby=True, actions=[(DIES_S, lambda world: _deafen(world, deaf))])
    (changed_s,) = changes(record)
    assert changed_s < DIES_S + flown.link.age_max_s + 2.0 * flown.link.timeout_s
    assert brakes(record) <= 1


def _deafen(world: World, values: dict[str, str]) -> None:
    netem = world._hosts["netem 1"].endpoint
    assert isinstance(netem, Proxy)
    world.act("netem 1", partial(Running(netem, netem._scenario).change, values))


def test_a_standby_is_kept_while_the_time_out_is_long() -> None:
    """The server forgets a session after 30 s of silence."""
    flown = msgspec.structs.replace(
        scenario("demo", link={"timeout_s": 20.0, "age_max_s": 60.0}), duration=40.0
    )
    record = fly(flown, standby=True)
    events = [each for each in record.events if each.process == "standby"]
    assert [type(each.event) for each in events].count(SessionEnded) == 0
    assert changes(record) == []


class Astray(Endpoint):
    """In place of the standby server: leads its packets to the first, and the answers back."""

    def __init__(self) -> None:
        super().__init__()
        self._came_from: Address = ("", 0)

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        if datagram.peer == SERVER:
            self._out.append(Datagram(datagram.payload, self._came_from))
        else:
            self._came_from = datagram.peer
            self._out.append(Datagram(datagram.payload, SERVER))

    def wake(self, *, now_ns: int) -> None:
        """Nothing is ever due."""

    def next_wake_ns(self) -> None:
        """None: it is never woken."""


@pytest.mark.parametrize("secure", [False, True])
def test_packets_for_the_standby_that_are_led_to_the_server_change_nothing(*, secure: bool) -> None:
    """A wrong address, or somebody who holds the standby's network."""
    flown = scenario()
    record = fly(flown, standby=Astray(), secure=secure)
    assert record.failure is None
    assert brakes(record) == 0
    assert rmse_m(flown, record) < 0.05
