"""Checks of the safety invariants at every step of every vehicle in `fuzz.torture`.

A `WatchedLife` wraps the link of one run of a client and receives the client's record, so it sees
every message that the vehicle accepts and every input that it flies. A `Gatekeeper` wraps the gate
of one run of the server. A `Ledger` lists all messages that were sent, to check that no others are
accepted. Deadlines of the vehicle are counted in its own steps, because a frozen vehicle cannot
act; all others in virtual time. A "life" is one run of an endpoint, from start to restart.
"""

import math
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgpack
import numpy as np

from fuzz.torture.courses import Course, FollowedCourse, PlannedCourse
from skytether.client.failsafe import GOOD_NS, STALL_NS, TRANSITIONS
from skytether.client.link import ClientLink
from skytether.client.pilot import LAND_MPS
from skytether.client.standby.leadership import ASK_SHARE
from skytether.server.gate import Gate, GateCall, ReplyPath
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import EVENTS_MAX, Datagram
from skytether.shared.law.model import ALTITUDE, Array
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.gain import regulator
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Recorder, client_columns
from skytether.shared.wire.framing import split
from skytether.shared.wire.lead import Lead, decode_led
from skytether.shared.wire.protocol import NO_HORIZON, Horizon, Mode, Trajectory, decode, kind_of

WELCOME, OBSERVATION, HORIZON, HEARTBEAT, TRAJECTORY, LEAD = 2, 3, 4, 5, 7, 10
"""Message types on the wire, see `shared.wire.protocol`."""
ONCE = frozenset({OBSERVATION, HORIZON, HEARTBEAT, TRAJECTORY})
"""Message types of which each message is unique, so it may be accepted at most once."""
REMEMBERED = 8192
"""Number of newest messages of a direction that are stored; more than can be in flight."""
STEPS_REMEMBERED = 4096
"""Number of newest steps of a client's run whose times are stored."""
HORIZONS_MAX = 1024
ROUNDING = 1e-6
"""Rounding tolerance of a speed [m/s], because horizons are sent as float32."""
MARGIN_M = 2.0
"""Margin of the position's bound for wind and the vehicle's dynamics [m]."""
FLYING = (Mode.TRACK, Mode.COAST)


class Violation(Exception):
    def __init__(self, invariant: str, what: str) -> None:
        super().__init__(f"{invariant}: {what}")
        self.invariant = invariant


class Ledger:
    """Messages of one direction: the run of the process that sent each, and how often it was sent
    and accepted.
    """

    def __init__(self) -> None:
        self._sealed: OrderedDict[tuple[int, bytes], list[int]] = OrderedDict()
        """Sender's run, times sent and times accepted, by vehicle and message."""

    def seal(self, vehicle: int, payload: bytes, life: int) -> None:
        entry = self._sealed.setdefault((vehicle, payload), [life, 0, 0])
        # A sender may send the same bytes more than once, for example CLOSE.
        entry[1] += 1
        # A message that arrives after its removal here would count as forged.
        if len(self._sealed) > REMEMBERED:
            self._sealed.popitem(last=False)

    def believe(self, vehicle: int, payload: bytes, kind: int | None) -> None:
        """Count an accepted message; raises Violation if it was not sent, or was accepted too
        often.
        """
        entry = self._sealed.get((vehicle, payload))
        if entry is None:
            raise Violation("authentic", f"a message of type {kind} was accepted but never sent")
        entry[2] += 1
        if kind in ONCE and entry[2] > entry[1]:
            raise Violation("once", f"a message of type {kind} was accepted again")

    def life(self, vehicle: int, payload: bytes) -> int:
        """Number of the sender's run that sent a message, or -1 if it was not sent."""
        return self._sealed.get((vehicle, payload), (-1,))[0]


