"""`shared.endpoints.steady`: an endpoint continues when the clock of its host jumps."""

from collections.abc import Callable, Sequence
from functools import cache
from math import inf, sqrt
from statistics import mean, variance
from typing import Any

import pytest
from msgspec.structs import replace

from skytether.client.endpoint import Client
from skytether.client.simulated.vehicle import simulated
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shared.base.chance import stream
from skytether.shared.base.units import JUMP_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.endpoints.steady import Steady
from skytether.shared.events.flight import Degraded
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import MemoryRecorder, client_columns
from skytether.shared.telemetry.summary import summarise
from skytether.sim.hosts import Clock
from skytether.sim.world import World

HOUR_NS = 3600 * SECOND_NS
MIDNIGHT_NS = 24 * HOUR_NS
MIDNIGHT = Clock(MIDNIGHT_NS)


class Probe(Endpoint):
    """Endpoint that logs its calls, and wakes at times set by the test."""

    def __init__(self, due_ns: int | None = None) -> None:
        super().__init__()
        self.due_ns = due_ns
        self.times_ns: list[int] = []

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self.times_ns.append(now_ns)
        self._out.append(datagram)

    def wake(self, *, now_ns: int) -> None:
        self.times_ns.append(now_ns)

    def close(self, *, now_ns: int) -> None:
        self.times_ns.append(now_ns)

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:  # noqa: ARG002
        self.times_ns.append(now_ns)

    def next_wake_ns(self) -> int | None:
        return self.due_ns


def hear(endpoint: Endpoint, times_ns: Sequence[int]) -> None:
    for now_ns in times_ns:
        endpoint.receive(Datagram(b"?", ("peer", 1)), now_ns=now_ns)


def test_nothing_of_an_endpoint_is_answered_in_its_place() -> None:
    asked = {name for name in vars(Endpoint) if name[0] != "_"}
    own = {
        "changeable",
        "keeps",
        "patience_ns",
        "send",
        "directions",
    }  # set with the endpoint, or called on itself
    assert asked - own <= set(vars(Steady))


def test_a_change_is_made_at_steady_time() -> None:
    probe = Probe()
    steady = Steady(probe)
    hear(steady, [HOUR_NS])
    steady.change(reading.load("demo"), frozenset(), now_ns=HOUR_NS - 5)
    assert probe.times_ns == [HOUR_NS, HOUR_NS]


@pytest.mark.parametrize("jump_ns", [-1, -HOUR_NS, JUMP_NS + 1, HOUR_NS])
def test_time_stands_still_for_a_jump_and_goes_on(jump_ns: int) -> None:
    for look in ("receive", "wake", "close"):
        probe = Probe(due_ns=MIDNIGHT_NS)
        steady = Steady(probe)
        hear(steady, [MIDNIGHT_NS, MIDNIGHT_NS + 10])
        now_ns = MIDNIGHT_NS + 10 + jump_ns
        if look == "receive":
            hear(steady, [now_ns])
        else:
            getattr(steady, look)(now_ns=now_ns)
        hear(steady, [now_ns + 7])
        assert probe.times_ns[2:] == [MIDNIGHT_NS + 10, MIDNIGHT_NS + 17]
        assert steady.next_wake_ns() == MIDNIGHT_NS + jump_ns


MINUTE_NS = 60 * SECOND_NS
SHOWN: dict[str, tuple[int | None, list[int], list[int], int | None]] = {
    "goes on": (0, [7, 7, 12, 12 + JUMP_NS], [7, 7, 12, 12 + JUMP_NS], 0),
    "a minute is slept through": (0, [0, MINUTE_NS], [0, MINUTE_NS], 0),
    "more than a minute is a jump": (0, [0, MINUTE_NS + 1], [0, 0], MINUTE_NS + 1),
    "an hour ahead and back": (0, [0, HOUR_NS, HOUR_NS + 1, 1, 2], [0, 0, 1, 1, 2], 0),
    "waits for datagrams": (None, [0, HOUR_NS, HOUR_NS - 1], [0, HOUR_NS, HOUR_NS], None),
    "a wake late": (HOUR_NS, [0, HOUR_NS + JUMP_NS], [0, HOUR_NS + JUMP_NS], HOUR_NS),
}
"""Requested wake, readings of the clock, times passed to the endpoint, and the resulting wake."""


@pytest.mark.parametrize(("due_ns", "times_ns", "shown_ns", "wake_ns"), SHOWN.values(), ids=SHOWN)
def test_an_endpoint_is_shown_a_steady_time(
    due_ns: int | None, times_ns: list[int], shown_ns: list[int], wake_ns: int | None
) -> None:
    probe = Probe(due_ns)
    steady = Steady(probe)
    hear(steady, times_ns)
    assert probe.times_ns == shown_ns
    assert steady.next_wake_ns() == wake_ns


