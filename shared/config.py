"""One scenario: everything about a flight, from one TOML file, typed, frozen and checked once.

A scenario may say `extends = "other"` (a scenario's name, or a file beside it) and then holds only
what differs. `skytether scenarios` lists those that come with Skytether.
"""

import hashlib
import math
import re
import tomllib
import typing
from collections.abc import Mapping
from importlib import resources
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from shared import files, policy
from shared import reference as shapes
from shared.chance import stream
from shared.contradictions import contradictions
from shared.endpoint import seconds_to_ns
from shared.hint import hint
from shared.protocol import INPUTS_MAX, PAYLOAD_BYTES_MAX
from shared.terms import Terms

# Bounds of numbers lie far beyond any vehicle, and near enough that no time overflows its 63 bits
# of nanoseconds, and no product of some of them a float.
Factor = Annotated[float, Meta(ge=1e-3, le=1e3)]
"""Property of a vehicle, from a thousandth of its unit to a thousand."""
Strength = Annotated[float, Meta(ge=0, le=1e3)]
"""Property that may be missing: from nothing to a thousand of its unit."""
Speed = Annotated[float, Meta(ge=-1e3, le=1e3)]
"""Speed either way along an axis [m/s]."""
Position = Annotated[float, Meta(ge=-shapes.FAR_M, le=shapes.FAR_M)]
"""Coordinate [m]."""
Amount = Annotated[float, Meta(ge=0, le=1e9)]
"""Weight, cost or tolerance, in whatever unit."""
Duration = Annotated[float, Meta(ge=0, le=3600)]
"""Time from nothing to an hour [s]."""
Interval = Annotated[float, Meta(ge=1e-3, le=3600)]
"""Time from a millisecond to an hour [s]."""
MeanTime = Annotated[float, Meta(ge=1e-9, le=1e9)]
"""Mean of a random time [s]."""

FILE_BYTES_MAX = 1_000_000
"""Largest size of a scenario's file [B]."""
EXTENDS_MAX = 20
"""Largest number of scenarios that a scenario is laid over, each over the next."""
GIVEN_MAX = 200
"""Largest number of characters that a message repeats of what was given."""


class ConfigError(Exception):
    """The user's scenario cannot be flown; the message names file, key, given and expected."""


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of every table of a scenario."""


class ModelConfig(Section, frozen=True):
    """The UAV as both ends know it, eq. (1)-(6)."""

    axes: Literal[2, 3] = 2
    """Number of axes: 2 to fly in the plane, 3 in space."""
    tau_s: tuple[Factor, ...] = (0.84,)
    """Time constant of the velocity loop [s]: one for all axes, or one each."""
    u_max: tuple[Factor, ...] = (1.6,)
    """Largest desired velocity [m/s]: one for all axes, or one each."""
    dead_time_s: Annotated[float, Meta(ge=0, le=2)] = 0.0
    """Dead time of the vehicle that the gain of feedback is designed for [s]."""


class ControlConfig(Section, frozen=True):
    """The server's planning, eq. (5)-(16)."""

    dt: Annotated[float, Meta(ge=0.001, le=1)] = 0.05
    """Length of a step, Δt [s]."""
    horizon: Annotated[int, Meta(ge=1, le=INPUTS_MAX)] = 80
    """Number of steps planned ahead, H."""
    scheme: Literal["committed", "predictive", "dead_reckoning", "none"] = "committed"
    """Delay compensation: committed inputs, eq. (11) and (13), or none; with dead reckoning the
    server sends no plan, but the state of the desired trajectory, along which the vehicle goes
    on."""
    feedback: bool = True
    """Whether horizons say also where they lead, and how the vehicle comes back to there. A vehicle
    that can only play inputs back goes without, and wants an `input_weight` of 3, as in the
    scenario `playback`."""
    delay_bound: Duration | Literal["auto"] = "auto"
    """Longest time from making a horizon to its being in force [s]; auto: as was seen."""
    observer_s: Duration = 4.0
    """Time constant of learning steady wind and a wrong gain [s], longer where observations are
    old; 0: they are not learned, nor with the scheme "none"."""
    trigger: Annotated[str, Meta(max_length=policy.TEXT_MAX)] = "cost_gap | silence(1)"
    """Rule for sending a horizon: policies combined with & and |, as in docs/triggers.md."""
    period: Annotated[int, Meta(ge=1, le=policy.PERIOD_MAX)] = 10
    """Number of steps between two horizons of the policy `periodic`."""
    solver: Literal["exact", "osqp"] = "exact"
    """Solver of eq. (9): a Riccati active set, exact and fast, or OSQP, the reference."""
    epsilon: Amount = 3.6
    """Tolerance ε of eq. (16)."""
    decay_rate: Amount = 1.5
    """Decay rate λ of eq. (16) [1/s]."""
    cost_gap: Amount = 1.0
    """Extra cost of flying on with what was sent, above which the policy `cost_gap` sends."""
    deviation_m: Amount = 0.05
    """Distance from the plan, above which the policy `deviation` sends [m]."""
    tolerance_m: Amount = 0.1
    """Distance of the desired position from where it was expected, above which the policy
    `tolerance` sends, and from where it was sent, above which `delta` does [m]."""
    state_weight: tuple[Amount, Amount] = (7.0, 1.0)
    """Weight Q of eq. (5) on the position [1/m²] and the velocity [s²/m²] of every axis."""
    terminal_weight: tuple[Amount, Amount] = (50.0, 20.0)
    """Weight P of eq. (5) and (16) on the final position [1/m²] and velocity [s²/m²]."""
    input_weight: Annotated[float, Meta(ge=1e-9, le=1e9)] = 1.0
    """Weight R of eq. (5) on the input [s²/m²]."""
    change_weight: Amount = 0.0
    """Weight S of eq. (9) on the change against the horizon before [s²/m²]."""
    input_reference: bool = True
    """Whether R weighs u - v_ref instead of u, so that it does not ask for standing still."""

    @property
    def commits(self) -> bool:
        """Whether horizons begin with committed inputs."""
        return self.scheme == "committed"


