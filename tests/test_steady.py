"""`shared.steady`: an endpoint goes on where the clock of its host jumps."""

import io
from collections.abc import Callable, Sequence
from functools import cache
from math import inf
from statistics import mean
from typing import Any

import pytest
from msgspec.structs import replace

import shared.steady
from client.plant import FirstOrderPlant
from client.vehicle import Client
from netem.proxy import Proxy
from server.endpoint import Server
from shared import config
from shared.chance import stream
from shared.config import Scenario
from shared.endpoint import SECOND_NS, Datagram, Endpoint, seconds_to_ns
from shared.record import Recorder, client_columns, parse
from shared.steady import JUMP_NS, SLEPT_NS, Steady
from shared.summary import summarise
from sim.world import Clock, World

HOUR_NS = 3600 * SECOND_NS
MIDNIGHT_NS = 24 * HOUR_NS
MIDNIGHT = Clock(MIDNIGHT_NS)


class Probe(Endpoint):
    """Writes down when something happens to it, and wakes when it was told to."""

    def __init__(self, due_ns: int | None = None) -> None:
        super().__init__()
        self.due_ns = due_ns
        self.times_ns: list[int] = []

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Note it, and answer."""
        self.times_ns.append(now_ns)
        self._out.append(datagram)

    def wake(self, *, now_ns: int) -> None:
        """Note it."""
        self.times_ns.append(now_ns)

    def close(self, *, now_ns: int) -> None:
        """Note it."""
        self.times_ns.append(now_ns)

    def next_wake_ns(self) -> int | None:
        """As it was told."""
        return self.due_ns


def hear(endpoint: Endpoint, times_ns: Sequence[int]) -> None:
    """A datagram arrives at each of these times."""
    for now_ns in times_ns:
        endpoint.receive(Datagram(b"?", ("peer", 1)), now_ns=now_ns)


def test_a_clock_that_goes_on_is_passed_on_as_it_is() -> None:
    """Also where it stalls for as long as a jump is not, and where it begins at any time."""
    probe = Probe(due_ns=0)
    times_ns = [MIDNIGHT_NS, MIDNIGHT_NS, MIDNIGHT_NS + 5, MIDNIGHT_NS + 5 + JUMP_NS]
    hear(Steady(probe), times_ns)
    assert probe.times_ns == times_ns


@pytest.mark.parametrize("jump_ns", [-1, -HOUR_NS, JUMP_NS + 1, HOUR_NS])
def test_a_jump_looks_like_a_short_stall(jump_ns: int) -> None:
    """Whatever looks at the clock next, and the wake that is due moves with it."""
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
        went_on_ns = MIDNIGHT_NS + 10 + SLEPT_NS
        assert probe.times_ns[2:] == [went_on_ns, went_on_ns + 7]
        assert steady.next_wake_ns() == MIDNIGHT_NS + jump_ns - SLEPT_NS


def test_every_jump_counts() -> None:
    """An hour ahead and an hour back is where it was, but for what passes with each."""
    probe = Probe(due_ns=0)
    steady = Steady(probe)
    hear(steady, [0, HOUR_NS, HOUR_NS + 1, 1, 2])
    slept_ns = SLEPT_NS
    assert probe.times_ns == [0, slept_ns, slept_ns + 1, 2 * slept_ns + 1, 2 * slept_ns + 2]
    assert steady.next_wake_ns() == -2 * slept_ns


def test_who_only_waits_for_datagrams_may_wait_for_hours() -> None:
    """A server without vehicles forgets in time who was there."""
    probe = Probe(due_ns=None)
    steady = Steady(probe)
    hear(steady, [0, HOUR_NS, HOUR_NS - 1])
    assert probe.times_ns == [0, HOUR_NS, HOUR_NS + SLEPT_NS]
    assert steady.next_wake_ns() is None


@pytest.mark.parametrize("slept_ns", [SLEPT_NS, 0])
def test_a_vehicle_that_slept_for_minutes_brakes_on_waking(
    slept_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its clock has jumped, for all it can tell; as if it had taken no time it would fly on."""
    monkeypatch.setattr(shared.steady, "SLEPT_NS", slept_ns)
    scenario, world = config.load("demo"), World()
    client = Client(
        scenario,
        FirstOrderPlant(scenario, stream(1, "wind", 1)),
        server=("server", 0),
        vehicle=1,
        boot_id=2**63,
    )
    server = Server(scenario, boot_id=2**63, entropy=stream(1, "entropy").bytes)
    world.add("client", Steady(client), clock=MIDNIGHT)
    world.add("server", Steady(server), clock=MIDNIGHT)
    modes: list[str] = []
    world.at(5 * SECOND_NS, lambda: world.stop("server"))
    for time_s, action in ((5, world.freeze), (305, world.thaw)):
        world.at(time_s * SECOND_NS, lambda action=action: action("client"))
    for time_s in (5, 305):
        world.at(time_s * SECOND_NS + 1, lambda: modes.append(str(client.figures()["mode"])))
    world.run(lambda: len(modes) == 2, limit_ns=310 * SECOND_NS)
    flies, wakes = modes
    assert flies == "track"
    assert (wakes in {"brake", "hover"}) == bool(slept_ns)