def test_all_else_is_the_endpoints_own() -> None:
    server = Server(reading.load("demo"), boot_id=1, entropy=stream(1, "entropy").bytes)
    steady = Steady(server)
    hear(steady, [1])
    assert steady.figures() == server.figures()
    assert steady.figures()["dropped"] == {"not a message": 1}
    steady.tell(Degraded(degraded=True))
    assert steady.events() == (Degraded(degraded=True),)
    assert steady.changeable == server.changeable
    assert steady.patience_ns == server.patience_ns > 0
    probe = Probe()
    steady = Steady(probe)
    hear(steady, [1])
    assert steady.outbox() == [Datagram(b"?", ("peer", 1))]
    assert (steady.outbox(), steady.events(), steady.finished) == ([], (), False)


def rmse(
    *seeds: int,
    wrap: Callable[[Endpoint], Endpoint] = Steady,
    server_clock: Clock = MIDNIGHT,
    client_clock: Clock = MIDNIGHT,
    steps: Sequence[tuple[float, str, int]] = (),
) -> list[float]:
    """Horizontal errors of flights in virtual time [m]; infinite for a flight that does not end in
    time.

    Args:
        seeds: of vehicles with the same server, each with its own network.
        wrap: wrapper for each end.
        server_clock, client_clock: clocks at the start.
        steps: time in the flight [s], host, and step of its clock [ns].
    """
    columns, world = client_columns(DEMO.model.axes), World()
    recorders = {seed: MemoryRecorder(columns) for seed in seeds}
    server = Server(DEMO, boot_id=2**63, entropy=stream(seeds[0], "entropy").bytes)
    clients = {}
    for seed, recorder in recorders.items():
        scenario = replace(DEMO, seed=seed)
        clients[seed] = Client(
            scenario,
            simulated(scenario, 1),
            server=(f"netem {seed}", 0),
            vehicle=seed,
            boot_id=2**63,
            recorder=recorder,
        )
        world.add(f"netem {seed}", Proxy(scenario, server=("server", 0)))
        world.add(f"client {seed}", wrap(clients[seed]), clock=client_clock)
    world.add("server", wrap(server), clock=server_clock)
    hosts = {"server": ["server"], "client": [f"client {seed}" for seed in seeds]}
    for time_s, name, step_ns in steps:
        for host in hosts[name]:
            world.at(
                seconds_to_ns(time_s),
                lambda host=host, step_ns=step_ns: world.set_clock(host, step_ns=step_ns),
            )
    world.run(
        lambda: all(client.finished for client in clients.values()),
        limit_ns=2 * seconds_to_ns(DEMO.duration),
    )
    return [
        summarise(DEMO, "test", recorders[seed].rows()).rmse_xy or inf if client.finished else inf
        for seed, client in clients.items()
    ]


DEMO = reading.load("demo")
SEEDS = range(1, 7)


@cache
def usual_rmse() -> list[float]:
    return rmse(*SEEDS)


STEPS = {
    "client + 1 h": [(15.0, "client", HOUR_NS)],
    "server - 1 h": [(15.0, "server", -HOUR_NS)],
}

CLOCKS: dict[str, dict[str, Any]] = {
    "an hour apart": {"client_clock": Clock(MIDNIGHT_NS + HOUR_NS)},
    "faster by 200 ppm": {"client_clock": Clock(MIDNIGHT_NS, 200_000)},
    **{name: {"steps": steps} for name, steps in STEPS.items()},
    "all of it": {
        "client_clock": Clock(MIDNIGHT_NS + HOUR_NS, 200_000),
        "steps": [
            (10.0, "client", HOUR_NS),
            (15.0, "server", -HOUR_NS),
            (20.0, "client", -HOUR_NS),
            (25.0, "server", HOUR_NS),
        ],
    },
}


@pytest.mark.long
@pytest.mark.parametrize("name", CLOCKS)
def test_the_error_is_the_same_whatever_the_clocks_do(name: str) -> None:
    """Within 5 % of the error with equal clocks, as far as six seeds can show.

    Clocks change which packets are lost, which scatters the mean of six by about 5 %; only a
    difference of more than twice its standard error counts.
    """
    errors = rmse(*SEEDS, **CLOCKS[name])
    usual = usual_rmse()
    chance = sqrt((variance(errors) + variance(usual)) / len(usual))
    assert abs(mean(errors) - mean(usual)) <= 0.05 * mean(usual) + 2.0 * chance
    assert max(errors) < 1.5 * max(usual)


def test_without_steady_time_a_step_loses_the_flight() -> None:
    """The error doubles at least, or the vehicle stands still until its clock has returned."""
    steps = STEPS["server - 1 h"]
    (usual,), (steady,) = rmse(2), rmse(2, steps=steps)
    (error,) = rmse(2, wrap=lambda endpoint: endpoint, steps=steps)
    assert steady < 1.5 * usual
    assert error > 2.0 * usual