class ReferenceConfig(Section, frozen=True):
    """The desired trajectory."""

    shape: Literal[
        "circle", "figure-eight", "square", "waypoints", "hover", "csv", "target", "live"
    ] = "circle"
    """Shape of the desired trajectory; target: a random walk that only the server sees; live: a
    point that is moved while it flies."""
    preview: Duration | Literal["all", "none"] = "all"
    """How far ahead the server may look [s]; beyond that it predicts. Of a live point it never sees
    more than the present."""
    agility: Strength = 0.3
    """Strength of the white acceleration that moves a target [m/s per √s]."""
    turn_every_s: Duration = 0.0
    """Mean time between the turns of a target [s], at which alone its velocity then changes, by as
    much as `agility` makes of that time; 0: it changes all the time."""
    radius_m: Annotated[float, Meta(ge=1e-3, le=shapes.FAR_M)] = 1.55
    """Half the width of circle, figure-eight and square, and of where a target moves [m]."""
    period_s: Annotated[float, Meta(ge=0.1, le=86400)] = 27.5
    """Time for one round of circle, figure-eight or square [s]."""
    altitude_m: Position = 0.0
    """Altitude of circle, figure-eight and square in space [m]."""
    points_m: tuple[tuple[Position, ...], ...] = ()
    """Waypoints [m], at least two; the one point to hover at; where a live point begins."""
    velocity_mps: tuple[Speed, ...] = ()
    """Velocity of a live point, where it is known [m/s]; left out: estimated from its moves."""
    speed_mps: Factor = 1.0
    """Speed between waypoints, and the largest of a target along an axis [m/s]."""
    loop: bool = False
    """Whether the waypoints are flown round and round."""
    file: str = ""
    """CSV file with the columns t, x, y (and z), relative to the scenario's own folder."""


