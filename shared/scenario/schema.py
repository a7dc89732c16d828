"""Keys of a scenario: everything about a flight, typed and frozen.

A key is written in one place, here: its name, its owner (`owners.py`) and type with bounds, its
default, and a sentence with its unit in brackets. The sentence is the flag's in `--help`, and the
key's in docs/keys.md, which `make keys` writes. A `Term` belongs to both ends: it has a field in
`shared/law/terms.py: Terms`, and is put there by `Scenario.terms`.

`reading.py` reads a scenario from its TOML file, and `contradictions.py` finds values that are
right one by one and impossible together.
"""

import hashlib
from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from skytether.shared.base.chance import stream
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.law.heartbeat import PATIENCE, SESSION_NS
from skytether.shared.law.model import Array
from skytether.shared.law.motion import Clearances, bend_m
from skytether.shared.law.terms import Terms
from skytether.shared.scenario import reference as shapes
from skytether.shared.scenario import schemes, zones
from skytether.shared.scenario.air import path as air
from skytether.shared.scenario.grammar import TEXT_MAX, leaves
from skytether.shared.scenario.mission import Mission
from skytether.shared.scenario.owners import (
    InFlight,
    Key,
    OfEach,
    OfImpairment,
    OfNetem,
    OfServer,
    OfTrigger,
    OfVehicle,
    OfVirtualTime,
    OfWind,
    Owner,
    Term,
)
from skytether.shared.scenario.registry import (
    REFERENCES,
    SCHEMES,
    TRIGGERS,
    VEHICLES,
    Entry,
    Files,
    content,
)
from skytether.shared.scenario.schemes import SchemeProperties
from skytether.shared.scenario.zones import Zones
from skytether.shared.wire.protocol import INPUTS_MAX, PAYLOAD_BYTES_MAX

# Bounds of numbers lie far beyond any vehicle, and near enough that no time overflows its 63 bits
# of nanoseconds, and no product of some of them a float.
Factor = Annotated[float, Meta(ge=1e-3, le=1e3)]
"""Property of a vehicle, from a thousandth of its unit to a thousand."""
Factors = Factor | tuple[Factor, ...]
"""Property of a vehicle on each axis: one for all axes, or one each."""
DeadTime = Annotated[float, Meta(ge=0, le=2)]
"""Dead time that both ends reckon with [s]."""
TrueDeadTime = Annotated[float, Meta(ge=0, le=10)]
"""Dead time that a vehicle has [s]."""
Strength = Annotated[float, Meta(ge=0, le=1e3)]
"""Property that may be missing: from nothing to a thousand of its unit."""
Speed = Annotated[float, Meta(ge=-1e3, le=1e3)]
"""Speed either way along an axis [m/s]."""
Position = Annotated[float, Meta(ge=-shapes.FAR_M, le=shapes.FAR_M)]
"""Coordinate [m]."""
Amount = Annotated[float, Meta(ge=0, le=1e9)]
"""Weight, cost or tolerance of any unit."""
Duration = Annotated[float, Meta(ge=0, le=3600)]
"""Time from nothing to an hour [s]."""
Interval = Annotated[float, Meta(ge=1e-3, le=3600)]
"""Time from a millisecond to an hour [s]."""
MeanTime = Annotated[float, Meta(ge=1e-9, le=1e9)]
"""Mean of a random time [s]."""
Text = Annotated[str, Meta(max_length=TEXT_MAX)]
"""Text that names what is in a table of `registry.py`."""
Direction = Annotated[str, Meta(max_length=air.TEXT_MAX)]
"""Text of a direction's impairments."""