def test_a_wake_that_was_asked_for_late_is_no_jump() -> None:
    """Only what goes on past the wake is."""
    probe = Probe(due_ns=HOUR_NS)
    steady = Steady(probe)
    hear(steady, [0])
    steady.wake(now_ns=HOUR_NS + JUMP_NS)
    assert probe.times_ns == [0, HOUR_NS + JUMP_NS]


def test_all_else_is_the_endpoints_own() -> None:
    """What it sends, says and has counted, and whether it has finished."""
    server = Server(config.load("demo"), boot_id=1, entropy=stream(1, "entropy").bytes)
    steady = Steady(server)
    hear(steady, [1])
    assert steady.figures() == server.figures()
    assert steady.figures()["counts"] == {"dropped: not a message": 1}
    probe = Probe()
    steady = Steady(probe)
    hear(steady, [1])
    assert steady.outbox() == [Datagram(b"?", ("peer", 1))]
    assert (steady.outbox(), steady.events(), steady.finished) == ([], (), False)


def rmse(
    scenario: Scenario,
    *,
    wrap: Callable[[Endpoint], Endpoint] = Steady,
    server_clock: Clock = MIDNIGHT,
    client_clock: Clock = MIDNIGHT,
    steps: Sequence[tuple[float, str, int]] = (),
) -> float:
    """Error in the plane of a flight in virtual time [m]; infinite if it does not end in time.

    Args:
        scenario: what to fly.
        wrap: made of each end.
        server_clock, client_clock: clocks at the start.
        steps: time in the flight [s], host, and step of its clock [ns].
    """
    world, sink = World(), io.BytesIO()
    client = Client(
        scenario,
        FirstOrderPlant(scenario, stream(scenario.seed, "wind", 1)),
        server=("netem", 0),
        vehicle=1,
        boot_id=2**63,
        recorder=Recorder(client_columns(scenario.model.axes), sink),
    )
    entropy = stream(scenario.seed, "entropy").bytes
    server = Server(scenario, boot_id=2**63, entropy=entropy)
    world.add("netem", Proxy(scenario, server=("server", 0)))
    world.add("client", wrap(client), clock=client_clock)
    world.add("server", wrap(server), clock=server_clock)
    for time_s, host, step_ns in steps:
        world.at(
            seconds_to_ns(time_s),
            lambda host=host, step_ns=step_ns: world.set_clock(host, step_ns=step_ns),
        )
    world.run(lambda: client.finished, limit_ns=2 * seconds_to_ns(scenario.duration))
    if not client.finished:
        return inf
    found = summarise(scenario, "test", parse(sink.getvalue())).rmse_xy
    assert found is not None
    return found


SCENARIOS = [replace(config.load("demo"), seed=seed) for seed in range(1, 7)]


@cache
def usual_rmse() -> float:
    """Mean error with equal clocks [m]."""
    return mean(map(rmse, SCENARIOS))


STEPS = {
    f"{host} {step_ns // HOUR_NS:+} h": [(15.0, host, step_ns)]
    for host in ("client", "server")
    for step_ns in (HOUR_NS, -HOUR_NS)
}
"""Clocks that are stepped in flight, by name."""

CLOCKS: dict[str, dict[str, Any]] = {
    "an hour apart": {"client_clock": Clock(MIDNIGHT_NS + HOUR_NS)},
    "an hour apart the other way": {"client_clock": Clock(MIDNIGHT_NS - HOUR_NS)},
    "faster by 200 ppm": {"client_clock": Clock(MIDNIGHT_NS, 200_000)},
    "slower by 200 ppm": {"client_clock": Clock(MIDNIGHT_NS, -200_000)},
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


@pytest.mark.parametrize("name", CLOCKS)
def test_the_error_is_the_same_whatever_the_clocks_do(name: str) -> None:
    """It is within 5 % of that with equal clocks, as a mean of six seeds.

    Where the vehicle's own clock is set it brakes, and that alone takes a few centimetres.
    """
    errors = [rmse(scenario, **CLOCKS[name]) for scenario in SCENARIOS]
    brakes = any(host == "client" for _, host, _ in CLOCKS[name].get("steps", ()))
    assert mean(errors) == pytest.approx(usual_rmse(), rel=0.5 if brakes else 0.05)


@pytest.mark.parametrize("name", STEPS)
def test_without_steady_time_a_step_loses_the_flight(name: str) -> None:
    """The error doubles at least, or the vehicle stands still until its clock has come back."""
    error = rmse(SCENARIOS[0], wrap=lambda endpoint: endpoint, steps=STEPS[name])
    assert error > 2.0 * usual_rmse()
