"""Restarts of a client while its autopilot flies, in virtual time."""

from math import dist

import pytest

from airborne import ARM, Air
from skytether.autopilot.flavours import FlavourName, FlightMode
from skytether.shared.base.errors import ConfigError
from skytether.shared.events.aboard import ArmingAwaited, NotTakenOff, OriginAwaited
from skytether.shared.wire.protocol import Mode

NORTH_M, EAST_M = 20.0, -12.0


def away(flavour: FlavourName, seconds: float = 2.0, **table: object) -> Air:
    """Flight whose vehicle takes off far from the origin of its autopilot's local frame."""
    air = Air(flavour, duration=40.0, reference={"radius_m": 2.0}, **table)
    air.flight.quadrotor._quad.x[:2] = NORTH_M, EAST_M
    air.fly()
    air.run(seconds)
    return air


def off_m(air: Air) -> float:
    x, y, _ = air.flight.position()
    return dist((x, y), (NORTH_M, EAST_M))


def farthest_m(air: Air, seconds: float) -> float:
    most = 0.0
    for _ in range(round(seconds / 0.5)):
        air.run(0.5)
        most = max(most, off_m(air))
    return most


def test_a_client_restarted_in_the_air_flies_on_in_the_frame_it_had() -> None:
    """Figure and fence stay where they were: the saved origin outlives the process."""
    air = away("px4")
    air.restart(0.3)
    assert farthest_m(air, 6.0) < 3.5
    assert air.client._pilot.step > 140, "steps go on counting"
    assert air.mode is Mode.TRACK
    assert not air.of(OriginAwaited)
    assert len(air.commands(ARM)) == 1


def test_without_its_origin_a_vehicle_in_the_air_hovers_until_somebody_says_where_it_is() -> None:
    """It holds its place under a stream of zeros, and flies the figure once the origin is set."""
    air = away("ardupilot", 4.0)
    air.restart(1.0, remembers=False)
    air.run(3.0)
    x, y, _ = air.flight.position()
    air.run(5.0)
    assert dist(air.flight.position()[:2], (x, y)) < 0.3
    assert not air.client._pilot.step
    (awaited,) = air.of(OriginAwaited)
    assert dist(awaited.place[:2], (x, y)) < 1.0
    air.change(mavlink__origin=[NORTH_M, EAST_M])
    air.fly(5.0)
    assert farthest_m(air, 6.0) < 3.5
    with pytest.raises(ConfigError, match=r"the origin is known"):
        air.change(mavlink__origin=[0.0, 0.0])


def test_where_nobody_says_where_the_origin_is_it_lands_where_it_is() -> None:
    air = away("ardupilot", 4.0, mavlink={"patience_s": 9.0})
    air.restart(1.0, remembers=False)
    air.end(60.0)
    assert isinstance(air.client.failure, NotTakenOff)
    assert not air.flight.armed
    assert off_m(air) < 3.5


def test_an_origin_of_before_the_autopilots_reboot_is_not_taken() -> None:
    """After a reboot the autopilot's local frame and clock start anew."""
    air = away("ardupilot")
    air.world.stop("client")
    air.autopilot._began_ns += 8_000_000_000
    air.restart(1.0)
    air.until(lambda: air.of(OriginAwaited), 14.0)
    assert not air.client._pilot.next_ns


@pytest.mark.long
def test_a_client_restarted_after_a_failsafe_landing_arms_nothing() -> None:
    """A new process does not replace a person: it waits for one, and then takes off."""
    air = away("px4")
    air.world.stop("client")
    air.lands(40.0)
    arms = len(air.commands(ARM))
    air.restart(30.0)
    air.run(20.0)
    assert len(air.commands(ARM)) == arms
    assert not air.flight.armed
    (awaited,) = air.of(ArmingAwaited)
    assert awaited.why == "an earlier run of its client has armed it"
    air.change(armed=True)
    air.fly(30.0)
    assert len(air.commands(ARM)) > arms


def test_a_client_that_finds_its_vehicle_landing_arms_nothing_even_without_a_memory() -> None:
    air = away("ardupilot")
    air.world.stop("client")
    air.run(40.0, lambda: air.flight.mode is FlightMode.LAND)
    air.restart(0.5, remembers=False)
    air.lands(60.0)
    air.run(10.0)
    assert len(air.commands(ARM)) == 1
    assert air.of(ArmingAwaited)


def test_a_word_counts_on_the_ground_alone() -> None:
    """Given in the air, the permission does not let the next process take off after a landing."""
    air = away("ardupilot")
    air.restart(0.3)
    air.run(3.0)
    air.change(armed=True)
    air.world.stop("client")
    air.run(40.0, lambda: not air.flight.armed)
    air.restart(1.0)
    air.run(10.0)
    assert not air.flight.armed
    assert air.of(ArmingAwaited)[-1].why == "an earlier run of its client has armed it"