SHAPE_TOLD = 15
"""Number of characters of a plug-in's shape that the other end is told, beside a digest."""


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of every table of a scenario."""


class ModelConfig(Section, frozen=True):
    """Model of the UAV, known to both ends, eq. (1)-(6)."""

    axes: Term[Literal[2, 3]] = 2
    """Number of axes: 2 to fly in the plane, 3 in space."""
    tau_s: Term[tuple[Factor, ...]] = (0.84,)
    """Time constant of the velocity loop [s]: one for all axes, or one each."""
    u_max: Term[tuple[Factor, ...]] = (1.6,)
    """Largest desired velocity [m/s]: one for all axes, or one each."""
    gain: Term[Factors] = 1.0
    """Gain of the velocity loop, steady velocity over desired velocity: one for all axes, or one
    each."""
    dead_time_s: Term[DeadTime | tuple[DeadTime, ...]] = 0.0
    """Dead time before an input takes effect [s]: one for all axes, or one each."""


class ControlConfig(Section, frozen=True):
    """Planning by the server, eq. (5)-(16)."""

    dt: Annotated[float, Meta(ge=0.001, le=1), Key(Owner.BOTH, term="dt_ns")] = 0.05
    """Length of a step, Δt [s]."""
    horizon: Term[Annotated[int, Meta(ge=1, le=INPUTS_MAX)]] = 80
    """Number of steps planned ahead, H."""
    scheme: Term[Text] = "trajectory"
    """Delay compensation, see `skytether schemes`. With `trajectory` the vehicle follows what is
    sent by itself, with the regulator that the weights in its own scenario ask for."""
    feedback: Term[bool] = True
    """Whether a horizon carries the state that it starts from and a feedback gain, with which the
    vehicle comes back to the predicted states. A vehicle that can only play inputs back needs
    false, and an `input_weight` of 3, as in the scenario `playback`."""
    delay_bound: OfServer[Duration | Literal["auto"]] = "auto"
    """Longest time from making a horizon to flying it [s]; auto: as measured in flight."""
    observer_s: OfServer[Duration] = 4.0
    """Time constant of the disturbance observer, which learns steady wind and a wrong gain [s]; it
    is longer where observations are old. 0, and the scheme "none": no observer."""
    trigger: OfTrigger[Text] = "expected_gap | heartbeat"
    """Rule for sending a horizon: policies combined with & and |, see `skytether triggers`. An
    argument of one is also a key: `control.trigger.expected_gap = 0.1`."""
    shared_bytes_per_s: OfServer[Annotated[float, Meta(ge=0, le=1e9)] | Literal["auto"]] = 0.0
    """Bytes a second that the server sends to all its vehicles together, headers of IP and UDP
    included; of the horizons that the trigger asks for, those expected to gain most a byte go
    first [B/s]. auto: as many as go without queueing; 0: no bound."""
    solver: OfServer[Literal["exact", "osqp"]] = "exact"
    """Solver of eq. (9): a Riccati active set, exact and fast, or OSQP, the reference."""
    spline_error_m: OfServer[Annotated[float, Meta(ge=0, le=1e3)]] = 0.01
    """Largest distance of a spline from the desired trajectory that the server sees [m], as far as
    16 knots reach, with the scheme "trajectory"."""
    state_weight: OfServer[tuple[Amount, Amount]] = (7.0, 1.0)
    """Weight Q of eq. (5) on the position [1/m²] and the velocity [s²/m²] of every axis."""
    terminal_weight: OfServer[tuple[Amount, Amount]] = (50.0, 20.0)
    """Weight P of eq. (5) and (16) on the final position [1/m²] and velocity [s²/m²]."""
    input_weight: OfServer[Annotated[float, Meta(ge=1e-9, le=1e9)]] = 1.0
    """Weight R of eq. (5) on the input [s²/m²]."""
    change_weight: OfServer[Amount] = 0.0
    """Weight S of eq. (9) on the change from the previous horizon, and with the scheme "trajectory"
    on the change of the input from step to step [s²/m²]."""
    input_reference: OfServer[bool] = True
    """Whether R weighs u - v_ref instead of u, so that R does not ask for standing still."""

    @property
    def properties(self) -> SchemeProperties:
        """What the scheme says of itself.

        Raises:
            GrammarError: there is none such.
        """
        return schemes.properties(self.scheme)


MISSIONS = ("swap", "sphere", "mission")
"""Shapes of the desired trajectory that are goals of several vehicles, which keep apart."""
TABLES = ("csv", "mission")
"""Shapes that are read from `reference.file`."""


class ReferenceConfig(Section, frozen=True):
    """Desired trajectory."""

    shape: Term[Text] = "circle"
    """Shape of the desired trajectory, see `skytether references`; target: a random walk that only
    the server knows; live: a point that is moved in flight."""
    preview: OfServer[Duration | Literal["all", "none"]] = "all"
    """Time for which the server knows the desired trajectory ahead [s]; it predicts what lies
    beyond, and always predicts a live point."""
    agility: OfServer[Strength] = 0.3
    """Strength of the white acceleration that moves a target [m/s per √s]."""
    turn_every_s: OfServer[Duration] = 0.0
    """Mean time between turns of a target [s]. Its velocity changes at turns alone, by as much as
    `agility` would have changed it in that time; 0: it changes all the time."""
    radius_m: Term[Annotated[float, Meta(ge=1e-3, le=shapes.FAR_M)]] = 1.55
    """Half the width of circle, figure-eight, square, swap and sphere, and of the area of a target
    [m]."""
    period_s: Term[Annotated[float, Meta(ge=0.1, le=86400)]] = 27.5
    """Time for one round of circle, figure-eight or square [s]."""
    altitude_m: Term[Position] = 0.0
    """Altitude of circle, figure-eight, square and swap in space, and of a sphere's centre [m]."""
    points_m: Annotated[
        tuple[tuple[Position, ...], ...], Key(Owner.BOTH, InFlight.POINT, term="points")
    ] = ()
    """Waypoints [m], at least two; the one point to hover at; the first position of a live
    point."""
    velocity_mps: Annotated[tuple[Speed, ...], Key(Owner.SERVER, InFlight.POINT)] = ()
    """Velocity of a live point [m/s]; left out: estimated from its moves."""
    speed_mps: Term[Factor] = 1.0
    """Speed between waypoints, and the largest of a target along an axis [m/s]."""
    loop: Term[bool] = False
    """Whether the vehicle returns from the last waypoint to the first and goes round again."""
    file: Annotated[str, Key(Owner.BOTH, term="table")] = ""
    """CSV file with the columns t, x, y (and z), of a mission also vehicle, relative to the
    scenario's own folder."""


