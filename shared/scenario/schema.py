"""Keys of a scenario: everything about a flight, typed and frozen.

This module defines the keys of the core. An optional package defines the keys of its section in its
module `keys` (`rooms.SECTIONS`); `whole.Scenario` has all sections. A definition consists of name,
owner (`owners.py`), type with bounds, default, and a description with the unit in brackets. The
description appears in `--help` and in docs/keys.md, which `make keys` writes. Both ends use a
`Term`: `Scenario.terms` copies it to a field of `shared/law/terms.py: Terms`.

`reading.py` reads a scenario from its TOML file, and `contradictions.py` finds values that are
valid alone, but not together.
"""

import hashlib
from collections.abc import Iterator
from itertools import chain
from typing import Annotated, Any, Literal, Self, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from skytether.shared.base.chance import stream
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.law.heartbeat import PATIENCE, SESSION_NS
from skytether.shared.law.model import Array
from skytether.shared.law.terms import Terms
from skytether.shared.scenario import reference as shapes
from skytether.shared.scenario import rooms, schemes
from skytether.shared.scenario.grammar import TEXT_MAX
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
    Files,
    file_of,
    load,
)
from skytether.shared.scenario.schemes import SchemeProperties
from skytether.shared.wire.framing import PATHS_MAX
from skytether.shared.wire.protocol import INPUTS_MAX, PAYLOAD_BYTES_MAX