class VehicleConfig(Section, frozen=True):
    """The simulated UAV, and what it does without fresh horizons."""

    exhausted: Literal["hold", "brake"] = "brake"
    """Answer to a horizon that has run out: hold its last input (the paper), or brake and hover."""
    brake_mps2: Factor = 2.0
    """Deceleration of the desired velocity when `brake` stops the vehicle [m/s²]."""
    slew_mps2: Factor = 50.0
    """Fastest change of the desired velocity on an axis [m/s²], unless `exhausted` is `hold`."""
    land_after_s: Duration = 10.0
    """Time of hovering with a silent server after which the vehicle lands [s]."""
    tau_s: tuple[Factor, ...] = ()
    """True time constant [s], one for all axes, or one each; left out: the model's."""
    gain: Factor = 1.0
    """Gain of the velocity loop: velocity settled at over velocity commanded."""
    dead_time_s: Annotated[float, Meta(ge=0, le=10)] = 0.0
    """Dead time before an input takes effect [s]."""
    start_m: tuple[Position, ...] = ()
    """Position at the start, at rest [m]; left out: that of the reference."""
    wind: Strength = 0.0
    """Strength of white acceleration [m/s per √s]."""
    steady_wind_mps: tuple[Speed, ...] = ()
    """Velocity that steady wind adds in the long run, for each axis [m/s]; left out: none."""
    gust_mps2: Strength = 0.0
    """Strength of gusts [m/s²]; 0 for none."""
    gust_every_s: MeanTime = 10.0
    """Mean time from the end of one gust to the next [s]."""
    gust_s: MeanTime = 1.0
    """Mean length of a gust [s]."""


class SensorConfig(Section, frozen=True):
    """What the vehicle measures of itself, and what it makes of that."""

    filter: Literal["kalman", "none"] = "kalman"
    """What makes the state that is reported and flown by: a Kalman filter, or each measurement as
    it is. Where measurements are perfect it makes no difference."""
    position_noise_m: Strength = 0.0
    """Standard deviation of the noise of a position [m]."""
    velocity_noise_mps: Strength = 0.0
    """Standard deviation of the noise of a velocity [m/s]."""
    position_bias_m: tuple[Position, ...] = ()
    """Constant error of each position, for each axis [m]; left out: none."""
    velocity_bias_mps: tuple[Speed, ...] = ()
    """Constant error of each velocity, for each axis [m/s]; left out: none."""
    position_every_s: Duration = 0.0
    """Time from one position to the next [s]; 0: one at every step."""
    velocity_every_s: Duration | Literal["never"] = 0.0
    """Time from one velocity to the next [s]; 0: one at every step; never: positions alone."""
    delay_s: Annotated[float, Meta(ge=0, le=2)] = 0.0
    """Time from measuring to having the measurement [s]."""
    process_noise: Factor = 0.1
    """Strength of the white acceleration that the filter reckons with [m/s per √s]: of wind, and of
    all in which the vehicle is unlike its model."""


class DirectionConfig(Section, frozen=True):
    """One direction of the network."""

    delay: Literal["poisson", "constant", "none"] = "poisson"
    """Law of the delay: minimum_s + slot_s · Poisson(slots_mean) (17), just minimum_s, or none."""
    minimum_s: Duration = 0.4
    """Smallest delay [s]."""
    slot_s: Duration = 0.02
    """Length of a slot of the paper's delay [s]."""
    slots_mean: Annotated[float, Meta(ge=0, le=1e6)] = 2.0
    """Mean number of slots on top of the smallest delay."""
    loss: Annotated[float, Meta(ge=0, le=1)] = 0.1
    """Share of packets that are lost."""
    burst_s: Duration = 0.0
    """Mean length of the bursts in which packets are lost [s]; 0: each is lost by itself."""

    @property
    def least_s(self) -> float:
        """Smallest delay [s]."""
        return 0.0 if self.delay == "none" else self.minimum_s

    @property
    def mean_s(self) -> float:
        """Mean delay [s]."""
        return self.least_s + (self.slot_s * self.slots_mean if self.delay == "poisson" else 0.0)


class NetworkConfig(Section, frozen=True):
    """Impairments of the network, both ways."""

    uplink: DirectionConfig = DirectionConfig()
    """Direction from server to vehicle."""
    downlink: DirectionConfig = DirectionConfig()
    """Direction from vehicle to server."""
    mtu: Annotated[int, Meta(ge=PAYLOAD_BYTES_MAX, le=65_507)] = 1472
    """Longest UDP payload that passes [B]: 1472 fill an Ethernet frame."""


