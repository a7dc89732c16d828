"""Cases: flights that can be flown again, and units that can be removed from them.

The impairment `delivered` removes losses, and keys remove the wind. So a case is an ordinary
scenario, which any user can fly.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import msgspec

from skytether.netem.fate import Fates
from skytether.netem.impairments.draws import SLOT_S
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.directions import FLIGHT
from skytether.shared.law.model import Array
from skytether.shared.scenario import dotted, reading
from skytether.shared.scenario.whole import Scenario

Lane: TypeAlias = tuple[int, int, int]
"""Numbers of a path, a direction (UPLINK or DOWNLINK) and a flow of packets, each from 0."""
Keys: TypeAlias = tuple[tuple[str, Any], ...]
"""Keys of a scenario and their values."""


ENDS = ("control", "link", "vehicle", "sensor")
"""Sections whose keys may be the cause, where their values differ from the named scenario."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Slots of a lane from `first` to `end`: milliseconds since the flow's first packet."""

    lane: Lane
    first: int
    end: int
    """Slot after the last slot."""


@dataclass(frozen=True, slots=True)
class Bad(Stretch):
    """Stretch in which the network loses all packets, or delays all packets too long."""

    is_late: bool = False
    is_packet: bool = False
    """Whether the stretch affects a single packet only."""


@dataclass(frozen=True, slots=True)
class UsualDelay:
    """Ordinary delay of one direction, as a unit. Without this unit, every packet in the explained
    period arrives at once, except in the stretches of other units.
    """

    direction: int


@dataclass(frozen=True, slots=True)
class Unmet:
    """Losses and delays of the network in slots in which this flight sent no packet."""


@dataclass(frozen=True, slots=True)
class Setting:
    """Property of the scenario, such as wind, that can be removed by changing keys."""

    name: str
    keys: Keys


@dataclass(frozen=True, slots=True)
class Stall:
    """Stall of a process: for this time it receives no packets and is not woken."""

    process: Literal["server", "client"]
    at_s: float
    """Time of flight at the stall's beginning [s]."""
    for_s: float
    """Length of the stall [s]; infinite if the process is killed."""


@dataclass(frozen=True, slots=True)
class Command:
    """Change of a key that a person made in flight."""

    at_s: float
    """Time of flight of the change [s]."""
    key: str
    value: Any


Unit: TypeAlias = Bad | Unmet | UsualDelay | Setting | Stall | Command
"""Unit that can be removed from a flight."""


@dataclass(frozen=True, slots=True, eq=False)
class Double:
    """Data of a recorded flight that its double needs; times are times of flight."""

    opens_s: float
    """Time at which the vehicle asks for a session [s]."""
    began_ns: int
    """Time of step 0 [ns]."""
    sends_first: bool
    """Whether the client sent anything at step 0."""
    client_late_ns: Mapping[int, int]
    server_late_ns: Mapping[int, int]
    """Delay with which an end was woken, by the time for which its timer was set [both ns]."""
    states: Array
    """Position [m] and velocity [m/s] at the start of each step; shape (steps, axes, 2)."""
    inputs: Array
    """Input flown in each step [m/s]; shape (steps, axes)."""


@dataclass(frozen=True, slots=True)
class FlightCase:
    """Flight to be flown: a scenario, and changes to it."""

    scenario: Scenario
    vehicles: int = 1
    secure: bool = False
    stalls: tuple[Stall, ...] = ()
    commands: tuple[Command, ...] = ()
    overridden: Keys = ()
    """Keys that differ from the named scenario, with their values in that scenario."""
    keys: Keys = ()
    delivered: tuple[tuple[Stretch, float], ...] = ()
    """Stretches in which every packet arrives, each with the longest delay in it [s]."""
    until_s: float | None = None
    """Time of flight at which the flight may end [s]; None: at its regular end."""
    double: Double | None = None
    """Recorded flight of which the case is the double; None for a flight in virtual time."""
    standby: bool = False
    """Whether there is a standby server, behind a network of its own."""

    def fates(self, lane: Lane) -> Fates:
        """Losses and delays of the packets of a lane."""
        path, direction, flow = lane
        own, name = self.scenario.on_path(path), FLIGHT[direction]
        return Fates(getattr(own, name), own.seed, name, flow)

    def flown(self) -> Scenario:
        """Scenario with the case's changes; raises ConfigError if it cannot be flown."""
        scenario = self.scenario
        if self.keys:
            table = reading.to_table(scenario)
            dotted.set_keys(dict(self.keys), table)
            scenario = reading.check(table, checked=scenario)
        texts = defaultdict[tuple[int, int], list[str]](list)
        for each, most_s in self.delivered:
            (path, direction, flow), slots = each.lane, each.end - each.first
            times = f"{each.first * SLOT_S:.3f}, {slots * SLOT_S:.3f}, {most_s:.6f}"
            texts[path, direction].append(f"{flow}, {times}")
        for (path, direction), stretches in texts.items():
            added = f"delivered({', '.join(stretches)})"
            scenario = _impaired(scenario, path, FLIGHT[direction], added)
        return scenario


def overridden(scenario: Scenario, name: str) -> Keys:
    """Keys of ENDS that differ from the named scenario, with their values in that scenario."""
    try:
        named = dict(dotted.flat(reading.to_table(reading.load(name))))
    except ConfigError:  # a recording's scenario, whose file is elsewhere
        return ()
    table = dotted.flat(reading.to_table(scenario))
    return tuple(
        (key, named[key])
        for key, own in table
        if key.partition(".")[0] in ENDS and own != named.get(key, own)
    )


def _impaired(scenario: Scenario, path: int, name: str, added: str) -> Scenario:
    """Scenario with one more impairment in a direction of a path."""
    network = scenario.network
    if network.paths:
        paths = list(network.paths)
        text = f"{getattr(paths[path], name)} & {added}"
        paths[path] = msgspec.structs.replace(paths[path], **{name: text})
        network = msgspec.structs.replace(network, paths=tuple(paths))
    else:
        text = getattr(network, name).strip() or "none"
        network = msgspec.structs.replace(network, **{name: f"{text} & {added}"})
    return msgspec.structs.replace(scenario, network=network)