class VehicleConfig(Section, frozen=True):
    """The UAV, as far as it is simulated, and its failsafe without fresh horizons."""

    kind: OfVehicle[Text] = "simulated"
    """Vehicle that flies, see `skytether vehicles`."""
    address: OfVehicle[str] = "udp:127.0.0.1:14550"
    """Line to an autopilot: udp:HOST:PORT (listens there), udpout:HOST:PORT, tcp:HOST:PORT or
    serial:PATH:BAUD."""
    memory: OfVehicle[Annotated[str, Meta(max_length=4096)]] = "auto"
    """Folder in which its client keeps what it needs to go on after a restart; auto: the state
    folder of its service or user, for a vehicle with an autopilot; none: it keeps nothing."""
    report: OfVehicle[Text] = "deviation(0.05) | silence(1)"
    """Rule for sending an observation: policies combined with & and |, see `skytether reports`."""
    exhausted: Term[Literal["hold", "brake"]] = "brake"
    """Action at the end of a horizon: hold its last input (the paper), or brake and hover."""
    brake_mps2: Term[Factor] = 2.0
    """Deceleration of the desired velocity when `brake` stops the vehicle [m/s²]."""
    slew_mps2: OfVehicle[Factor] = 50.0
    """Fastest change of the desired velocity on an axis [m/s²]; no limit where `exhausted` is
    `hold`."""
    land_after_s: Term[Duration] = 10.0
    """Time of hovering with a silent server after which the vehicle lands [s]; 0: never."""
    on_loss: OfVehicle[Literal["land", "return"]] = "land"
    """What it does `land_after_s` after it has begun to hover with a silent server: it lands where
    it is, or its autopilot flies it home and lands it there."""
    after_leap: Annotated[
        Literal["ask", "old", "new", "stay"], Key(Owner.VEHICLE, InFlight.LEAP)
    ] = "ask"
    """Choice after a leap of the position, given in flight alone: old (the leap is subtracted, the
    fence stays where it was), new (it counts, and the fence moves with it), or stay (it hovers on).
    Without one the vehicle lands after `land_after_s`; see docs/failsafe.md."""
    tau_s: OfVehicle[tuple[Factor, ...]] = ()
    """True time constant [s], one for all axes, or one each; left out: the model's."""
    gain: OfVehicle[Factors] = ()
    """True gain of the velocity loop, one for all axes, or one each; left out: the model's."""
    dead_time_s: OfVehicle[TrueDeadTime | tuple[TrueDeadTime, ...]] = ()
    """True dead time before an input takes effect [s], one for all axes, or one each; left out: the
    model's."""
    start_m: OfVehicle[tuple[Position, ...]] = ()
    """Position at the start, at rest [m]; left out: that of the reference."""
    wind: OfWind[Strength] = 0.0
    """Strength of random wind, a white acceleration [m/s per √s]."""
    steady_wind_mps: OfWind[tuple[Speed, ...]] = ()
    """Velocity that steady wind adds in the long run, for each axis [m/s]; left out: none. For a
    quadrotor, the wind's own velocity."""
    turbulence_mps: OfWind[Strength] = 0.0
    """Wind speed 6 m above ground whose turbulence a quadrotor flies in, by Dryden's model [m/s];
    0: none."""
    gust_mps2: OfWind[Strength] = 0.0
    """Acceleration by a gust [m/s²]; 0: no gusts."""
    gust_every_s: OfWind[MeanTime] = 10.0
    """Mean time from the end of one gust to the next [s]."""
    gust_s: OfWind[MeanTime] = 1.0
    """Mean length of a gust [s]."""
    frame: OfVehicle[Literal["auto", "crazyflie", "1.5kg", "sih"]] = "auto"
    """Frame of a quadrotor, see docs/vehicles.md; auto: 1.5kg, and of an autopilot the one that
    its own simulator flies."""
    battery: OfVehicle[Annotated[float, Meta(ge=0, le=1)] | Literal["endless"]] = 1.0
    """Charge of a quadrotor's battery at the start, from 0 to 1; endless: it stays full."""