class Gatekeeper:
    """Wrapper around the real gate of one run of the server.

    `up` and `down` are the ledgers of the server's and of the vehicles' messages.
    """

    def __init__(self, gate: Gate, life: int, up: Ledger, down: Ledger) -> None:
        self.gate = gate
        self._life = life
        self._up, self._down = up, down

    def open(self, datagram: Datagram, *, now_ns: int) -> GateCall | None:
        """Open a message as `Gate` does; raises Violation if no vehicle has sent the message."""
        call = self.gate.open(datagram, now_ns=now_ns)
        if call is None:
            return None
        assert call.vehicle is not None
        self._down.believe(call.vehicle, call.payload, kind_of(split(call.payload)[1]))
        return call._replace(line=_Noted(call.line, call.vehicle, self._life, self._up))

    def repeated(self, datagram: Datagram) -> int | None:
        return self.gate.repeated(datagram)

    def admit(self, call: GateCall, *, now_ns: int) -> None:
        assert isinstance(call.line, _Noted)
        self.gate.admit(call._replace(line=call.line.inner), now_ns=now_ns)

    def outbox(self) -> list[Datagram]:
        return self.gate.outbox()


class _Noted:
    """Wrapper around a reply path that enters all messages into the ledger."""

    __slots__ = ("_life", "_up", "_vehicle", "inner")

    def __init__(self, line: ReplyPath, vehicle: int, life: int, up: Ledger) -> None:
        self.inner = line
        self._vehicle, self._life, self._up = vehicle, life, up

    def seal(self, payload: bytes) -> bytes:
        self._up.seal(self._vehicle, payload, self._life)
        return self.inner.seal(payload)


class WatchedLink:
    """Wrapper around the real link of one run of a client to one server."""

    def __init__(self, life: "WatchedLife", link: ClientLink) -> None:
        self.secure, self.hello_ns = link.secure, link.hello_ns
        self._life, self._link = life, link
        self._adopted_ns = 0
        """Time at which the newest keys were adopted [ns; vehicle's clock]."""
        self._welcome: tuple[int, int] | None = None
        """Session of the newest WELCOME that was opened, and number of the server's run."""
        self.session: tuple[int, int] | None = None
        """Session that was adopted, and number of the server's run."""

    def hello(self, payload: bytes, *, now_ns: int) -> bytes:
        self._life.note_sent(payload)
        return self._link.hello(payload, now_ns=now_ns)

    def seal(self, payload: bytes) -> bytes:
        self._life.note_sent(payload)
        return self._link.seal(payload)

    def open(self, datagram: bytes, *, now_ns: int) -> bytes | None:
        """Open a message as `ClientLink` does; raises Violation if no server has sent it."""
        payload = self._link.open(datagram, now_ns=now_ns)
        if payload is None:
            return None
        kind = kind_of(split(payload)[1])
        session, life = _session(payload), self._life.server_of(payload, kind)
        if kind == WELCOME:
            self._welcome = (session, life)
        elif self.session is not None and session == self.session[0]:
            self._life.hear((session, life, payload) if kind in (HORIZON, TRAJECTORY) else None)
        return payload

    def outbox(self) -> list[bytes]:
        return self._link.outbox()

    def adopt(self, *, now_ns: int) -> None:
        self._link.adopt(now_ns=now_ns)
        self._adopted_ns = now_ns
        assert self._welcome is not None
        # After a restart of the server, the link must be good for a second again.
        if self.session is None or self._welcome[1] != self.session[1]:
            self._life.lose()
        self.session = self._welcome
        self._life.hear()

    def wants_hello(self, now_ns: int) -> bool:
        is_old = self.session is not None and now_ns - self._adopted_ns >= self._life.rekey_ns
        return is_old or self._link.wants_hello(now_ns)