# Bounds of numbers are far beyond any vehicle, but so low that no time overflows 63 bits of
# nanoseconds and no product of several values overflows a float.
Factor = Annotated[float, Meta(ge=1e-3, le=1e3)]
Factors = Factor | tuple[Factor, ...]
"""One number for all axes, or one number for each axis."""
DeadTime = Annotated[float, Meta(ge=0, le=2)]
TrueDeadTime = Annotated[float, Meta(ge=0, le=10)]
Strength = Annotated[float, Meta(ge=0, le=1e3)]
Speed = Annotated[float, Meta(ge=-1e3, le=1e3)]
Position = Annotated[float, Meta(ge=-shapes.FAR_M, le=shapes.FAR_M)]
Amount = Annotated[float, Meta(ge=0, le=1e9)]
Duration = Annotated[float, Meta(ge=0, le=3600)]
Interval = Annotated[float, Meta(ge=1e-3, le=3600)]
MeanTime = Annotated[float, Meta(ge=1e-9, le=1e9)]
Text = Annotated[str, Meta(max_length=TEXT_MAX)]
Direction = Annotated[str, Meta(max_length=1000)]
TopicName = Annotated[str, Meta(max_length=200, pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$")]
"""Name of a ROS topic, with its namespace."""


SHAPE_CHARS = 15
"""Number of characters of the text of a plug-in's shape that precede the digest in the terms."""


Contradiction = tuple[str, object, str]
"""Contradiction: a key, its given value, and the expected value in words."""


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of every table of a scenario. Optional packages add sections, see `rooms.SECTIONS`."""

    def shared_terms(self) -> dict[str, Any]:
        """Fields of `Terms` that an optional section fills in."""
        return {}

    def guard(self) -> str:
        """Module with a `Guard`, which limits the inputs aboard; empty: none."""
        return ""

    def contradictions(self, scenario: "Scenario") -> Iterator[Contradiction]:  # noqa: ARG002
        """Contradictions of the section's keys with other keys."""
        yield from ()

    def contradictions_of_way(
        self,
        scenario: "Scenario",  # noqa: ARG002
        *,
        is_new: bool,  # noqa: ARG002
    ) -> Iterator[Contradiction]:
        """Contradictions of the section's keys with the desired trajectory.

        Args:
            is_new: whether this is the first check of the trajectory.
        """
        yield from ()

    def assigned(self, reference: shapes.Reference, vehicle: int) -> shapes.Reference:  # noqa: ARG002
        """Desired trajectory of a vehicle after goals were assigned to vehicles, as on missions."""
        return reference


class ModelConfig(Section, frozen=True):
    """Model of the UAV, known to both ends, eq. (1)-(6). A list has one number for all axes, or one
    for each.
    """

    axes: Term[Literal[2, 3]] = 2
    """Number of axes: 2 in the plane, 3 in space."""
    tau_s: Term[tuple[Factor, ...]] = (0.84,)
    """Time constant of the velocity loop [s]."""
    u_max: Term[tuple[Factor, ...]] = (1.6,)
    """Largest desired velocity [m/s]."""
    gain: Term[Factors] = 1.0
    """Gain of the velocity loop: steady velocity over desired velocity."""
    dead_time_s: Term[DeadTime | tuple[DeadTime, ...]] = 0.0
    """Dead time before an input takes effect [s]."""


class ControlConfig(Section, frozen=True):
    """Planning by the server, eq. (5)-(16)."""

    dt: Annotated[float, Meta(ge=0.001, le=1), Key(Owner.BOTH, term="dt_ns")] = 0.05
    """Length of a step, Δt [s]."""
    horizon: Term[Annotated[int, Meta(ge=1, le=INPUTS_MAX)]] = 80
    """Number of steps planned ahead, H."""
    scheme: Term[Text] = "trajectory"
    """Scheme of delay compensation, see `skytether list schemes`."""
    feedback: Term[bool] = True
    """Whether the vehicle corrects deviations from a horizon's states. A vehicle that can only play
    back inputs needs false, and `input_weight` 3, as in the scenario `playback`."""
    delay_bound: OfServer[Duration | Literal["auto"]] = "auto"
    """Longest time from planning a horizon until it is in force [s]; auto: as measured."""
    observer_s: OfServer[Duration] = 4.0
    """Time constant with which steady wind and errors of the gain are estimated [s]; longer if
    observations are old. 0, or scheme "none": no estimate."""
    trigger: OfTrigger[Text] = "expected_gap | heartbeat"
    """Rule for sending a horizon: policies combined with & and |, see `skytether list triggers`. An
    argument is also a key: `control.trigger.expected_gap = 0.1`."""
    shared_bytes_per_s: OfServer[Annotated[float, Meta(ge=0, le=1e9)]] = 0.0
    """Largest data rate to all vehicles together, IP and UDP headers included [B/s]; horizons with
    the largest gain per byte are sent first. 0: no limit."""
    planner: OfServer[Text] = "mpc"
    """Planner, see `skytether list planners`: the MPC of eq. (9), or a plug-in's."""
    solver: OfServer[Literal["exact", "osqp"]] = "exact"
    """Solver of eq. (9): a Riccati active set (exact and fast), or OSQP for comparison."""
    spline_error_m: OfServer[Annotated[float, Meta(ge=0, le=1e3)]] = 0.01
    """Largest distance of a sent spline from the planned trajectory [m]; more if 16 knots are too
    few."""
    state_weight: OfServer[tuple[Amount, Amount]] = (7.0, 1.0)
    """Weight Q of eq. (5) on position [1/m²] and velocity [s²/m²] of every axis."""
    terminal_weight: OfServer[tuple[Amount, Amount]] = (50.0, 20.0)
    """Weight P of eq. (5) and (16) on the final position [1/m²] and velocity [s²/m²]."""
    input_weight: OfServer[Annotated[float, Meta(ge=1e-9, le=1e9)]] = 1.0
    """Weight R of eq. (5) on the input [s²/m²]."""
    change_weight: OfServer[Amount] = 0.0
    """Weight S of eq. (9) on the change from the previous horizon; with the scheme "trajectory", on
    the change of the input from step to step [s²/m²]."""
    input_reference: OfServer[bool] = True
    """Whether R weighs u - v_ref instead of u; R then does not make the vehicle slower."""

    @property
    def properties(self) -> SchemeProperties:
        """Properties of the scheme; raises GrammarError if there is no such scheme."""
        return schemes.properties(self.scheme)


class ReferenceConfig(Section, frozen=True):
    """Desired trajectory."""

    shape: Term[Text] = "circle"
    """Shape of the desired trajectory, see `skytether list references`."""
    preview: OfServer[Duration | Literal["all", "none"]] = "all"
    """Time for which the server knows the desired trajectory in advance [s]. Beyond this time, and
    for a live point, the server extrapolates."""
    agility: OfServer[Strength] = 0.3
    """Strength of the white acceleration of a target [m/s per √s]."""
    turn_every_s: OfServer[Duration] = 0.0
    """Mean time between turns of a target [s]; 0: the target's velocity changes all the time."""
    noise_m: OfServer[Annotated[float, Meta(ge=0, le=1e3)]] = 0.0
    """Standard deviation of the server's measurements of a target's position, one at every step
    [m]. The server estimates position and velocity from the measurements. 0: the server knows both
    exactly."""
    radius_m: Term[Annotated[float, Meta(ge=1e-3, le=shapes.FAR_M)]] = 1.55
    """Half the width of the shape, or of a target's area [m]."""
    period_s: Term[Annotated[float, Meta(ge=0.1, le=86400)]] = 27.5
    """Time for one round of circle, figure-eight or square [s]."""
    altitude_m: Term[Position] = 0.0
    """Altitude of the shape in space [m]."""
    points_m: Annotated[
        tuple[tuple[Position, ...], ...], Key(Owner.BOTH, InFlight.POINT, term="points")
    ] = ()
    """Waypoints, the point to hover at, or the start of a live point [m]."""
    velocity_mps: Annotated[tuple[Speed, ...], Key(Owner.SERVER, InFlight.POINT)] = ()
    """Velocity of a live point [m/s]; default: estimated from the point's moves."""
    speed_mps: Term[Factor] = 1.0
    """Speed between waypoints, and between the places of a file without times; largest speed of a
    target along an axis [m/s]."""
    loop: Term[bool] = False
    """Whether the waypoints are repeated."""
    file: Annotated[str, Key(Owner.BOTH, term="table")] = ""
    """File with the points and their times: CSV with the columns t, x, y (in space also z, on a
    mission also vehicle), see docs/vehicles.md, or a format in docs/together.md. The path is
    relative to the scenario's folder."""
    origin: OfEach[tuple[Position, ...]] = ()
    """Latitude and longitude of the scenario's origin [degrees], and its altitude above the sea [m]
    for files with altitudes above the sea; default: the file's own origin, if the file has one."""


class VehicleConfig(Section, frozen=True):
    """The UAV: its simulation, its observations, and its failsafe."""

    kind: OfVehicle[Text] = "simulated"
    """Vehicle, see `skytether list vehicles`."""
    address: OfVehicle[str] = "udp:127.0.0.1:14550"
    """Connection to an autopilot: udp:HOST:PORT (listens there), udpout:HOST:PORT, tcp:HOST:PORT or
    serial:PATH:BAUD; to a robot that speaks ROS 2: tcp:HOST:PORT of a Zenoh router."""
    memory: OfVehicle[Annotated[str, Meta(max_length=4096)]] = "auto"
    """Folder for the state that a restarted client needs. none: no state is saved; auto: with an
    autopilot, the state is saved in the state folder of the service or user."""
    report: OfVehicle[Text] = "deviation(0.05) | silence(1)"
    """Rule for sending an observation: policies joined by & and |, see `skytether list reports`."""
    exhausted: Term[Literal["hold", "brake"]] = "brake"
    """Action at the end of a horizon: hold its last input (the paper), or brake and hover."""
    brake_mps2: Term[Factor] = 2.0
    """Deceleration when braking [m/s²]."""
    slew_mps2: OfVehicle[Factor] = 50.0
    """Fastest change of the desired velocity on an axis [m/s²]; no limit with `exhausted =
    "hold"`."""
    land_after_s: Term[Duration] = 10.0
    """Time of hovering without packets of the server before landing [s]; 0: never lands."""
    on_loss: OfVehicle[Literal["land", "return"]] = "land"
    """Action after `land_after_s`: land in place, or return home by the autopilot and land
    there."""
    after_leap: Annotated[
        Literal["ask", "old", "new", "stay"],
        Key(Owner.VEHICLE, InFlight.LEAP, is_decision=True),
    ] = "ask"
    """Choice after a leap of the position, made in flight only. old: subtract the leap; new: accept
    it, which also moves the fence; stay: hover on. See docs/failsafe.md."""
    tau_s: OfVehicle[tuple[Factor, ...]] = ()
    """True time constant [s]; default: the model's."""
    gain: OfVehicle[Factors] = ()
    """True gain of the velocity loop; default: the model's."""
    dead_time_s: OfVehicle[TrueDeadTime | tuple[TrueDeadTime, ...]] = ()
    """True dead time before an input takes effect [s]; default: the model's."""
    start_m: OfVehicle[tuple[Position, ...]] = ()
    """Position at the start, at rest [m]; default: the reference's position."""
    wind: OfWind[Strength] = 0.0
    """Strength of random wind, a white acceleration [m/s per √s]."""
    steady_wind_mps: OfWind[tuple[Speed, ...]] = ()
    """Velocity that constant wind adds on each axis [m/s]; for a quadrotor, the velocity of the
    wind itself."""
    turbulence_mps: OfWind[Strength] = 0.0
    """Wind speed 6 m above ground, for the Dryden turbulence of a quadrotor [m/s]."""
    gust_mps2: OfWind[Strength] = 0.0
    """Acceleration by a gust [m/s²]."""
    gust_every_s: OfWind[MeanTime] = 10.0
    """Mean time between gusts [s]."""
    gust_s: OfWind[MeanTime] = 1.0
    """Mean length of a gust [s]."""
    frame: OfVehicle[Literal["auto", "crazyflie", "1.5kg", "sih"]] = "auto"
    """Frame of a quadrotor, see docs/vehicles.md; auto: 1.5kg, or the frame of the autopilot's own
    simulator."""
    battery: OfVehicle[Annotated[float, Meta(ge=0, le=1)] | Literal["endless"]] = 1.0
    """Charge of a quadrotor's battery at the start, from 0 to 1; endless: always full."""


class SensorConfig(Section, frozen=True):
    """Sensors of the vehicle, and the filter of their measurements."""

    filter: OfVehicle[Literal["kalman", "none"]] = "kalman"
    """Filter of the measurements: Kalman filter or none."""
    position_noise_m: OfVehicle[Strength] = 0.0
    """Standard deviation of a measured position [m]."""
    velocity_noise_mps: OfVehicle[Strength] = 0.0
    """Standard deviation of a measured velocity [m/s]."""
    position_bias_m: OfVehicle[tuple[Position, ...]] = ()
    """Constant error of positions, on each axis [m]."""
    velocity_bias_mps: OfVehicle[tuple[Speed, ...]] = ()
    """Constant error of velocities, on each axis [m/s]."""
    position_every_s: OfVehicle[Duration] = 0.0
    """Time between two measured positions [s]; 0: measured at every step."""
    velocity_every_s: OfVehicle[Duration | Literal["never"]] = 0.0
    """Time between two measured velocities [s]; 0: measured at every step."""
    delay_s: OfVehicle[Annotated[float, Meta(ge=0, le=2)]] = 0.0
    """Delay of the measurements [s]."""
    process_noise: OfVehicle[Factor] = 0.1
    """Strength of the white acceleration that the filter assumes [m/s per √s]."""


class PathConfig(Section, frozen=True):
    """Path of a session: a separate network between vehicle and server."""

    uplink: Direction
    downlink: Direction
    price: Annotated[float, Meta(gt=0, le=1e6)] = 1.0


class NetworkConfig(Section, frozen=True):
    """Network between server and vehicle, as netem emulates it."""

    uplink: OfImpairment[Direction] = "paper(0.4, 0.02, 2.0) & loss(0.1)"
    """Impairments from server to vehicle, combined with &, see `skytether list impairments`. An
    argument is also a key: `network.uplink.loss = 0.3`."""
    downlink: OfImpairment[Direction] = "paper(0.4, 0.02, 2.0) & loss(0.1)"
    """Impairments from vehicle to server."""
    mtu: OfNetem[Annotated[int, Meta(ge=PAYLOAD_BYTES_MAX, le=65_507)]] = 1472
    """Largest UDP payload that is delivered [B]; 1472 fills an Ethernet frame."""
    paths: OfEach[Annotated[tuple[PathConfig, ...], Meta(max_length=PATHS_MAX)]] = ()
    """Paths of the session, each a separate network, see docs/network.md: tables with `uplink`,
    `downlink` (default: those of `network`) and `price`, the price of a packet relative to the
    other paths (more than 0, default 1). The paths replace `uplink` and `downlink` of `network`."""


class LinkConfig(Section, frozen=True):
    """Time limits of a session."""

    heartbeat_s: OfEach[Interval | Literal["auto"]] = "auto"
    """Longest silence allowed to the other end [s]; auto: from this end's `timeout_s` and the
    measured loss."""
    age_max_s: Term[Annotated[float, Meta(gt=0, le=60)]] = 5.0
    """Largest age of the observation from which an input was computed [s]; beyond this age the
    vehicle acts as at the end of a horizon (`vehicle.exhausted`)."""
    join_s: Term[Annotated[float, Meta(ge=0, le=10)]] = 0.0
    """Time after a trajectory's first knot for which the vehicle accepts the trajectory [s]; 0:
    always. With a limit the server knows which trajectory the vehicle flies."""
    asymmetry_s: OfServer[Annotated[float, Meta(ge=0, le=10)]] = 0.0
    """Upper bound of the difference between the smallest delay of the uplink and that of the
    downlink, each over 20 s [s]; 0: unknown. The value bounds the error of the vehicle's clock."""
    time_of_day: OfEach[Literal["none", "host"]] = "none"
    """Source of the time of day on a mission. If both ends have a source, the times of day bound
    the error of the vehicle's clock independently of delays. host: the host's clock, with the error
    that its kernel reports (set by chrony or ntpd)."""
    timeout_s: OfEach[Interval] = 1.5
    """Silence after which the vehicle brakes and asks for a new session [s]. The server frees the
    vehicle's number after the same time, or twice this time with heartbeats "auto"."""
    spread: OfEach[Literal["auto", "best", "all"]] = "auto"
    """Choice of paths for a message. auto: the paths with the least expected cost, see
    docs/protocol.md; best: the best single path; all: every path."""
    connect_s: OfVehicle[Interval] = 120.0
    """Longest wait of the vehicle for its first session [s]; a server that was just started
    compiles for up to a minute."""

    @property
    def fixed_ns(self) -> int | None:
        return None if self.heartbeat_s == "auto" else seconds_to_ns(self.heartbeat_s)

    @property
    def patience_ns(self) -> int:
        """Time of silence after which the server considers a vehicle lost [ns].

        A vehicle brakes if its server is silent. A server only reserves the vehicle's number, so
        the server can wait longer, and needs only half as many heartbeats of the vehicle.
        """
        timeout_ns = seconds_to_ns(self.timeout_s)
        if self.fixed_ns is not None:
            return timeout_ns
        return max(timeout_ns, min(PATIENCE * timeout_ns, SESSION_NS))


class SimulationConfig(Section, frozen=True):
    """Computers and clocks in virtual time."""

    compute_s: OfVirtualTime[Duration] = 0.001
    """Computing time of the server for a step [s]."""
    clock_offset_s: OfVirtualTime[Annotated[float, Meta(ge=-1e9, le=1e9)]] = 0.0
    """Offset of the vehicle's clock from the server's at the start [s]."""
    clock_drift_ppm: OfVirtualTime[Annotated[float, Meta(ge=-1000, le=1000)]] = 0.0
    """Drift of the vehicle's clock, positive if faster than the server's [ppm]."""
    time_error_s: OfVirtualTime[Duration] = 0.0
    """Error of the time of day on a mission [s]: positive for vehicles with odd numbers, negative
    for even numbers and the server; 0: no time of day."""


S = TypeVar("S", bound=Section)


class Scenario(Section, frozen=True):
    """Scenario: all keys of a flight."""

    title: OfEach[str] = ""
    """Title in one line."""
    duration: OfVehicle[Annotated[float, Meta(gt=0, le=86400)]] = 60.0
    """Length of the flight [s]."""
    settle: OfVehicle[Annotated[float, Meta(ge=0, le=86400)]] = 0.0
    """Time at the start that RMSE ignores [s]; in a shorter flight, half of the flight."""
    seed: OfEach[Annotated[int, Meta(ge=0, le=2**32 - 1)]] = 1
    """Seed of all random numbers of the flight."""
    armed: Annotated[bool, Key(Owner.VEHICLE, InFlight.ARMED)] = True
    """Whether the vehicle may fly plans; if not, the vehicle brakes and holds its position."""
    model: ModelConfig = ModelConfig()
    control: ControlConfig = ControlConfig()
    reference: ReferenceConfig = ReferenceConfig()
    vehicle: VehicleConfig = VehicleConfig()
    sensor: SensorConfig = SensorConfig()
    network: NetworkConfig = NetworkConfig()
    simulation: SimulationConfig = SimulationConfig()
    link: LinkConfig = LinkConfig()

    @property
    def files(self) -> Files:
        """Files that the scenario names, with their contents."""
        return ()

    @property
    def table(self) -> bytes:
        """Content of `reference.file`, for a shape that is read from it; otherwise empty.

        Raises:
            ConfigError: the file was not read with the scenario.
        """
        file = self.reference.file
        return file_of(self.files, file).content if self.reference.shape in rooms.FROM_FILE else b""

    def sections(self) -> Iterator[Section]:
        return (each for each in msgspec.structs.astuple(self) if isinstance(each, Section))

    def section(self, kind: type[S]) -> S:
        """Optional section of the class `kind`."""
        return next(each for each in self.sections() if isinstance(each, kind))

    @property
    def paths(self) -> tuple[PathConfig, ...]:
        """Paths of the session, at least one."""
        network = self.network
        return network.paths or (PathConfig(uplink=network.uplink, downlink=network.downlink),)

    def on_path(self, index: int) -> Self:
        """Scenario with one path only. Each path except the first has a derived seed.

        Args:
            index: number of the path, from 0. The number of paths stands for the network of a
                standby server.
        """
        path = (*self.paths, self.paths[0])[index]
        network = msgspec.structs.replace(
            self.network, uplink=path.uplink, downlink=path.downlink, paths=()
        )
        seed = int(stream(self.seed, "path", index).integers(2**32)) if index else self.seed
        return msgspec.structs.replace(self, seed=seed, network=network)

    @property
    def networks(self) -> list[Self]:
        """Scenarios of the networks between a vehicle and its server: one, or one per path."""
        return [self.on_path(index) for index in range(len(self.paths))]

    @property
    def uplink(self) -> Any:
        """`netem.impairments.direction.Impairments` from server to vehicle, of the first path;
        raises GrammarError if the text is invalid.
        """
        return rooms.impairments(self.network.uplink, self.files)

    @property
    def downlink(self) -> Any:
        """Impairments from vehicle to server; see `uplink`."""
        return rooms.impairments(self.network.downlink, self.files)

    @property
    def dt_ns(self) -> int:
        return seconds_to_ns(self.control.dt)

    @property
    def steps(self) -> int:
        return max(1, round(self.duration / self.control.dt))

    @property
    def settled_s(self) -> float:
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
        return self._per_axis(self.model.gain)

    @property
    def true_gain(self) -> Array:
        return self._per_axis(self.model.gain if self.vehicle.gain == () else self.vehicle.gain)

    @property
    def true_dead_time_s(self) -> Array:
        own = self.vehicle.dead_time_s
        return self._per_axis(self.model.dead_time_s if own == () else own)

    def _per_axis(self, values: float | tuple[float, ...]) -> Array:
        return np.array(np.broadcast_to(values, self.model.axes), dtype=np.float64)

    def terms(self) -> Terms:
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
            points=digest(repr(reference.points_m).encode() if reference.points_m else b""),
            speed_mps=reference.speed_mps,
            loop=reference.loop,
            table=self._tabledigest(),
            **dict(chain.from_iterable(each.shared_terms().items() for each in self.sections())),
        )

    def make_reference(self, vehicle: int = 1) -> shapes.Reference:
        """Desired trajectory of the vehicle with this number; each vehicle has its own "target"."""
        reference = self.unallocated_reference(vehicle)
        for section in self.sections():
            reference = section.assigned(reference, vehicle)
        return reference

    def measured_reference(self, vehicle: int = 1) -> shapes.Reference:
        """Desired trajectory of a vehicle, as measured by the server; see `reference.noise_m`."""
        reference, config = self.make_reference(vehicle), self.reference
        if config.shape != "target" or not config.noise_m:
            return reference
        measured: shapes.Reference = load("skytether.shared.scenario.targets", "target").Measured(
            reference,
            stream(self.seed, "target noise", vehicle),
            dt_s=self.control.dt,
            noise_m=config.noise_m,
            agility=config.agility,
        )
        return measured

    def unallocated_reference(self, vehicle: int = 1) -> shapes.Reference:
        """Desired trajectory of a vehicle; on a mission, before goals are allocated."""
        shape, scenario = REFERENCES.one(self.reference.shape), self
        if shape.name == "target" and vehicle != 1:
            seed = int(stream(self.seed, "target", vehicle).integers(2**32))
            scenario = msgspec.structs.replace(self, seed=seed)
        reference: shapes.Reference = REFERENCES[shape.name].make(scenario, *shape.values)
        return reference.of(vehicle) if isinstance(reference, shapes.OfFleet) else reference

    def start_m(self, vehicle: int = 1) -> Array:
        """Position of a vehicle at the start [m]; shape (axes,)."""
        if self.vehicle.start_m:
            return np.array(self.vehicle.start_m)
        return self.unallocated_reference(vehicle)(np.zeros(()))[:, 0]

    @property
    def keeps_apart(self) -> bool:
        """Whether the flight is a mission, on which the server keeps vehicles apart."""
        return self.reference.shape.partition("(")[0].strip() in rooms.APART

    def _tabledigest(self) -> str:
        """Digest of `reference.file`, and of the origin of its coordinates."""
        origin = self.reference.origin
        return digest(self.table + repr(origin).encode() if self.table and origin else self.table)

    def _shape(self) -> str:
        """Shape as a term: its name; for a plug-in's shape, its text and a digest of its states."""
        shape = REFERENCES.one(self.reference.shape)
        if REFERENCES[shape.name].is_ours:
            return shape.name
        states = shapes.sampled(self.unallocated_reference(), self.model.axes)
        return f"{str(shape)[:SHAPE_CHARS]} {digest(f'{shape}'.encode() + states)}"


def digest(content: bytes) -> str:
    """Short digest of a file or text; "none" if it is empty."""
    return hashlib.blake2s(content, digest_size=8).hexdigest() if content else "none"