class FenceConfig(Section, frozen=True):
    """Fence: where the vehicle never goes, whatever it is told.

    The vehicle goes by its own file; a server whose file has a fence refuses what leads over it.
    """

    low_m: OfEach[tuple[Position, ...]] = ()
    """Lowest position on each axis [m]; left out: no bound. In space the third is the altitude."""
    high_m: OfEach[tuple[Position, ...]] = ()
    """Highest position on each axis [m]; left out: no bound."""
    radius_m: OfEach[Strength] = 0.0
    """Largest distance from where it started [m]; 0: no bound."""
    speed_mps: OfEach[Strength] = 0.0
    """Largest desired speed, over all axes [m/s]; 0: no bound but `model.u_max`."""
    wind_mps: OfEach[Annotated[float, Meta(ge=0, le=100)]] = 1.0
    """Velocity that wind, or an error of the gain, adds at most while the fence holds [m/s]: the
    stronger, the further inside the vehicle is kept."""

    @property
    def is_there(self) -> bool:
        """Whether anything is fenced in."""
        return bool(self.low_m or self.high_m or self.radius_m or self.speed_mps)


class MissionConfig(Section, frozen=True):
    """Vehicles with goals of their own, which keep apart whichever packets are lost.

    See docs/together.md.
    """

    separation_m: OfServer[Annotated[float, Meta(ge=1e-3, le=1e3)]] = 0.5
    """Smallest distance between two vehicles [m]."""
    height_m: OfServer[Annotated[float, Meta(ge=0, le=1e3)]] = 0.0
    """Smallest distance of two that are one above the other [m], for downwash: 0, for the same, or
    at least `separation_m`."""
    tube_m: OfServer[Annotated[float, Meta(ge=0, le=1e3)]] = 0.15
    """Largest distance of a vehicle from the motion that it flies [m]: wind, tracking."""
    speed_mps: OfServer[Strength] = 0.0
    """Largest speed of a motion, over all axes [m/s]; 0: no bound but `model.u_max`."""
    acceleration_mps2: OfServer[Annotated[float, Meta(ge=1e-3, le=1e3)]] = 0.6
    """Largest acceleration of a motion on an axis [m/s²]."""
    allocate: OfServer[bool] = False
    """Whether goals of one time go to the vehicles that are nearest to them; all have one then."""
    goals: Annotated[str, Meta(max_length=4000), Key(Owner.SERVER, InFlight.GOALS)] = ""
    """Goals of vehicles in place of those of the mission, as they are given in flight:
    goal(vehicle, x, y), or with z in space, combined with &."""
    zones: Annotated[str, Meta(max_length=4000), Key(Owner.SERVER, InFlight.ZONES)] = ""
    """Places to keep out of or to stay within, combined with &: box(x0, x1, y0, y1), cylinder(x, y,
    radius), polygon(x, y, …), fence(x0, x1, y0, y1), corridor(width, x, y, …), geojson(file)."""

    @property
    def height_scale(self) -> float:
        """Factor of distances along the third axis before they count for `separation_m`."""
        return self.separation_m / self.height_m if self.height_m else 1.0


