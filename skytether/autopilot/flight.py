"""Flight of a simulated autopilot: arming, modes, the motion in each mode, and failsafes.

ArduCopter and PX4 share this module; their differences are in `ardupilot.py` and `px4.py`.
Positions are x north, y east, altitude up, relative to the start. Times are on the autopilot's own
clock [ns], which begins at 0.
"""

from abc import ABC, abstractmethod
from collections import deque
from enum import Enum, IntEnum
from math import hypot, sqrt
from typing import NamedTuple

import numpy as np

from skytether.autopilot.flavours import FlightMode, Parameters, SimulatedFlavour
from skytether.mavlink.dialect import dialect
from skytether.quadrotor.loops import Gains
from skytether.quadrotor.quadrotor import Quadrotor
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.law.model import Array

TICK_NS = 5_000_000
"""Period of the control loops [ns]."""
LANDED_NS = SECOND_NS
"""Time at rest after which the vehicle counts as landed [ns]."""
THERE_M = 0.1
"""Distance within which a target counts as reached [m]."""
STILL_MPS = 0.1
"""Speed below which the vehicle counts as at rest [m/s]."""

WANDER_NS = 3 * SECOND_NS
"""Correlation time of the error of the velocity estimate [ns]."""
WANDER_TIME_S = 0.6
"""Ratio of the position estimate's error to the velocity estimate's error [s]."""
FIX_TICKS = 40
"""Age of a GPS fix when it is reported [ticks]."""
PULL, PULL_MPS, PULL_FADES = 0.45, 0.35, 0.8
"""Gains with which the estimate follows a shift of the receiver's position: from position error to
the rate of the position [1/s] and of the velocity [1/s²], and decay of the velocity error [1/s].
They are fitted to ArduCopter 4.5.6 after a shift of 3 m."""
BLIND_MPS2 = 0.03
"""Acceleration error on each axis, with which the estimate drifts without a fix [m/s²]."""

Vector = tuple[float, float, float]
REST: Vector = (0.0, 0.0, 0.0)


class Result(IntEnum):
    ACCEPTED = dialect.MAV_RESULT_ACCEPTED
    REJECTED = dialect.MAV_RESULT_TEMPORARILY_REJECTED
    DENIED = dialect.MAV_RESULT_DENIED
    UNSUPPORTED = dialect.MAV_RESULT_UNSUPPORTED
    FAILED = dialect.MAV_RESULT_FAILED


class Severity(IntEnum):
    CRITICAL = dialect.MAV_SEVERITY_CRITICAL
    WARNING = dialect.MAV_SEVERITY_WARNING
    INFO = dialect.MAV_SEVERITY_INFO


class Landed(Enum):
    ON_GROUND = dialect.MAV_LANDED_STATE_ON_GROUND
    IN_AIR = dialect.MAV_LANDED_STATE_IN_AIR
    TAKEOFF = dialect.MAV_LANDED_STATE_TAKEOFF
    LANDING = dialect.MAV_LANDED_STATE_LANDING


class CompanionSetpoint(NamedTuple):
    velocity: Vector
    """Velocity [m/s]: the target, or the feed-forward velocity if a position is set."""
    position: Vector | None
    """Position [m]; None if only the velocity is set."""
    came_ns: int


class OwnSpeeds(NamedTuple):
    """Limits and gains of motions that the autopilot plans itself, without set-points."""

    speed: float
    up: float
    down: float
    land: float
    p: float
    """Gain from horizontal distance to speed [1/s]."""
    p_up: float
    """Gain from altitude error to speed [1/s]."""
    acceleration: float
    """Horizontal deceleration towards a point [m/s²]."""
    acceleration_up: float
    """Vertical deceleration towards an altitude [m/s²]."""


