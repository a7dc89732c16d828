"""The table of vehicles: what `vehicle.kind` may name, and what makes each of them.

A plug-in's vehicle is an entry like these. What one needs beside numpy is imported when it is made.
"""

from skytether.client.simulated import vehicle as computed
from skytether.client.vehicle import Vehicle
from skytether.shared.base import extras
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.registry import VEHICLES
from skytether.shared.scenario.schema import Scenario

vehicle = VEHICLES
"""Decorator of a vehicle: a function of the `Scenario` and its number that makes a `Vehicle`."""


@vehicle
def simulated(scenario: Scenario, number: int) -> Vehicle:
    """Velocity loop of first order in wind, computed: eq. (1), and what may differ from it."""
    return computed.simulated(scenario, number)


@vehicle
def quadrotor(scenario: Scenario, number: int) -> Vehicle:
    """Quadrotor with rotors and loops of its own, in wind and turbulence, computed."""
    return computed.quadrotor(scenario, number)


@vehicle
def mavlink(scenario: Scenario, number: int) -> Vehicle:
    """ArduCopter or PX4 at `vehicle.address`, flown by velocities over MAVLink."""
    with extras.named():
        from skytether.client.mavlink.vehicle import MavlinkVehicle
    return MavlinkVehicle(scenario, number)


def make(scenario: Scenario, number: int) -> Vehicle:
    """The vehicle of a scenario with a number.

    Raises:
        ConfigError: there is none of that name, or it cannot be made.
    """
    try:
        named = VEHICLES.one(scenario.vehicle.kind)
    except GrammarError as error:
        raise ConfigError(f"vehicle.kind: got {error.given!r}, expected {error.expected}") from None
    made: Vehicle = VEHICLES[named.name].make(scenario, number, *named.values)
    if scenario.vehicle.on_loss == "return" and not made.returns:
        expected = f"'land' with vehicle.kind = {named.name!r}, which cannot return by itself"
        raise ConfigError(f"vehicle.on_loss: got 'return', expected {expected}")
    return made