class SensorConfig(Section, frozen=True):
    """Sensors of the vehicle, and the filter of their measurements."""

    filter: OfVehicle[Literal["kalman", "none"]] = "kalman"
    """Filter between sensors and flight: a Kalman filter, or none, where each measurement is taken
    as it is. With perfect measurements both are the same."""
    position_noise_m: OfVehicle[Strength] = 0.0
    """Standard deviation of the noise of a position [m]."""
    velocity_noise_mps: OfVehicle[Strength] = 0.0
    """Standard deviation of the noise of a velocity [m/s]."""
    position_bias_m: OfVehicle[tuple[Position, ...]] = ()
    """Constant error of each position, for each axis [m]; left out: none."""
    velocity_bias_mps: OfVehicle[tuple[Speed, ...]] = ()
    """Constant error of each velocity, for each axis [m/s]; left out: none."""
    position_every_s: OfVehicle[Duration] = 0.0
    """Time from one measured position to the next [s]; 0: one at every step."""
    velocity_every_s: OfVehicle[Duration | Literal["never"]] = 0.0
    """Time from one measured velocity to the next [s]; 0: one at every step; never: positions
    alone are measured."""
    delay_s: OfVehicle[Annotated[float, Meta(ge=0, le=2)]] = 0.0
    """Time from measuring to having the measurement [s]."""
    process_noise: OfVehicle[Factor] = 0.1
    """Strength of the white acceleration that the filter assumes [m/s per √s]: for wind, and for
    all differences between vehicle and model."""


class MavlinkConfig(Section, frozen=True):
    """Autopilot that speaks MAVLink, of a vehicle of the kind `mavlink`."""

    system: OfVehicle[Annotated[int, Meta(ge=1, le=255)]] = 245
    """Number of our own system in MAVLink; ArduPilot's ground-station failsafe must listen to
    it."""
    component: OfVehicle[Annotated[int, Meta(ge=1, le=255)]] = 191
    """Number of our own component in MAVLink; 191 is that of an onboard computer."""
    autopilot: OfVehicle[Annotated[int, Meta(ge=0, le=255)]] = 0
    """Number of the autopilot's system; 0: the first that is heard."""
    positions_hz: OfVehicle[Annotated[int, Meta(ge=5, le=200)]] = 50
    """Number of positions a second that the autopilot is asked for."""
    silence_s: OfVehicle[Annotated[float, Meta(ge=0.2, le=5)]] = 0.5
    """Time without a position of the autopilot after which the vehicle brakes [s]."""
    battery_min: OfVehicle[Annotated[float, Meta(ge=0, le=1)]] = 0.2
    """Charge of the battery below which the vehicle lands, from 0 to 1."""
    battery_min_v: OfVehicle[Annotated[float, Meta(ge=0, le=100)]] = 0.0
    """Voltage of the battery below which the vehicle lands [V]; 0: at none."""
    takeoff_m: OfVehicle[Annotated[float, Meta(ge=0.5, le=100)] | Literal["auto"]] = "auto"
    """Altitude to take off to [m]; auto: that at which the desired trajectory begins, and 3 m in
    the plane."""
    origin: Annotated[
        Literal["takeoff", "autopilot"] | tuple[Position, ...],
        Key(Owner.VEHICLE, InFlight.ORIGIN),
    ] = "takeoff"
    """Origin of the flight: the point where we arm the vehicle, the autopilot's own local origin,
    or a place in the autopilot's local frame: north, east (and up) [m]. On a mission a vehicle is
    armed where it begins: that point is its first goal, on the ground. With `takeoff` a client that
    begins while the vehicle is in the air knows its origin from `vehicle.memory`; else the vehicle
    hovers until this key is set."""
    second_commander: OfVehicle[Literal["brake", "yield"]] = "brake"
    """Answer to somebody else who commands the autopilot, or to a vehicle that does not do what it
    is told: it brakes, and lands if that goes on; or it yields, as to a pilot, until that is
    over."""
    patience_s: OfVehicle[Annotated[float, Meta(ge=1, le=600)]] = 60.0
    """Time that the autopilot may take until it is heard, and for each step on its way into the
    air [s]."""