class LinkConfig(Section, frozen=True):
    """Times by which a session is kept."""

    heartbeat_s: Interval = 0.1
    """Longest time that the server lets pass without a packet [s]."""
    age_max_s: Annotated[float, Meta(gt=0, le=60)] = 5.0
    """Largest age of the observation behind an input [s]; with no younger one the vehicle brakes
    and hovers, or holds its last input where `vehicle.exhausted` says so."""
    timeout_s: Interval = 1.0
    """Time of silence after which the vehicle says HELLO again, and its number is free for another
    life [s]."""
    connect_s: Interval = 15.0
    """Time that the vehicle waits for its first session before it gives up [s]."""


class SimulationConfig(Section, frozen=True):
    """Properties of the computers, which only virtual time has to be told."""

    compute_s: Duration = 0.001
    """Time that the server takes for a step [s]."""
    clock_offset_s: Annotated[float, Meta(ge=-1e9, le=1e9)] = 0.0
    """Offset of the vehicle's clock from the server's at the start [s]."""
    clock_drift_ppm: Annotated[float, Meta(ge=-1000, le=1000)] = 0.0
    """Drift: how much faster the vehicle's clock runs than the server's [ppm]."""


class Scenario(Section, frozen=True):
    """Everything about a flight."""

    title: str = ""
    """Title: what the scenario shows, in a line."""
    duration: Annotated[float, Meta(gt=0, le=86400)] = 60.0
    """Length of the flight [s]."""
    settle: Annotated[float, Meta(ge=0, le=86400)] = 0.0
    """Time at the start that RMSE leaves out [s]."""
    seed: Annotated[int, Meta(ge=0, le=2**32 - 1)] = 1
    """Seed of everything random: delays, losses, wind."""
    armed: bool = True
    """Whether plans may be flown at all; without, the vehicle stays where it is."""
    model: ModelConfig = ModelConfig()
    control: ControlConfig = ControlConfig()
    reference: ReferenceConfig = ReferenceConfig()
    vehicle: VehicleConfig = VehicleConfig()
    sensor: SensorConfig = SensorConfig()
    network: NetworkConfig = NetworkConfig()
    link: LinkConfig = LinkConfig()
    simulation: SimulationConfig = SimulationConfig()

    @property
    def dt_ns(self) -> int:
        """Length of a step [ns]."""
        return seconds_to_ns(self.control.dt)

    @property
    def steps(self) -> int:
        """Number of steps in the whole flight."""
        return max(1, round(self.duration / self.control.dt))

    @property
    def tau_s(self) -> NDArray[np.float64]:
        """The model's time constants [s]; shape (axes,)."""
        return self._per_axis(self.model.tau_s)

    @property
    def true_tau_s(self) -> NDArray[np.float64]:
        """The vehicle's time constants [s]; shape (axes,)."""
        return self._per_axis(self.vehicle.tau_s or self.model.tau_s)

    @property
    def u_max(self) -> NDArray[np.float64]:
        """Bounds of the input [m/s]; shape (axes,)."""
        return self._per_axis(self.model.u_max)

    def _per_axis(self, values: tuple[float, ...]) -> NDArray[np.float64]:
        return np.array(np.broadcast_to(values, self.model.axes), dtype=np.float64)

    def terms(self) -> Terms:
        """Terms that both ends must agree on before a flight."""
        control, vehicle, reference = self.control, self.vehicle, self.reference
        table = shapes.read(Path(reference.file)) if reference.shape == "csv" else b""
        return Terms(
            dt_ns=self.dt_ns,
            horizon=control.horizon,
            axes=self.model.axes,
            tau_s=tuple(self.tau_s.tolist()),
            u_max=tuple(self.u_max.tolist()),
            scheme=control.scheme,
            feedback=control.feedback,
            exhausted=vehicle.exhausted,
            brake_mps2=vehicle.brake_mps2,
            heartbeat_s=self.link.heartbeat_s,
            age_max_s=self.link.age_max_s,
            shape=reference.shape,
            radius_m=reference.radius_m,
            period_s=reference.period_s,
            altitude_m=reference.altitude_m,
            points=_digest(repr(reference.points_m).encode() if reference.points_m else b""),
            speed_mps=reference.speed_mps,
            loop=reference.loop,
            table=_digest(table),
        )

    def make_reference(self) -> shapes.Reference:  # noqa: PLR0911 - one for each shape
        """The desired trajectory."""
        config, axes = self.reference, self.model.axes
        points = np.array(config.points_m, dtype=np.float64)
        match config.shape:
            case "circle":
                return shapes.circle(config.radius_m, config.period_s, axes, config.altitude_m)
            case "figure-eight":
                return shapes.figure_eight(
                    config.radius_m, config.period_s, axes, config.altitude_m
                )
            case "square":
                return shapes.square(config.radius_m, config.period_s, axes, config.altitude_m)
            case "waypoints":
                return shapes.waypoints(points, config.speed_mps, loop=config.loop)
            case "hover":
                return shapes.hover(points[0])
            case "csv":
                return shapes.from_csv(Path(config.file), axes)
            case "target":
                return shapes.target(
                    stream(self.seed, "target"),
                    axes,
                    agility=config.agility,
                    speed_mps=config.speed_mps,
                    radius_m=config.radius_m,
                    turn_every_s=config.turn_every_s,
                )
            case "live":
                return shapes.hover(points[0] if len(points) else np.zeros(axes))


