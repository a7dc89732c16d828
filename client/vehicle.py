"""The client: at every step, fly the chosen input, send the state, and stay in touch.

The client's clock is the flight's clock: the epoch is the moment its session opened, step k begins
at epoch + k Δt, and every stamp that control uses is read here. A lost server changes nothing in
that. What the vehicle does at all, `client.failsafe` decides; which input of a horizon it flies,
`client.compensator`; and `client.clamp` lets nothing pass that the vehicle must never do.
"""

import math
from collections import Counter
from itertools import chain
from typing import Any, Literal, NamedTuple

import numpy as np

from client.clamp import clamped
from client.compensator import Compensator
from client.failsafe import CLOSING, DROPPING, HOLD, LATE_SHARE, TABLE, Failsafe
from client.link import AGAIN_NS, Link, Plain
from client.navigation import Navigation
from client.plant import Plant
from shared.config import Scenario
from shared.endpoint import (
    MILLISECOND_NS,
    SECOND_NS,
    Address,
    Datagram,
    Endpoint,
    seconds_to_ns,
)
from shared.events import (
    Failure,
    Finished,
    Flying,
    ModeChanged,
    NoAnswer,
    NoSession,
    NotFlown,
    SessionRefused,
)
from shared.model import Array
from shared.protocol import (
    ACCEPTED,
    CLOSES,
    FULL,
    NO_HORIZON,
    REFUSALS,
    TAKEN,
    Close,
    Heartbeat,
    Hello,
    Horizon,
    Idle,
    Message,
    Mode,
    Observation,
    ProtocolError,
    Welcome,
    decode,
    encode,
)
from shared.record import Reason, Recorder
from shared.steady import JUMP_NS
from shared.terms import keys_of

NEVER = (0, 0)
"""Echo of a server that was not heard yet."""
SLEPT_NS = JUMP_NS // 2
"""Time by which the server's clock goes on further than ours while we sleep [ns]; far more than
what delays that change make of it."""
LAND_MPS = 0.5
"""Speed at which the vehicle descends to land [m/s]."""
ALTITUDE = 2
"""Axis of the altitude, where there is one."""
PLANLESS = frozenset({Reason.OPENED, Reason.GOOD, Reason.HORIZON, Reason.OLD, Reason.ENDED})
"""Reasons that do not say why there is no newer horizon."""
DEGRADED = "the server misses its deadlines"
"""Why no newer horizon comes, as it seems, of a server that plans and says that it is degraded."""
IMPOSSIBLE = frozenset({"from the future", "observation"})
"""Reasons for which a horizon is dropped that is made for an impossible time."""
AIR = keys_of("the vehicle's: the air it flies in")
"""Keys of the air that a simulated vehicle flies in."""


class Known(NamedTuple):
    """A vehicle's state at a step: position [m] and velocity [m/s], each of shape (axes, 2)."""

    state: Array
    """What it is in truth, as far as anybody knows."""
    measured: Array
    """What the vehicle has measured of it since the step before; NaN where it has not."""
    estimate: Array
    """What it takes it for."""

    @property
    def finite(self) -> bool:
        """Whether it is one that can be flown by."""
        return all(map(math.isfinite, [*self.state.flat, *self.estimate.flat]))