class WatchedLife(Recorder):
    """Check of one run of a client: of its links, and of its record.

    Args:
        number: number of this run.
        up, down: ledgers of the server's and of the vehicles' messages.
        clock: returns the time of the virtual world [ns].
        overdue: returns whether all faults ended so long ago that the vehicle must fly.
        rekey_ns: time after which the vehicle asks for new keys, if the link does not ask earlier.
        drifted_m: distance that the vehicle may have flown while frozen, in earlier runs [m].
    """

    def __init__(  # noqa: PLR0915 - a docstring counts for a statement
        self,
        links: Sequence[ClientLink],
        scenario: Scenario,
        *,
        vehicle: int,
        number: int,
        up: Ledger,
        down: Ledger,
        clock: Callable[[], int],
        overdue: Callable[[], bool],
        rekey_ns: int,
        drifted_m: float,
    ) -> None:
        super().__init__(client_columns(scenario.model.axes))
        self.links = [WatchedLink(self, each) for each in links]
        """Links to the server, and to the standby server if there is one."""
        self.vehicle, self._number = vehicle, number
        self._up, self._down = up, down
        self._clock, self._overdue, self.rekey_ns = clock, overdue, rekey_ns
        self._terms, self._dt_ns = scenario.terms(), scenario.dt_ns
        self._timeout = seconds_to_ns(scenario.link.timeout_s) // self._dt_ns
        """Silence of all servers after which the vehicle brakes [steps]."""
        if len(links) > 1:  # the standby gets a time-out to answer when it is asked
            self._timeout = round((1 + ASK_SHARE) * self._timeout) + 2
        self._change_max = scenario.vehicle.slew_mps2 * self._terms.dt_s
        """Largest change of the input from step to step [m/s]."""
        self._regulator = regulator(scenario)
        """K and λ of the vehicle's own regulator; shape (axes, 3)."""
        self._extent = _extent(scenario)
        self._reach_m = _reach_m(scenario.link.age_max_s, self._terms)

        self._heard = False
        """Whether a packet of the session has arrived since the last step."""
        self._silent = 0
        """Steps since the newest packet of the session."""
        self._good_ns: int | None = None
        """Time since which the link has been good [ns]; None while it is lost."""
        self._speed_lost = 0.0
        """Speed at the last step before the link was lost [m/s]."""
        self._times_ns: OrderedDict[int, int] = OrderedDict()
        """Virtual time of each step that was flown [ns]."""
        self._leadership = 0
        """Largest number of a leadership (see `Lead`) that the vehicle has sent to a server."""
        self._horizons: deque[tuple[int, int, bytes]] = deque(maxlen=HORIZONS_MAX)
        """Session, number of the server's run, and message of each horizon that was received and
        not of an earlier leadership."""
        self._in_force: tuple[int, int, Horizon | Trajectory] | None = None
        """Session, number of the server's run, and the horizon or trajectory in force."""
        self._observed = -1
        """Step of the observation that the plan in force is based on."""
        self._course: Course | None = None
        """Inputs that the plan in force prescribes."""
        self._covered = False
        """Whether the plan in force had an input for the last step."""
        self._speed = 0.0
        """Magnitude of the last input without feedback [m/s]."""
        self.drifted_m = drifted_m
        """Distance that the vehicle may have flown while frozen, over all runs so far [m]."""
        self.disturbance: Callable[[], Sequence[float]] = tuple
        """Function that returns the filter's disturbance estimate, of each axis [m/s]."""
        self.input = [0.0] * self._terms.axes
        """Input in force, of each axis [m/s]."""
        self.mode = Mode.INIT
        self.step, self.steps, self.missed = -1, 0, 0
        """Newest step, number of steps flown, and number of steps missed."""
        self.planned, self.followed = 0, 0
        """Number of steps flown by a horizon, and along a trajectory."""
        self.row_ns = -1
        """Virtual time of the newest step [ns], or -1."""
        self.clock_set = False
        """Whether the vehicle's clock has been set since its newest step."""

    # -- the links ---------------------------------------------------------------------------

    def note_sent(self, payload: bytes) -> None:
        self._down.seal(self.vehicle, payload, self._number)
        message = split(payload)[1]
        if kind_of(message) == LEAD:
            lead = decode(message, self._terms)
            assert isinstance(lead, Lead)
            self._leadership = max(self._leadership, lead.number)

    def server_of(self, payload: bytes, kind: int | None) -> int:
        """Number of the server's run that has sent a message; raises Violation if there is none."""
        self._up.believe(self.vehicle, payload, kind)
        return self._up.life(self.vehicle, payload)

    def hear(self, horizon: tuple[int, int, bytes] | None = None) -> None:
        """Note a packet of a session, and its session, run and message if it has a horizon."""
        self._heard = True
        if self._good_ns is None:
            self._good_ns = self._clock()
        if horizon is not None and self._decoded(horizon[2])[1] >= self._leadership:
            self._horizons.append(horizon)

    def lose(self) -> None:
        """Note that a server has restarted: the link is not good. One of two says little."""
        if len(self.links) == 1:
            self._good_ns = None

    # -- the record --------------------------------------------------------------------------

    def append_row(self, *values: float) -> None:
        """Check a row of the record; raises Violation if it violates an invariant."""
        axes = self._terms.axes
        step, now_ns = int(values[1]), self._clock()
        state, estimate = values[2 : 2 + 2 * axes], values[2 + 4 * axes : 2 + 6 * axes]
        rest = values[2 + 6 * axes :]
        flown = list(rest[:axes])
        covered, in_force, age_ns, _, missed, number, _ = rest[axes:]
        mode, asleep = Mode(int(number)), int(missed) - self.missed
        self._times_ns[step] = now_ns
        if len(self._times_ns) > STEPS_REMEMBERED:
            self._times_ns.popitem(last=False)
        self._listen()
        self._check_input(flown)
        self._check_mode(mode, covered=bool(covered), now_ns=now_ns)
        self._check_horizon(step, int(in_force), int(age_ns), now_ns)
        estimated = np.reshape(estimate, (axes, 2))
        self._check_follows(step, estimated, flown, covered=bool(covered))
        self._check_silence(mode, flown)
        self._check_place(state[::2], asleep)
        # Without this rule a vehicle that never flies again would pass.
        if mode not in FLYING and mode is not Mode.LAND and self._overdue():
            raise Violation("recovers", f"{mode}, though all faults ended long ago")
        self.step, self.missed, self.mode, self.input = step, int(missed), mode, flown
        self.steps += 1
        self.row_ns, self.clock_set = now_ns, False

    def _listen(self) -> None:
        self._silent = 0 if self._heard else self._silent + 1
        self._heard = False
        if self._silent == self._timeout + 1:
            self._good_ns = None
            self._speed_lost = math.hypot(*self.input)

    def _check_input(self, flown: list[float]) -> None:
        for u, before, most in zip(flown, self.input, self._terms.u_max, strict=True):
            if not math.isfinite(u):
                raise Violation("finite", f"an input of {u}")
            if abs(u) > most:
                raise Violation("bounded", f"an input of {u} m/s, at most {most}")
            if abs(u - before) > self._change_max + ROUNDING:
                raise Violation("slew", f"from {before:.4f} to {u:.4f} m/s in a step")

    def _check_mode(self, mode: Mode, *, covered: bool, now_ns: int) -> None:
        """Check that the table of modes allows the mode, and that no horizon is flown after a
        freeze.
        """
        if mode not in REACHED[self.mode]:
            raise Violation("table", f"from {self.mode} to {mode}")
        if mode is Mode.FAULT:
            raise Violation("table", "in fault, with a state and an input that are finite")
        if covered != (mode in FLYING):
            raise Violation("table", f"{mode}, and a horizon is {'' if covered else 'not '}flown")
        # By virtual time, for the vehicle's own clock may have stood still. A freeze together with
        # a clock that is set is one jump for the vehicle (`Steady`), which cannot tell them apart.
        late_ns = now_ns - self.row_ns - self._dt_ns
        noticeable = self.row_ns >= 0 and not self.clock_set
        if noticeable and late_ns > STALL_NS + MILLISECOND_NS and mode in FLYING:
            raise Violation("asleep", f"{mode} on waking {late_ns / SECOND_NS:.2f} s late")

    def check_change(self, before: str, after: str) -> None:
        """Check a reported change of mode; raises Violation if the table has no such transition."""
        if (before, after) not in MOVES:
            raise Violation("table", f"from {before} to {after} at once")

    def _check_horizon(self, step: int, in_force: int, age_ns: int, now_ns: int) -> None:
        """Check that the horizon in force is from the server's present run and session, and is not
        too old.
        """
        if in_force == NO_HORIZON:
            self._in_force = self._course = None
            return
        is_new = self._in_force is None or self._in_force[2].step != in_force
        if is_new:
            self._observed = step - age_ns // self._dt_ns
            self._in_force = self._find(in_force)
            self._course = None
            good_ns = self._good_ns
            # Two steps of tolerance: the client notices a packet at the beginning of the next step.
            if good_ns is None or now_ns - good_ns < GOOD_NS - 2 * self._dt_ns:
                since = "never" if good_ns is None else f"{(now_ns - good_ns) / SECOND_NS:.3f} s"
                raise Violation("good link", f"a horizon is flown, the link is good since {since}")
        assert self._in_force is not None
        session, life, horizon = self._in_force
        sessions = [each.session for each in self.links]
        # Another server may lead by now, and the plan of one that has restarted goes on.
        if (session, life) not in sessions and (is_new or len(sessions) == 1):
            origin = f"of run {life} and session {session}, not {sessions}"
            raise Violation("foreign", f"a horizon {origin}")
        if self._observed not in self._times_ns or self._observed > step:
            raise Violation("observed", f"a horizon from an observation of step {self._observed}")
        if self._course is None:
            last, terms = self._observed + self._terms.age_max - in_force + 1, self._terms
            if isinstance(horizon, Trajectory):
                self._course = FollowedCourse(horizon, last, terms, self._regulator)
            else:
                self._course = PlannedCourse(horizon, min(horizon.inputs.shape[1], last), terms)

    def _find(self, made_for: int) -> tuple[int, int, Horizon | Trajectory]:
        """Horizon in force, identified by its step and its observation."""
        # The step alone is ambiguous: two runs of the server may have planned for the same step.
        for session, life, payload in reversed(self._horizons):
            horizon, _ = self._decoded(payload)
            if horizon.step == made_for and horizon.step - horizon.age == self._observed:
                return session, life, horizon
        raise Violation("foreign", f"a horizon for step {made_for} that was never received")

    def _decoded(self, payload: bytes) -> tuple[Horizon | Trajectory, int]:
        """Horizon or trajectory, and the number of its leadership."""
        horizon, leadership = decode_led(split(payload)[1], self._terms)
        assert isinstance(horizon, Horizon | Trajectory)
        return horizon, leadership

    def _check_follows(self, step: int, state: Array, flown: list[float], *, covered: bool) -> None:
        """Check that the input follows the horizon within the rate limit, and that its plan is not
        too old.

        After the horizon's last input the vehicle must brake: without feedback, its speed must not
        exceed the braking curve.
        """
        course, before = self._course, np.array(self.input)
        if course is None:
            self._speed, self._covered = math.hypot(*flown), covered
            return
        assert self._in_force is not None
        if covered:
            self._check_age(step, self._observed)
        stage, most, disturbance = step - self._in_force[2].step, math.inf, self.disturbance()
        prescribed = course.prescribed(stage)
        if not covered:
            most = max(0.0, self._speed - (0.0 if self._covered else self._terms.brake))
        # After the last input, the input without feedback must not grow.
        speed = max(float(np.linalg.norm(prescribed)), ROUNDING)
        left_out = prescribed * (1.0 - min(1.0, most / speed))
        bound = np.array(self._terms.u_max)
        want = np.clip(prescribed + course.feedback(stage, state, disturbance), -bound, bound)
        want = course.lag * before + (1.0 - course.lag) * want - left_out
        prescribed = prescribed - left_out
        near = np.clip(want, before - self._change_max, before + self._change_max)
        near = np.clip(near, -bound, bound)
        for u, should, meant in zip(flown, near.tolist(), want.tolist(), strict=True):
            if abs(u - should) > 2.0 * ROUNDING:
                raise Violation("follows", f"{u:.4f} m/s flown, {meant:.4f} planned")
        if covered:
            self.followed += isinstance(course, FollowedCourse)
            self.planned += isinstance(course, PlannedCourse)
        feeds_back = course.feeds_back
        self._speed = float(np.linalg.norm(prescribed)) if feeds_back else math.hypot(*flown)
        self._covered = covered

    def _check_age(self, step: int, observed: int) -> None:
        """Check that the observation from which the input was computed is
        not older than allowed.
        """
        limit_ns = self._terms.age_max * self._dt_ns
        # By both clocks: a vehicle with a slow clock must not fly old inputs either.
        old_ns = max(self._clock() - self._times_ns[observed], (step - observed) * self._dt_ns)
        if old_ns > limit_ns + 2 * self._dt_ns or step - observed > self._terms.age_max:
            raise Violation(
                "expired", f"an input from an observation {old_ns / SECOND_NS:.2f} s old"
            )

    def _check_silence(self, mode: Mode, flown: list[float]) -> None:
        """Check that the vehicle brakes while the link is lost; during landing it may descend."""
        lost = self._silent - self._timeout - 1
        if lost < 0:
            return
        speed = math.hypot(*flown)
        if mode is Mode.LAND:
            # A landing vehicle may descend; horizontally it must brake.
            sinks = len(flown) > ALTITUDE and -LAND_MPS <= flown[ALTITUDE] <= 0.0
            speed = math.hypot(*flown[:ALTITUDE]) if sinks else speed
        most = max(0.0, self._speed_lost - lost * self._terms.brake)
        if speed > most + ROUNDING:
            silent_s = self._silent * self._terms.dt_s
            raise Violation("brakes", f"{speed:.3f} m/s after {silent_s:.2f} s of silence")

    def _check_place(self, position: tuple[float, ...], asleep: int) -> None:
        """Check that the vehicle is near the reference, or within the distance that a flight
        without plans allows.
        """
        away = max(
            max(low - p, p - high) for p, (low, high) in zip(position, self._extent, strict=True)
        )
        if away <= MARGIN_M:  # back at the reference
            self.drifted_m = 0.0
        # A frozen vehicle flies on with its last input.
        self.drifted_m += _speed_max(self._terms) * asleep * self._terms.dt_s
        if away > self._reach_m + self.drifted_m:
            raise Violation("place", f"{away:.1f} m outside of the reference")


