"""Table of vehicles: the names that `vehicle.kind` accepts, and functions that make the vehicles.

`shared.scenario.rooms` names the modules of the built-in vehicles; a module is imported when a
scenario needs it. A plug-in adds a vehicle in the same way.
"""

from typing import TYPE_CHECKING

from skytether.client.vehicle import Vehicle
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.registry import VEHICLES
from skytether.shared.scenario.schema import Scenario

if TYPE_CHECKING:
    from skytether.ros2.graph import Node
    from skytether.shared.endpoints.line import Line

START_NS = 5 * SECOND_NS
"""Longest time from the start of the first vehicle of a fleet to the last [ns]."""
vehicle = VEHICLES
"""Decorator that registers a vehicle: a function of the `Scenario` and its number that makes a
`Vehicle`."""


def make(scenario: Scenario, number: int) -> Vehicle:
    try:
        named = VEHICLES.one(scenario.vehicle.kind)
    except GrammarError as error:
        raise ConfigError(f"vehicle.kind: got {error.given!r}, expected {error.expected}") from None
    instance: Vehicle = VEHICLES[named.name].make(scenario, number, *named.values)
    if scenario.vehicle.on_loss == "return" and not instance.returns:
        expected = f"'land' with vehicle.kind = {named.name!r}, which cannot return by itself"
        raise ConfigError(f"vehicle.on_loss: got 'return', expected {expected}")
    return instance


def connection(flies: Vehicle, scenario: Scenario) -> "Line | Node | None":
    """Line or node of the vehicle's port, which is socket 1 of its process; None without a port."""
    if flies.port is None:
        return None
    from skytether.shared.endpoints.line import parse_line

    return flies.node or parse_line("vehicle.address", scenario.vehicle.address)


def apart_ns(vehicles: int, dt_ns: int) -> int:
    """Time from one vehicle's start to the next's [ns]: one step, less in a large fleet.

    If all vehicles started at once, their packets would be sent at the same times and would queue.
    """
    return min(dt_ns, START_NS // vehicles)