class Client(Endpoint):
    """One vehicle.

    Args:
        scenario: the server's, as far as it makes the terms of a flight.
        plant: what flies.
        server: address of the server, or of the netem before it.
        vehicle: number of the vehicle, unlike that of any other vehicle of the server.
        boot_id: number that no other life of this vehicle has had.
        link: how messages become datagrams.
        navigation: what the vehicle knows of its state; left out: the plant's state as it is.
        recorder: takes one row a step.
    """

    changeable = AIR | {"armed"}

    def __init__(
        self,
        scenario: Scenario,
        plant: Plant,
        *,
        server: Address,
        vehicle: int,
        boot_id: int,
        link: Link | None = None,
        navigation: Navigation | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__()
        self._terms = scenario.terms()
        self._dt_ns = self._terms.dt_ns
        self._steps = scenario.steps
        self._timeout_ns = seconds_to_ns(scenario.link.timeout_s)
        self._connect_ns = seconds_to_ns(scenario.link.connect_s)
        self._plant, self._navigation = plant, navigation
        self._compensator = Compensator(self._terms)
        self._server = server
        self.vehicle = vehicle
        self._boot_id = boot_id
        self._link = link or Plain()
        self._recorder = recorder

        self._failsafe = Failsafe(
            HOLD if self._terms.exhausted == "hold" else TABLE,
            armed=scenario.armed,
            timeout_ns=self._timeout_ns,
            land_after_ns=seconds_to_ns(scenario.vehicle.land_after_s),
            changed=self._mode_changed,
        )
        self._change_max = (
            math.inf
            if self._terms.exhausted == "hold"
            else scenario.vehicle.slew_mps2 * self._terms.dt_s
        )
        """Largest change of the input from step to step [m/s]."""

        self._hello_ns = 0
        """Time before which no HELLO is said again."""
        self._began_ns: int | None = None
        self._session: int | None = None
        self._in_session = False
        """Whether that session may go on; else nothing but a WELCOME is heard."""
        self._server_boot_id: int | None = None
        self._echo = NEVER
        """Newest `server_ns` [server's clock], and the time it came."""
        self._epoch_ns: int | None = None
        self._step = 0
        """Step that comes next."""
        self._flown = 0
        """Step at whose start the plant's state is."""
        self._takes_from: int | None = None
        """Step of the first observation that said that horizons are flown; None while they are
        not."""
        self._input = np.zeros(self._terms.axes)
        """Desired velocity flown now [m/s]; shape (axes,)."""
        self._speed = 0.0
        """Magnitude of the part of it that is no feedback [m/s]."""
        self._covered = 0
        """Number of steps for which there was an input planned."""
        self._covered_last = 0
        """Step after the last of these."""
        self._idle = str(Idle.PLANS)
        """Why no newer horizon comes, as far as the server has said."""
        self._refusal: NoSession | None = None
        """Why the server opens no session, as far as it has said so since the last one."""
        self.failure: Failure | None = None
        """Event after which there can be no flight."""
        self.missed = 0
        """Steps slept through."""
        self.counts: Counter[str] = Counter()
        """Number of horizons received, and of datagrams dropped, by reason."""

    @property
    def finished(self) -> bool:
        """Whether the flight has ended, or cannot begin."""
        return self.failure is not None or self._step >= self._steps

    # -- datagrams ---------------------------------------------------------------------------

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Take what is said in this session; drop and count anything else."""
        try:
            payload = self._link.open(datagram.payload, now_ns=now_ns)
            if payload is None:
                self._hello_ns = now_ns
                return
            match self._decode(payload, now_ns):
                case Welcome() as welcome:
                    self._welcome(welcome, now_ns)
                case Horizon() as horizon:
                    self._heard(horizon, now_ns)
                    self._idle = str(Idle.PLANS)
                    self._offer(horizon, now_ns)
                    self.counts["horizons"] += 1
                case Heartbeat() as heartbeat:
                    self._heard(heartbeat, now_ns)
                    planning = heartbeat.idle == Idle.PLANS
                    missing = planning and heartbeat.degraded
                    self._idle = DEGRADED if missing else str(Idle(heartbeat.idle))
                case Close() as close:
                    self._check_session(close)
                    self._failsafe.meet(Reason.CLOSED, now_ns=now_ns)
                case _:
                    raise ProtocolError("not for a client")
        except ProtocolError as error:
            self.counts[f"dropped: {error.reason}"] += 1

    def _decode(self, payload: bytes, now_ns: int) -> Message:
        """The message in a payload; one that is none is a mistake of the server, if it is its own.

        In plaintext anybody could make the vehicle brake by such mistakes: there they count for
        nothing.
        """
        try:
            return decode(payload, self._terms)
        except ProtocolError:
            if self._link.secure:
                self._failsafe.malformed(now_ns=now_ns)
            raise

    def _offer(self, horizon: Horizon, now_ns: int) -> None:
        """Hold a horizon from now on, if it is the newest and may be flown.

        One that was planned when the vehicle had not yet said that it would fly it begins where the
        vehicle is not: the server reckoned with none.
        """
        terms = self._terms
        if horizon.step > self._compensator.newest:
            passed = self._step - horizon.step - (horizon.inputs.shape[1] - terms.planned)
            self._failsafe.horizon_arrived(late=passed > LATE_SHARE * terms.reach, now_ns=now_ns)
        observed = self._step_at(horizon.observed_ns)
        if self._takes_from is None or 0 <= observed < self._takes_from:
            raise ProtocolError("not taken")
        try:
            is_held = self._compensator.offer(horizon, self._step, observed)
        except ProtocolError as error:
            if error.reason in IMPOSSIBLE:
                self._failsafe.future(now_ns=now_ns)
            raise
        if is_held:
            self._failsafe.horizon_taken(now_ns=now_ns)

    def _welcome(self, welcome: Welcome, now_ns: int) -> None:
        if (welcome.vehicle, welcome.boot_id) != (self.vehicle, self._boot_id):
            raise ProtocolError("for another life")
        if welcome.terms != self._terms:
            if self._session is None and self.failure is None:
                differences = self._terms.differences(welcome.terms)
                self._fail(SessionRefused(vehicle=self.vehicle, differences=differences))
            raise ProtocolError("other terms")
        if welcome.refusal != ACCEPTED:
            self._note_refusal(welcome.refusal, now_ns)
            raise ProtocolError(REFUSALS[welcome.refusal])
        self._refusal = None
        restarted = self._server_boot_id not in (None, welcome.server_boot_id)
        if restarted:
            self._echo = NEVER
        self._session, self._server_boot_id = welcome.session, welcome.server_boot_id
        self._in_session = True
        self._link.adopt(now_ns=now_ns)
        self._heard(welcome, now_ns)
        if restarted:
            self._failsafe.meet(Reason.RESTARTED, now_ns=now_ns)
        if self._epoch_ns is None:
            self._epoch_ns = now_ns
            self._measure()
            self._events.append(Flying(vehicle=self.vehicle))
            self._failsafe.meet(Reason.OPENED, now_ns=now_ns)

    def _note_refusal(self, refusal: int, now_ns: int) -> None:
        """Note why there is no session, and say it once; a refusal that comes late is none."""
        if not self._failsafe.is_lost(now_ns) or refusal not in (FULL, TAKEN):
            return
        host, port = self._server
        reason: Literal["full", "taken"] = "full" if refusal == FULL else "taken"
        said = NoSession(vehicle=self.vehicle, host=host, port=port, reason=reason)
        if said != self._refusal:
            self._refusal = said
            self._events.append(said)

    def _check_session(self, message: Welcome | Horizon | Heartbeat | Close) -> None:
        named = message.vehicle, message.session
        if not self._in_session or named != (self.vehicle, self._session):
            raise ProtocolError("unknown session")

    def _heard(self, message: Welcome | Horizon | Heartbeat, now_ns: int) -> None:
        """Note a packet of the session, and a sleep that our own clock has not told of.

        A leap of it may be a clock that was set, or real time that was slept through
        (`shared.steady`): the server's clock has gone on as well then.
        """
        self._check_session(message)
        server_ns, received_ns = self._echo
        ahead_ns = (message.server_ns - server_ns) - (now_ns - received_ns)
        if ahead_ns > SLEPT_NS and self._echo != NEVER:
            self._failsafe.meet(Reason.STALLED, now_ns=now_ns)
        self._failsafe.heard(now_ns=now_ns)
        self._echo = (message.server_ns, now_ns)

    def _step_at(self, stamp_ns: int) -> int:
        """Step of one of the vehicle's own stamps, or -1 where it is none."""
        assert self._epoch_ns is not None
        step, off_ns = divmod(stamp_ns - self._epoch_ns, self._dt_ns)
        return -1 if off_ns else step

    def _give_up(self, waited_s: float) -> None:
        """Fail for want of a first session; a refusal has been said before."""
        if self._refusal is not None:
            self.failure = self._refusal
            return
        host, port = self._server
        self._fail(
            NoAnswer(
                vehicle=self.vehicle,
                host=host,
                port=port,
                waited_s=waited_s,
                secure=self._link.secure,
            )
        )

    def _fail(self, failure: Failure) -> None:
        self.failure = failure
        self._events.append(failure)

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:  # noqa: ARG002
        """See `Endpoint`."""
        self._failsafe.armed = scenario.armed
        if keys & AIR:
            self._plant.change(scenario.vehicle)

    # -- time --------------------------------------------------------------------------------

    def next_wake_ns(self) -> int | None:
        """Start of the next step; before the first, the time of the next HELLO."""
        if self.finished:
            return None
        if self._epoch_ns is None:
            return self._hello_ns
        return self._epoch_ns + self._step * self._dt_ns

    def wake(self, *, now_ns: int) -> None:
        """Fly the step that is due, and say HELLO where nobody is heard."""
        if self._began_ns is None:
            self._began_ns = now_ns
        if self._epoch_ns is None:
            if now_ns - self._began_ns > self._connect_ns:
                self._give_up((now_ns - self._began_ns) / SECOND_NS)
                return
        elif now_ns < self._epoch_ns + self._step * self._dt_ns:
            return
        else:
            self._fly(now_ns, self._epoch_ns)
        wanted = self._failsafe.is_lost(now_ns) or self._link.wants_hello(now_ns)
        if wanted and now_ns >= self._hello_ns:
            unheard = self._epoch_ns is None and self._refusal is None
            self._hello_ns = now_ns + (self._link.hello_ns if unheard else AGAIN_NS)
            hello = encode(Hello(self.vehicle, self._boot_id, self._terms))
            self._out.append(Datagram(self._link.hello(hello, now_ns=now_ns), self._server))

    def _fly(self, now_ns: int, epoch_ns: int) -> None:
        """Advance to the present step; one that was slept through was flown with the old input."""
        present = min((now_ns - epoch_ns) // self._dt_ns, self._steps - 1)
        self.missed += present - self._step
        for _ in range(self._flown, present):
            self._plant.advance(self._input)
            self._measure()
        late_ns = now_ns - epoch_ns - self._step * self._dt_ns
        self._flown = self._step = present
        self._failsafe.step(late_ns=late_ns, now_ns=now_ns)
        known = self._know()
        self._input = self._choose(known, now_ns)
        if not self._failsafe.takes:
            self._takes_from = None
        elif self._takes_from is None:
            self._takes_from = present
        self._step = present + 1
        self._note_end(now_ns)
        self._report(known, epoch_ns + present * self._dt_ns)

    def _measure(self) -> None:
        """Measure the state at the begin of a step, where it is not known as it is."""
        if self._navigation is not None:
            self._navigation.advance(self._plant.state(), self._input)

    def _know(self) -> Known:
        """What is known of the state at the present step, and the state itself."""
        state = self._plant.state()
        if self._navigation is None:
            return Known(state, state, state)
        return Known(state, self._navigation.measured, self._navigation.estimate)

    def _choose(self, known: Known, now_ns: int) -> Array:
        """Input of the present step [m/s], shape (axes,), and what follows from it."""
        failsafe, compensator = self._failsafe, self._compensator
        if not known.finite:
            failsafe.meet(Reason.NOT_FINITE, now_ns=now_ns)
        had_plan = compensator.covered
        wanted = compensator.choose(self._step, known.estimate).tolist()
        if failsafe.mode is Mode.LAND:
            wanted = [0.0] * self._terms.axes
            if self._terms.axes > ALTITUDE and known.estimate[ALTITUDE, 0] > 0.0:
                wanted[ALTITUDE] = -LAND_MPS
        told = compensator.told if compensator.feeds_back else wanted
        speed_max = self._speed_max(had_plan)
        flown = clamped(
            wanted,
            self._input.tolist(),
            self._terms.u_max,
            self._change_max,
            told=told,
            speed_max=speed_max,
        )
        if flown is None:
            failsafe.meet(Reason.NOT_FINITE, now_ns=now_ns)
        elif compensator.in_force != NO_HORIZON and not compensator.covered:
            failsafe.meet(Reason.ENDED, now_ns=now_ns)
        if flown is None or failsafe.mode is Mode.FAULT:
            flown = told = [0.0] * self._terms.axes
        if compensator.feeds_back:
            self._speed = min(math.hypot(*told), speed_max)
        else:
            self._speed = math.hypot(*flown)
        if not self._speed:
            failsafe.meet(Reason.STILL, now_ns=now_ns)
        return np.array(flown)

    def _speed_max(self, had_plan: bool) -> float:
        """Largest speed of what is told [m/s]: without a plan what was flown is braked along."""
        brakes = self._failsafe.brakes and self._failsafe.mode is not Mode.LAND
        if self._compensator.covered or not brakes:
            return math.inf
        return max(0.0, self._speed - (0.0 if had_plan else self._terms.brake))

    def _report(self, known: Known, stamp_ns: int) -> None:
        """Send and record the step that has just begun; a state that is none is only recorded."""
        step, failsafe, compensator = self._flown, self._failsafe, self._compensator
        server_ns, received_ns = self._echo
        assert self._session is not None
        if known.finite:
            self._send(
                Observation(
                    self.vehicle,
                    self._session,
                    step,
                    stamp_ns,
                    compensator.in_force,
                    compensator.since,
                    server_ns,
                    received_ns,
                    failsafe.mode,
                    int(failsafe.takes),
                    known.estimate,
                    self._input,
                )
            )
        if self._recorder is None:
            return
        observed_ns = compensator.observed_ns
        self._recorder.append_row(
            self.vehicle,
            step,
            *chain.from_iterable(of.ravel().tolist() for of in known),
            *self._input.tolist(),
            compensator.covered,
            compensator.in_force,
            -1 if observed_ns < 0 else stamp_ns - observed_ns,
            compensator.stale,
            self.missed,
            failsafe.mode,
            failsafe.reason,
        )

    def _mode_changed(self, before: Mode, was: Reason, cause: Reason, now_ns: int) -> None:
        """Do and say what goes with another mode or reason.

        That it coasts for a while is not said: where an event sends a horizon, that is as usual.
        """
        if not self._failsafe.takes:
            self._takes_from = None
        if cause in DROPPING:
            self._compensator.drop(self._step - 1, self._input)
            self._speed = math.hypot(*self._input.tolist())
        if cause in CLOSING:
            self._in_session = False
        if cause is Reason.OLD or (was, cause) == (Reason.OLD, Reason.HORIZON):
            return
        reason, after = self._failsafe.reason, str(self._failsafe.mode)
        why = self._why_no_plan(now_ns) if reason is Reason.ENDED else str(reason)
        changed = ModeChanged(vehicle=self.vehicle, before=str(before), after=after, reason=why)
        self._events.append(changed)

    def _why_no_plan(self, now_ns: int) -> str:
        """Why there is no newer horizon, as far as the vehicle knows."""
        reason = self._failsafe.reason
        if reason not in PLANLESS:
            return str(reason)
        return str(Reason.LOST) if self._failsafe.is_lost(now_ns) else self._idle

    def _note_end(self, now_ns: int) -> None:
        """Note whether a plan is flown, and say how the flight ended."""
        if self._compensator.covered:
            self._covered += 1
            self._covered_last = self._step
        if not self.finished:
            return
        without_ns = (self._step - self._covered_last) * self._dt_ns
        if self._covered and without_ns <= self._timeout_ns:
            finished = Finished(vehicle=self.vehicle, steps=self._steps, missed=self.missed)
            self._events.append(finished)
        else:
            covered, why = self._covered, self._why_no_plan(now_ns)
            failure = NotFlown(vehicle=self.vehicle, covered=covered, steps=self._steps, why=why)
            self._fail(failure)

    def _send(self, message: Observation | Close) -> None:
        self._out.append(Datagram(self._link.seal(encode(message)), self._server))

    def close(self, *, now_ns: int) -> None:  # noqa: ARG002 - see `Endpoint`
        """Tell the server that the vehicle ends."""
        if self._session is not None:
            for _ in range(CLOSES):
                self._send(Close(self.vehicle, self._session))

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`; ages are there while a horizon is in force."""
        figures = {
            "vehicle": self.vehicle,
            "mode": str(self._failsafe.mode),
            "step": self._step,
            "steps": self._steps,
            "missed": self.missed,
            "counts": dict(self.counts),
        }
        compensator, observed_ns = self._compensator, self._compensator.observed_ns
        if self._epoch_ns is not None and observed_ns >= 0:
            now_ns = self._epoch_ns + self._flown * self._dt_ns
            planned_ns = self._epoch_ns + compensator.in_force * self._dt_ns
            figures["age_ms"] = (now_ns - observed_ns) / MILLISECOND_NS
            figures["plan_age_ms"] = (now_ns - planned_ns) / MILLISECOND_NS
        return figures