def _digest(content: bytes) -> str:
    """A short text that differs where the content does, "none" of nothing."""
    return hashlib.blake2s(content, digest_size=8).hexdigest() if content else "none"


COMPARED = "compare"
"""The file of the scenarios that `skytether compare` flies."""


def names(file: str = "") -> list[str]:
    """Names of the scenarios that come with Skytether, or of those in a file of scenarios.

    Args:
        file: COMPARED, or the path of a file that holds a scenario in each of its tables.

    Raises:
        ConfigError: the file cannot be read.
    """
    if file:
        return [f"{file}/{name}" for name in _toml(_path(file), file)]
    files = (each.name for each in resources.files("scenarios").iterdir())
    known = {name.removesuffix(".toml") for name in files if name.endswith(".toml")}
    return sorted(known - {COMPARED})


def load(name: str) -> Scenario:
    """Scenario by its name, or from a file by its path (anything that ends in .toml).

    Behind the name or path of a file of scenarios stands the table: `compare/paper-event-gusts`.

    Raises:
        ConfigError: it does not exist, or something in it is wrong.
    """
    try:
        return check(_read(name), name)
    except RecursionError:
        raise ConfigError(f"{name}: nested too deeply") from None


def check(raw: Mapping[str, Any], source: str = "", *, known: Scenario | None = None) -> Scenario:
    """The scenario in a table of plain values, every one of them checked.

    Args:
        source: the file or command line they come from, for the message.
        known: a scenario that was checked before: where its trajectory is the same, no file of it
            is read again.

    Raises:
        ConfigError: the first thing that is wrong.
    """
    where = f"{source}: " if source else ""
    try:
        scenario = msgspec.convert(raw, Scenario)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}{_explain(str(error), raw)}") from None
    wrong = chain(_infinite(to_table(scenario)), contradictions(scenario, known))
    for key, given, expected in wrong:
        raise ConfigError(f"{where}{key}: got {_short(str(given))}, expected {expected}")
    return scenario


def to_table(scenario: Scenario) -> dict[str, Any]:
    """The plain values of a scenario, from which `check` makes it again."""
    table: dict[str, Any] = msgspec.to_builtins(scenario)
    return table


def to_toml(scenario: Scenario) -> bytes:
    """The scenario as a file that `load` reads."""
    return msgspec.toml.encode(scenario)


def _read(name: str, seen: Mapping[tuple[Path, str], str] = MappingProxyType({})) -> dict[str, Any]:
    """The raw table of a scenario, laid over those that it extends; `seen` extend it in turn."""
    file, _, entry = name.rpartition("/")
    if name.endswith(".toml") or name in names():
        file, entry = name, ""
    elif not (entry and (file == COMPARED or file.endswith(".toml"))):
        raise ConfigError(f"{name}: no such scenario; {hint(name, names())}")
    path = _path(file)
    raw = _toml(path, file)
    if entry:
        if not isinstance(raw.get(entry), dict):
            raise ConfigError(f"{name}: no such scenario; {hint(entry, raw)}")
        raw = raw[entry]
    if (path, entry) in seen:
        circle = " → ".join([*seen.values(), name])
        raise ConfigError(f"{seen[path, entry]}: extends: got a circle of {circle}")
    if len(seen) > EXTENDS_MAX:
        raise ConfigError(f"{name}: extends: got a chain of more than {EXTENDS_MAX} scenarios")
    table = raw.get("reference")
    if isinstance(table, dict) and isinstance(table.get("file"), str) and table["file"]:
        table["file"] = str((path.parent / table["file"]).absolute())
    base = raw.pop("extends", None)
    if base is None:
        return raw
    if not isinstance(base, str):
        raise ConfigError(f"{name}: extends: got {base!r}, expected the name of a scenario")
    if ".toml" in base:
        base = str(path.parent / base)
    return _overlay(_read(base, {**seen, (path, entry): name}), raw)