class NetworkConfig(Section, frozen=True):
    """Impairments of the network, both ways."""

    uplink: OfImpairment[Direction] = "paper(0.4, 0.02, 2.0) & loss(0.1)"
    """Impairments from server to vehicle, combined with &, see `skytether impairments`; "": none.
    An argument of one is also a key: `network.uplink.loss = 0.3`."""
    downlink: OfImpairment[Direction] = "paper(0.4, 0.02, 2.0) & loss(0.1)"
    """Impairments from vehicle to server, in the same way."""
    mtu: OfNetem[Annotated[int, Meta(ge=PAYLOAD_BYTES_MAX, le=65_507)]] = 1472
    """Longest UDP payload that passes [B]: 1472 fill an Ethernet frame."""


class LinkConfig(Section, frozen=True):
    """Time limits of a session."""

    heartbeat_s: OfEach[Interval | Literal["auto"]] = "auto"
    """Longest time between two packets that this end asks of the other [s]; auto: from its
    `timeout_s` and the share of packets that are lost on the way to it."""
    age_max_s: Term[Annotated[float, Meta(gt=0, le=60)]] = 5.0
    """Largest age of the observation behind an input [s]; beyond it the vehicle brakes and hovers,
    or holds its last input where `vehicle.exhausted` says so."""
    join_s: Term[Annotated[float, Meta(ge=0, le=10)]] = 0.0
    """Time after its first knot up to which the vehicle takes a trajectory [s]; 0: at any time. It
    tells the server for certain which one is flown."""
    asymmetry_s: OfServer[Annotated[float, Meta(ge=0, le=10)]] = 0.0
    """Largest difference of the smallest delays to a vehicle and from it over 20 s [s]; 0: not
    known. It bounds the error of the vehicle's clock; the server watches whether it holds."""
    time_of_day: OfEach[Literal["none", "host"]] = "none"
    """Source of the time of day on a mission: the host's clock, to within the error that its kernel
    tells, as chrony sets it; where both ends have one, the vehicle's clock is known by that."""
    timeout_s: OfEach[Interval] = 1.5
    """Time of silence after which the vehicle takes the server for gone [s]: it brakes and says
    HELLO again. After the same time, or twice that with heartbeats "auto", the server lets
    another client have the vehicle's number."""
    connect_s: OfVehicle[Interval] = 120.0
    """Time for which the vehicle waits for its first session before it gives up [s]; a server that
    starts for the first time compiles for up to a minute."""

    @property
    def fixed_ns(self) -> int | None:
        """`heartbeat_s` [ns]; None where it follows the loss."""
        return None if self.heartbeat_s == "auto" else seconds_to_ns(self.heartbeat_s)

    @property
    def patience_ns(self) -> int:
        """Time of silence after which the server takes a vehicle for gone [ns].

        A vehicle brakes when its server is silent. The server only keeps the vehicle's number from
        another client, so it can wait longer, and then needs half as many heartbeats.
        """
        timeout_ns = seconds_to_ns(self.timeout_s)
        if self.fixed_ns is not None:
            return timeout_ns
        return max(timeout_ns, min(PATIENCE * timeout_ns, SESSION_NS))


class SimulationConfig(Section, frozen=True):
    """Computing time and clocks in virtual time."""

    compute_s: OfVirtualTime[Duration] = 0.001
    """Time that the server takes for a step [s]."""
    clock_offset_s: OfVirtualTime[Annotated[float, Meta(ge=-1e9, le=1e9)]] = 0.0
    """Offset of the vehicle's clock from the server's at the start [s]."""
    clock_drift_ppm: OfVirtualTime[Annotated[float, Meta(ge=-1000, le=1000)]] = 0.0
    """Drift: how much faster the vehicle's clock runs than the server's [ppm]."""
    time_error_s: OfVirtualTime[Duration] = 0.0
    """Largest error of the time of day of each end of a mission [s]; 0: none knows it. It is as
    wrong as it may be, at the server and at every second vehicle the other way."""