class PilotedVehicle(ABC):
    """Vehicle with an autopilot.

    Args:
        quadrotor: body of the vehicle, standing on the ground at the origin.
        ready_s: time from the start until the vehicle may be armed.
        noise: random generator of estimation errors.
    """

    low = 0.15
    """Charge, from 0 to 1, below which the low-battery failsafe acts."""

    def __init__(
        self,
        flavour: SimulatedFlavour,
        quadrotor: Quadrotor,
        ready_s: float,
        noise: np.random.Generator,
    ) -> None:
        self.flavour, self.quadrotor = flavour, quadrotor
        self.parameters: Parameters = dict(flavour.parameters)
        self.number = flavour.first
        self.armed = False
        self.armed_ns: int | None = None
        self.flying = False
        self.estimates = True
        """Whether the position estimate works. Until `ready_s` has passed, it is not valid."""
        self.drift: Vector = REST
        """True minus estimated velocity, as after a failure of the accelerometers [m/s]."""
        self._wander, self._noise = np.zeros(3), noise
        """Random part of the true velocity minus the estimated velocity [m/s]."""
        self.displaced: Vector = REST
        self.fixes = True
        """Whether the receiver has a fix."""
        self.shift: Vector = REST
        """Error of the GPS receiver's position, for example until a correction arrives [m]."""
        self._pulled, self._pull = np.zeros(3), np.zeros(3)
        """Errors of the position [m] and velocity estimates [m/s] caused by the receiver."""
        self._blind_ns: int | None = None
        """Time of the last fix [ns]; None while the receiver has a fix."""
        self._past: deque[tuple[Array, Array]] = deque(maxlen=FIX_TICKS)
        """True positions [m] and velocities [m/s] at the newest ticks."""
        self.said: list[tuple[Severity, str]] = []
        self.now_ns = 0
        self.station_ns: int | None = None
        """Time of the ground station's newest heartbeat [ns]; None before the first heartbeat."""
        self._ready_ns = seconds_to_ns(ready_s)
        self._setpoint: CompanionSetpoint | None = None
        self._climb: float | None = None
        """Target altitude of a climb [m]; None while not climbing."""
        self._climb_ns = 0
        self._held: Vector | None = None
        """Point that the vehicle holds after coming to rest."""
        self._stood_ns = 0
        self._landing = False
        """Whether a flight home has reached its landing phase."""
        self._announced: set[str] = set()
        """Failsafes that were triggered in this flight."""
        quadrotor.on = False

    @property
    def mode(self) -> FlightMode:
        return self.flavour.modes[self.number][1]

    @property
    def mode_name(self) -> str:
        return self.flavour.modes[self.number][0]

    @property
    def ready(self) -> bool:
        return self.estimates and self.now_ns >= self._ready_ns

    @property
    def landed(self) -> Landed:
        if not self.flying:
            return Landed.ON_GROUND
        if self._climb is not None:
            return Landed.TAKEOFF
        landing = self.mode is FlightMode.LAND or (self.mode is FlightMode.RETURN and self._landing)
        return Landed.LANDING if landing else Landed.IN_AIR

    def say(self, text: str, severity: Severity = Severity.INFO) -> None:
        self.said.append((severity, text))

    # Commands

    def arm(self) -> Result:
        """Arm, unless a check forbids it."""
        if self.armed:
            return Result.ACCEPTED
        why = self.why_not_armed()
        if why:
            self.say(why, Severity.CRITICAL)
            return self.refusal
        self.armed, self._announced = True, set()
        self._stood_ns = self.now_ns
        if self.armed_ns is None:
            self.armed_ns = self.now_ns
        self.say(f"{self.arming_word} motors" if self.arming_word else "Armed by external command")
        return Result.ACCEPTED

    def disarm(self, *, force: bool = False) -> Result:
        """Disarm. In the air the vehicle disarms only with `force`."""
        if self.flying and not force:
            return self.refusal
        if self.armed:
            self.say("Disarming motors" if self.arming_word else "Disarmed by external command")
        self.armed = self.flying = False
        self._climb = None
        return Result.ACCEPTED

    def switch(self, number: int) -> Result:
        if number not in self.flavour.modes:
            return Result.DENIED
        name, kind = self.flavour.modes[number]
        if (
            kind in (FlightMode.GUIDED, FlightMode.TAKEOFF, FlightMode.RETURN, FlightMode.HOLD)
            and not self.ready
        ):
            self.say(f"FlightMode change to {name} failed: requires position", Severity.CRITICAL)
            return self.refusal
        if kind is FlightMode.GUIDED and (why := self.why_not_guided()):
            self.say(why, Severity.CRITICAL)
            return Result.REJECTED
        self.enter(number)
        return Result.ACCEPTED

    def enter(self, number: int) -> None:
        if number == self.number:
            return
        self.number = number
        self._climb = self._held = None
        self._landing = False
        if self.flavour.modes[number][1] is FlightMode.GUIDED:
            self.forget()
        if self.mode in (FlightMode.LAND, FlightMode.RETURN) and not self.flying:
            self.disarm()

    def set(self, name: str, value: float) -> None:
        self.parameters[name] = value
        self.quadrotor.gains = self.gains()

    def act(self, mode: FlightMode, why: str, severity: Severity = Severity.CRITICAL) -> None:
        """Trigger a failsafe: announce the reason, and enter a mode."""
        self.say(why, severity)
        self.enter(self.flavour.number(mode))

    def take_off(self, altitude: float) -> Result:
        """Take off and climb to an altitude; the vehicle must be armed and on the ground.

        Args:
            altitude: altitude in the autopilot's convention, see `altitude_of` [m].
        """
        to = self.altitude_of(altitude)
        if not self.armed or self.flying or to is None or to <= 0.0 or not self.enter_takeoff():
            return self.refusal
        self._climb, self._climb_ns = to, self.now_ns + seconds_to_ns(self.flavour.spool_s)
        return Result.ACCEPTED

    def want(self, velocity: Vector, position: Vector | None) -> None:
        if not self.takes_setpoints():
            return
        if self.mode is FlightMode.GUIDED:
            self._climb = self._held = None  # a set-point ends a climb, as in ArduCopter
        self._setpoint = CompanionSetpoint(velocity, position, self.now_ns)

    def forget(self) -> None:
        """Discard the companion computer's earlier set-points."""
        self._setpoint = None

    # Differences between flavours

    refusal: Result
    """Result of a command that cannot be executed now."""
    arming_word: str
    """Word before "motors" in the text sent at arming; empty if the text has no such word."""

    @abstractmethod
    def why_not_armed(self) -> str:
        """Reason why arming is refused; empty if it is allowed."""

    @abstractmethod
    def why_not_guided(self) -> str:
        """Reason why GUIDED is refused; empty if it is allowed."""

    @abstractmethod
    def mode_number(self, main: int, sub: int) -> int:
        """Number of the mode in heartbeats, from a command's main mode and sub mode."""

    @abstractmethod
    def takes_setpoints(self) -> bool:
        """Whether set-points are followed in the present mode."""

    @abstractmethod
    def altitude_of(self, altitude: float) -> float | None:
        """Altitude above home for a commanded altitude [m]; None if the command is invalid."""

    @abstractmethod
    def enter_takeoff(self) -> bool:
        """Enter the mode in which the vehicle climbs; returns whether this is possible."""

    @abstractmethod
    def limits(self) -> OwnSpeeds: ...

    @abstractmethod
    def gains(self) -> Gains: ...

    @abstractmethod
    def is_station(self, system: int, kind: int) -> bool:
        """Whether a system of this id and MAV_TYPE is the vehicle's ground station."""

    @abstractmethod
    def return_altitude(self, distance: float) -> float:
        """Altitude of the flight home, from the distance to home [both m]."""

    @abstractmethod
    def silence(self, setpoint: CompanionSetpoint) -> bool:
        """Whether set-points have stopped; this triggers the failsafe that parameters select."""

    @abstractmethod
    def watch(self) -> None:
        """Check the failsafes of battery, ground station and fence."""

    @abstractmethod
    def idle_s(self) -> float:
        """Time on the ground until the vehicle disarms [s]; shorter after a landing."""

    # Motion

    def tick(self) -> None:
        self.now_ns += TICK_NS
        if self.armed:
            if self.flying:
                if not self.estimates and self.once("estimate"):
                    self.act(FlightMode.LAND, "EKF Failsafe: position estimate lost, landing")
                self.watch()
            velocity = self._guide()
            self._lift(velocity)
        else:
            velocity = REST
        self.quadrotor.on = self.armed and self.flying
        self._stray()
        self._follow_receiver()
        beside = self.drift + self._wander - self._pull if self.flying else np.zeros(3)
        self.quadrotor.advance(velocity + beside, TICK_NS)
        if self.armed:
            self._settle(velocity)

    def once(self, failsafe: str) -> bool:
        """Note that a failsafe is triggered; returns whether it is the first time in the flight."""
        new = failsafe not in self._announced
        self._announced.add(failsafe)
        return new

    def _lift(self, velocity: Vector) -> None:
        if self.flying:
            return
        climbs = self._climb is not None and self.now_ns >= self._climb_ns
        if climbs or (self.lifts_off_by_setpoint and velocity[2] > 0.0):
            self.flying = True

    lifts_off_by_setpoint: bool
    """Whether a set-point with an upward velocity makes the vehicle take off."""

    def _settle(self, velocity: Vector) -> None:
        """Detect a landing, and disarm after `idle_s` on the ground."""
        if not self.quadrotor.stands() or velocity[2] > 0.0 or self._climb is not None:
            self._stood_ns = self.now_ns
        elif self.flying and self.now_ns - self._stood_ns >= LANDED_NS:
            self.flying = False
        elif not self.flying and self.now_ns - self._stood_ns >= seconds_to_ns(self.idle_s()):
            self.disarm()

    def _guide(self) -> Vector:
        if self._climb is not None:
            return self._climbing(self._climb)
        match self.mode:
            case FlightMode.GUIDED:
                return self._guided()
            case FlightMode.RETURN:
                return self._returning()
            case FlightMode.LAND:
                return self._descending()
            case _:
                return self._staying()

    def _climbing(self, altitude: float) -> Vector:
        if self.now_ns < self._climb_ns:
            return REST
        x, y, z = self.position()
        if altitude - z < THERE_M:
            self._climb, self._held = None, (x, y, altitude)
            if self.mode is FlightMode.TAKEOFF:
                self.number = self.flavour.number(FlightMode.HOLD)
        return self._toward((*self._stay_xy(), altitude))

    def _stay_xy(self) -> tuple[float, float]:
        """Horizontal position held during a climb or a landing."""
        if self._held is None:
            self._held = self.quadrotor_wants()
        return self._held[:2]

    def _guided(self) -> Vector:
        setpoint = self._setpoint
        if setpoint is None:
            return self._staying()
        if self.silence(setpoint):
            if self.mode is not FlightMode.GUIDED:
                return self._guide()
            # A velocity expires when set-points stop; a position is still approached.
            return REST if setpoint.position is None else self._toward(setpoint.position)
        if setpoint.position is None:
            return setpoint.velocity
        return self._toward(setpoint.position, setpoint.velocity)

    def _staying(self) -> Vector:
        """Velocity command that brakes, then holds the position at which the vehicle stopped."""
        if self._held is None:
            if hypot(*self.velocity()) > STILL_MPS:
                return REST
            self._held = self.quadrotor_wants()
        return self._toward(self._held)

    def _returning(self) -> Vector:
        x, y, z = self.position()
        distance = hypot(x, y)
        if self._landing:
            return self._descending()
        if distance < 0.5:
            self._landing, self._held = True, (0.0, 0.0, z)
        high = max(self.return_altitude(distance), z)
        if self._held is None:
            self._held = (x, y, high)
        if z < self._held[2] - 0.5:
            return self._toward(self._held)
        return self._toward((0.0, 0.0, self._held[2]))

    def _descending(self) -> Vector:
        limits = self.limits()
        _, _, z = self.position()
        x, y, _ = self._toward((*self._stay_xy(), z))
        return x, y, -(limits.land if z < 10.0 else limits.down)

    def _toward(self, point: Vector, velocity: Vector = REST) -> Vector:
        """Velocity towards a point, slower near the point, plus a feed-forward velocity."""
        limits = self.limits()
        x, y, z = (to - now for to, now in zip(point, self.quadrotor_wants(), strict=True))
        distance = hypot(x, y)
        speed = min(limits.speed, _approach(distance, limits.p, limits.acceleration))
        share = speed / distance if distance > 0.0 else 0.0
        up = _approach(abs(z), limits.p_up, limits.acceleration_up)
        up = min(up, limits.up) if z > 0.0 else -min(up, limits.down)
        return share * x + velocity[0], share * y + velocity[1], up + velocity[2]

    # State

    def position(self) -> Vector:
        """True position [m]."""
        x, y, z = self.quadrotor.position().tolist()
        return x, y, z

    def velocity(self) -> Vector:
        """Estimated velocity [m/s]."""
        x, y, z = (self.quadrotor.velocity() - self.drift - self._wander + self._pull).tolist()
        return x, y, z

    def estimate(self) -> Vector:
        """Estimated position [m]."""
        lag = WANDER_TIME_S * self._wander
        x, y, z = (self.quadrotor.position() + self.displaced - lag + self._pulled).tolist()
        return x, y, z

    def _stray(self) -> None:
        """Advance the error of the velocity estimate by a tick: a Gauss-Markov process."""
        if self.flying and self.flavour.wander_mps:
            share = TICK_NS / WANDER_NS
            drawn = sqrt(2.0 * share) * self._noise.standard_normal(3)
            self._wander += self.flavour.wander_mps * drawn - share * self._wander
        else:
            self._wander[:] = 0.0

    def _follow_receiver(self) -> None:
        """Advance the estimate's errors that come from the receiver by one tick."""
        self._past.append((self.quadrotor.position(), self.quadrotor.velocity()))
        dt = TICK_NS / SECOND_NS
        if not self.fixes:
            self._blind_ns = self.now_ns if self._blind_ns is None else self._blind_ns
            if self.now_ns - self._blind_ns >= seconds_to_ns(self.flavour.blind_s):
                self.estimates = False
            self._pulled += dt * self._pull
            self._pull += dt * BLIND_MPS2
            return
        if self._blind_ns is not None:
            self._blind_ns, self.estimates = None, True
        if self.shift is not REST or self._pulled.any():
            off = self.shift - self._pulled
            self._pulled += dt * (self._pull + PULL * off)
            self._pull += dt * (PULL_MPS * off - PULL_FADES * self._pull)

    def received(self) -> tuple[Vector, Vector]:
        """Position [m] and velocity [m/s] of the newest fix."""
        position, velocity = self._past[0] if self._past else (np.zeros(3), np.zeros(3))
        x, y, z = (position + self.displaced + self.shift).tolist()
        north, east, up = velocity.tolist()
        return (x, y, z), (north, east, up)

    def quadrotor_wants(self) -> Vector:
        """Position that the control loops track [m], see `Quadrotor.wanted_position`."""
        x, y, z = self.quadrotor.wanted_position().tolist()
        return x, y, z


def _approach(distance: float, p: float, acceleration: float) -> float:
    """Speed towards a target [m/s]: proportional to the distance if near, else to its root."""
    near = acceleration / (p * p)
    if distance <= near:
        return p * distance
    return sqrt(2.0 * acceleration * (distance - 0.5 * near))