def _path(file: str) -> Path:
    """Where a file is, by its path or by the name of one that comes with Skytether."""
    if not file.endswith(".toml"):
        return Path(str(resources.files("scenarios") / f"{file}.toml"))
    try:
        return Path(file).resolve()
    except (ValueError, OSError, RuntimeError) as error:  # a zero byte, or a circle of links
        raise ConfigError(f"{file}: cannot be read: {error}") from None


def _toml(path: Path, file: str) -> dict[str, Any]:
    """The raw table of a whole file, which the user calls `file`."""
    try:
        return tomllib.loads(files.read(path, FILE_BYTES_MAX).decode())
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from None
    except RecursionError:
        raise ConfigError(f"{file}: no valid TOML: nested too deeply") from None
    except ValueError as error:
        raise ConfigError(f"{file}: no valid TOML: {error}") from None


def _overlay(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        both = isinstance(old, dict) and isinstance(value, dict)
        merged[key] = _overlay(old, value) if both else value  # type: ignore[arg-type]
    return merged


_PLAIN = {
    "Number out of range": "a number that is not as large",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "str": "a text",
    "array": "a list",
    "object": "a table",
}
"""Words of msgspec's messages, and what stands for them in ours."""

_ERROR = re.compile(r"(?P<what>.*?)(?: - at `\$\.?(?P<path>[^`]*)`)?", re.DOTALL)


def _explain(message: str, raw: Mapping[str, Any]) -> str:
    """Message of msgspec, put as `key: got …, expected …`."""
    found = _ERROR.fullmatch(message)
    assert found is not None
    what, path = found["what"], found["path"] or ""
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", what, re.DOTALL)
    section, given = Scenario, raw
    for part in filter(None, path.split(".")):
        key, *index = part.replace("]", "").split("[")
        given = given[key] if isinstance(given, Mapping) else given
        for digits in index:
            given = given[int(digits)] if digits.isdigit() else given
        section = typing.get_type_hints(section).get(key, section)
    if unknown:
        prefix = f"{path}." if path else ""
        known = hint(unknown[1], section.__struct_fields__)
        return f"{prefix}{unknown[1]}: no such key; {known}"
    if what.startswith("Invalid enum value") or " | " in what:
        return f"{path}: got {_written(given)}, expected {_choices(section)}"
    expected = what.removeprefix("Expected ").split(", got ")[0].replace("`", "")
    for theirs, ours in _PLAIN.items():
        expected = re.sub(rf"^{theirs}\b", ours, expected)
    return f"{path or 'the scenario'}: got {_written(given)}, expected {expected}"


def _written(given: object) -> str:
    """A value as Python writes it, as far as a line has room for it."""
    try:
        return _short(repr(given))
    except ValueError:  # Python writes no number of more than 4300 digits
        return "a number of thousands of digits"


def _short(given: str) -> str:
    """What was given, as far as a line has room for it."""
    return given if len(given) <= GIVEN_MAX else f"{given[:GIVEN_MAX]}…"


def _choices(kind: Any) -> str:
    """Values that are allowed: the words of a Literal, or one of several types."""
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        return " or ".join(map(repr, parts))
    return " or ".join(map(_choices, parts)) if parts else _PLAIN[kind.__name__]


def _infinite(value: object, key: str = "") -> typing.Iterator[tuple[str, object, str]]:
    """Numbers that TOML knows and no flight has a use for: key, given, expected."""
    if isinstance(value, float) and not math.isfinite(value):
        yield key, value, "a finite number"
    elif isinstance(value, dict):
        for name, inner in value.items():
            yield from _infinite(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            yield from _infinite(inner, f"{key}[{index}]")