class Scenario(Section, frozen=True):
    """Scenario: all keys of a flight."""

    title: OfEach[str] = ""
    """Title: what the scenario shows, in a line."""
    duration: OfVehicle[Annotated[float, Meta(gt=0, le=86400)]] = 60.0
    """Length of the flight [s]."""
    settle: OfVehicle[Annotated[float, Meta(ge=0, le=86400)]] = 0.0
    """Time at the start that RMSE leaves out [s]; half of the duration where it is no shorter than
    that."""
    seed: OfEach[Annotated[int, Meta(ge=0, le=2**32 - 1)]] = 1
    """Seed of everything random: delays, losses, wind."""
    armed: Annotated[bool, Key(Owner.VEHICLE, InFlight.ARMED)] = True
    """Whether plans may be flown; disarmed, the vehicle stays where it is."""
    model: ModelConfig = ModelConfig()
    control: ControlConfig = ControlConfig()
    reference: ReferenceConfig = ReferenceConfig()
    vehicle: VehicleConfig = VehicleConfig()
    fence: FenceConfig = FenceConfig()
    mission: MissionConfig = MissionConfig()
    sensor: SensorConfig = SensorConfig()
    mavlink: MavlinkConfig = MavlinkConfig()
    network: NetworkConfig = NetworkConfig()
    link: LinkConfig = LinkConfig()
    simulation: SimulationConfig = SimulationConfig()

    @property
    def files(self) -> Files:
        """Files that the scenario names, with their contents."""
        return ()

    @property
    def table(self) -> bytes:
        """Content of `reference.file`, for a shape that is read from it; else empty.

        Raises:
            ConfigError: the file has not been read with the scenario.
        """
        file = self.reference.file
        return content(self.files, file) if self.reference.shape in TABLES else b""

    @property
    def uplink(self) -> air.Path:
        """Impairments from server to vehicle.

        Raises:
            GrammarError: there are none such.
        """
        return air.path(self.network.uplink, self.files)

    @property
    def downlink(self) -> air.Path:
        """Impairments from vehicle to server; see `uplink`."""
        return air.path(self.network.downlink, self.files)

    @property
    def dt_ns(self) -> int:
        """Length of a step [ns]."""
        return seconds_to_ns(self.control.dt)

    @property
    def steps(self) -> int:
        """Number of steps in the whole flight."""
        return max(1, round(self.duration / self.control.dt))

    @property
    def settled_s(self) -> float:
        """Time of flight from which RMSE counts [s]."""
        return self.settle if self.settle < self.duration else self.duration / 2.0

    @property
    def tau_s(self) -> Array:
        """The model's time constants [s]; shape (axes,)."""
        return self._per_axis(self.model.tau_s)

    @property
    def true_tau_s(self) -> Array:
        """The vehicle's time constants [s]; shape (axes,)."""
        return self._per_axis(self.vehicle.tau_s or self.model.tau_s)

    @property
    def u_max(self) -> Array:
        """Bounds of the input [m/s]; shape (axes,)."""
        return self._per_axis(self.model.u_max)

    @property
    def model_gain(self) -> Array:
        """The model's gains; shape (axes,)."""
        return self._per_axis(self.model.gain)

    @property
    def true_gain(self) -> Array:
        """The vehicle's gains; shape (axes,)."""
        return self._per_axis(self.model.gain if self.vehicle.gain == () else self.vehicle.gain)

    @property
    def true_dead_time_s(self) -> Array:
        """The vehicle's dead times [s]; shape (axes,)."""
        given = self.vehicle.dead_time_s
        return self._per_axis(self.model.dead_time_s if given == () else given)

    def _per_axis(self, values: float | tuple[float, ...]) -> Array:
        return np.array(np.broadcast_to(values, self.model.axes), dtype=np.float64)

    def terms(self) -> Terms:
        """Terms that both ends must agree on before a flight."""
        control, vehicle, reference = self.control, self.vehicle, self.reference
        return Terms(
            dt_ns=self.dt_ns,
            horizon=control.horizon,
            axes=self.model.axes,
            tau_s=tuple(self.tau_s.tolist()),
            gain=tuple(self.model_gain.tolist()),
            dead_time_s=tuple(self._per_axis(self.model.dead_time_s).tolist()),
            u_max=tuple(self.u_max.tolist()),
            scheme=control.properties.flown_as,
            feedback=control.feedback,
            exhausted=vehicle.exhausted,
            brake_mps2=vehicle.brake_mps2,
            age_max_s=self.link.age_max_s,
            join_s=self.link.join_s,
            land_after_s=vehicle.land_after_s,
            shape=self._shape(),
            radius_m=reference.radius_m,
            period_s=reference.period_s,
            altitude_m=reference.altitude_m,
            points=_digest(repr(reference.points_m).encode() if reference.points_m else b""),
            speed_mps=reference.speed_mps,
            loop=reference.loop,
            table=_digest(self.table),
        )

    def make_reference(self, vehicle: int = 1) -> shapes.Reference:
        """The desired trajectory of a vehicle, by its number; each has a target of its own."""
        made = self.given_reference(vehicle)
        if isinstance(made, Mission) and self.mission.allocate:
            return made.allocated().of(vehicle)
        return made

    def given_reference(self, vehicle: int = 1) -> shapes.Reference:
        """The desired trajectory of a vehicle; on a mission, before goals are allocated."""
        shape, flown = REFERENCES.one(self.reference.shape), self
        if shape.name == "target" and vehicle != 1:
            seed = int(stream(self.seed, "target", vehicle).integers(2**32))
            flown = msgspec.structs.replace(self, seed=seed)
        made: shapes.Reference = REFERENCES[shape.name].make(flown, *shape.values)
        return made.of(vehicle) if isinstance(made, Mission) else made

    def start_m(self, vehicle: int = 1) -> Array:
        """Position where a vehicle begins [m]; shape (axes,)."""
        if self.vehicle.start_m:
            return np.array(self.vehicle.start_m)
        return self.given_reference(vehicle)(np.zeros(()))[:, 0]

    @property
    def is_mission(self) -> bool:
        """Whether vehicles have goals of their own, and keep apart."""
        return self.reference.shape.partition("(")[0].strip() in MISSIONS

    @property
    def clearances(self) -> Clearances:
        """Distances that motions of a mission keep."""
        mission = self.mission
        most_mps2 = float(np.sqrt(self.model.axes)) * mission.acceleration_mps2
        return Clearances(
            mission.separation_m + 2.0 * mission.tube_m,
            mission.tube_m,
            bend_m(most_mps2, self.control.dt),
        )

    @property
    def lands(self) -> bool:
        """Whether vehicles of a mission in space land by themselves when they hear nothing."""
        return self.is_mission and self.model.axes > 2 and self.vehicle.land_after_s > 0.0

    @property
    def rest_scale(self) -> float:
        """Factor of distances along the third axis where vehicles rest: 0 if they may land."""
        return 0.0 if self.lands else self.mission.height_scale

    @property
    def zones(self) -> Zones:
        """Zones of a mission; nobody who may land is above one.

        Raises:
            GrammarError: there are none such.
        """
        found = zones.parse(self.mission.zones, self.model.axes, self.files)
        return found.to_the_sky() if self.lands else found

    def entries(self) -> Iterator[Entry]:
        """Scheme, policies and shape that the scenario names."""
        yield SCHEMES[schemes.call(self.control.scheme).name]
        for policy in leaves(TRIGGERS.parse(self.control.trigger)):
            yield TRIGGERS[policy.name]
        yield REFERENCES[REFERENCES.one(self.reference.shape).name]
        flies = self.vehicle.kind.partition("(")[0].strip()
        if flies in VEHICLES:  # ours are there once there is a client
            yield VEHICLES[flies]

    def _shape(self) -> str:
        """Shape as both ends compare it: its name, or for a plug-in its text and a digest."""
        shape = REFERENCES.one(self.reference.shape)
        if REFERENCES[shape.name].is_ours:
            return shape.name
        given = shapes.sampled(self.given_reference(), self.model.axes)
        return f"{str(shape)[:SHAPE_TOLD]} {_digest(f'{shape}'.encode() + given)}"


class WithFiles(Scenario, frozen=True):
    """Scenario that names files, as `reading.py` has read it."""

    contents: Files = ()
    """The files that it names."""

    @property
    def files(self) -> Files:
        """See `Scenario`."""
        return self.contents


def _digest(content: bytes) -> str:
    """A short text that differs where the content does, "none" of nothing."""
    return hashlib.blake2s(content, digest_size=8).hexdigest() if content else "none"
