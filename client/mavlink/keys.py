"""Keys of an autopilot."""

from collections.abc import Iterator
from typing import Annotated, Literal

from msgspec import Meta

from skytether.shared.scenario.owners import Key, OfVehicle, Owner
from skytether.shared.scenario.schema import Contradiction, Position, Scenario, Section

ORIGIN = "origin"
"""Group of `mavlink.origin`, which may be set in flight only while the origin is unknown."""


class MavlinkConfig(Section, frozen=True):
    """Autopilot of a vehicle of the kind `mavlink`."""

    system: OfVehicle[Annotated[int, Meta(ge=1, le=255)]] = 245
    """MAVLink system number of the client; ArduPilot's ground-station failsafe must watch for this
    number."""
    component: OfVehicle[Annotated[int, Meta(ge=1, le=255)]] = 191
    """MAVLink component number of the client; 191: onboard computer."""
    autopilot: OfVehicle[Annotated[int, Meta(ge=0, le=255)]] = 0
    """MAVLink system number of the autopilot; 0: the system that sends the first heartbeat."""
    positions_hz: OfVehicle[Annotated[int, Meta(ge=5, le=200)]] = 50
    """Rate of positions requested from the autopilot [Hz]."""
    silence_s: OfVehicle[Annotated[float, Meta(ge=0.2, le=5)]] = 0.5
    """Time without a position after which the vehicle brakes [s]."""
    battery_min: OfVehicle[Annotated[float, Meta(ge=0, le=1)]] = 0.2
    """Charge of the battery below which the vehicle lands."""
    battery_min_v: OfVehicle[Annotated[float, Meta(ge=0, le=100)]] = 0.0
    """Voltage of the battery below which the vehicle lands [V]; 0: no limit."""
    takeoff_m: OfVehicle[Annotated[float, Meta(ge=0.5, le=100)] | Literal["auto"]] = "auto"
    """Take-off altitude [m]; auto: altitude of the reference's start, or 3 m with two axes."""
    origin: Annotated[
        Literal["takeoff", "autopilot"] | tuple[Position, ...],
        Key(Owner.VEHICLE, ORIGIN),
    ] = "takeoff"
    """Origin of the scenario's frame. takeoff: the point of arming; on a mission, the point with
    which the vehicle is armed below its first goal. autopilot: the autopilot's local origin.
    Numbers: a point in that frame, north, east (and up) [m]. If the client restarts in the air
    without a saved origin, the vehicle hovers until this key is set, and lands after
    `mavlink.patience_s`."""
    second_commander: OfVehicle[Literal["brake", "yield"]] = "brake"
    """Reaction to a second commander, or to a vehicle that ignores its commands: brake and then
    land, or yield as if a pilot had taken over."""
    patience_s: OfVehicle[Annotated[float, Meta(ge=1, le=600)]] = 60.0
    """Longest wait for the first heartbeat, and for each step of take-off [s]."""

    def contradictions(self, scenario: Scenario) -> Iterator[Contradiction]:  # noqa: ARG002
        if isinstance(self.origin, tuple) and len(self.origin) not in (2, 3):
            yield "mavlink.origin", list(self.origin), "north and east, or north, east and up"


SECTION = MavlinkConfig