MOVES = frozenset(
    {(str(mode), str(after)) for (mode, _), after in TRANSITIONS.items()}
    | {(str(mode), str(mode)) for mode in Mode}
)
"""Pairs of mode names that the table connects by one transition, or that are equal."""


def _reached(mode: Mode) -> frozenset[Mode]:
    """Modes that the table reaches from a mode, in any number of transitions."""
    reached = {mode}
    while True:
        more = {after for (before, _), after in TRANSITIONS.items() if before in reached} - reached
        if not more:
            return frozenset(reached)
        reached |= more


REACHED = {mode: _reached(mode) for mode in Mode}


def _session(payload: bytes) -> int:
    session: int = msgpack.unpackb(split(payload)[1])[3]
    return session


def _speed_max(terms: Terms) -> float:
    return max(gain * u_max for gain, u_max in zip(terms.gain, terms.u_max, strict=True))


def _reach_m(age_max_s: float, terms: Terms) -> float:
    """Largest distance of a vehicle from the region of the reference [m]."""
    # At full speed for the largest age of an input, one second of braking, and the dead time.
    return _speed_max(terms) * (age_max_s + 1.0 + max(terms.dead_time_s)) + MARGIN_M


def _extent(scenario: Scenario) -> list[tuple[float, float]]:
    times = np.linspace(0.0, scenario.reference.period_s, 200)
    positions = scenario.make_reference()(times)[:, :, 0]
    return list(zip(positions.min(axis=0).tolist(), positions.max(axis=0).tolist(), strict=True))


# -- bounds of containers --------------------------------------------------------------------

LARGE = {
    **dict.fromkeys(("front", "_later", "_slices", "_passed"), 65536),
    "_by_bin": 4096,
    "_agenda": 10**9,
}
"""Bounds of containers by attribute name, where they differ from BOUND."""
BOUND = max(EVENTS_MAX, 2048)
OURS = tuple(f"skytether.{package}." for package in ("server", "client", "netem", "shared"))
"""Packages whose objects are searched for containers."""


def check_bounds(name: str, endpoint: object) -> None:
    """Check that no container within an endpoint exceeds its bound; otherwise raise Violation."""
    for attribute, size in _sizes(endpoint, name, set()):
        bound = LARGE.get(attribute.rpartition(".")[2], BOUND)
        if size > bound:
            raise Violation("bounded memory", f"{attribute} holds {size}, at most {bound}")


def _sizes(thing: Any, name: str, seen: set[int]) -> Iterator[tuple[str, int]]:
    # Parts of an endpoint refer to each other in circles.
    if id(thing) in seen:
        return
    seen.add(id(thing))
    if isinstance(thing, dict | list | deque | set):
        yield name, len(thing)
        # A container above its bound is a violation anyway, so the items beyond need no search.
        for each in list(thing.values() if isinstance(thing, dict) else thing)[:BOUND]:
            yield from _sizes(each, name, seen)
    elif type(thing).__module__.startswith(OURS):
        slots = (slot for kind in type(thing).__mro__ for slot in getattr(kind, "__slots__", ()))
        for attribute in (*getattr(thing, "__dict__", ()), *slots):
            yield from _sizes(getattr(thing, attribute, None), f"{name}.{attribute}", seen)
