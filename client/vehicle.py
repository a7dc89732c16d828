"""The client: at every step, fly the chosen input, send the state, and stay in touch.

The client's clock is the flight's clock: the epoch is the moment its session opened, step k begins
at epoch + k Δt, and every stamp that control uses is read here. A lost server changes nothing in
that: the vehicle flies on along its horizon, then as `vehicle.exhausted` says, and says HELLO
meanwhile.
"""

from collections import Counter
from typing import Any, Literal

from client.compensator import Compensator
from client.link import Link, Plain
from client.plant import Plant
from shared.config import Scenario
from shared.endpoint import SECOND_NS, Address, Datagram, Endpoint, seconds_to_ns
from shared.events import (
    Failure,
    Finished,
    Flying,
    NoAnswer,
    NoSession,
    NotFlown,
    PlanEnded,
    PlanResumed,
    ServerHeard,
    ServerRestarted,
    ServerSilent,
    SessionRefused,
)
from shared.protocol import (
    ACCEPTED,
    CLOSES,
    FULL,
    REFUSALS,
    TAKEN,
    Close,
    Heartbeat,
    Hello,
    Horizon,
    Idle,
    Mode,
    Observation,
    ProtocolError,
    Welcome,
    decode,
    encode,
)
from shared.record import Recorder

HELLO_NS = SECOND_NS
"""Time between two HELLOs while nobody answers."""


class Client(Endpoint):
    """One vehicle.

    Args:
        scenario: the server's, as far as it makes the terms of a flight.
        plant: what flies.
        server: address of the server, or of the netem before it.
        vehicle: number of the vehicle, unlike that of any other vehicle of the server.
        boot_id: number that no other life of this vehicle has had.
        link: how messages become datagrams.
        recorder: takes one row a step.
    """

    def __init__(
        self,
        scenario: Scenario,
        plant: Plant,
        *,
        server: Address,
        vehicle: int,
        boot_id: int,
        link: Link | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__()
        self._terms = scenario.terms()
        self._dt_ns = self._terms.dt_ns
        self._steps = scenario.steps
        self._timeout_ns = seconds_to_ns(scenario.link.timeout_s)
        self._connect_ns = seconds_to_ns(scenario.link.connect_s)
        self._plant = plant
        self._compensator = Compensator(self._terms)
        self._server = server
        self.vehicle = vehicle
        self._boot_id = boot_id
        self._link = link or Plain()
        self._recorder = recorder

        self._hello_due_ns: int | None = 0
        """Time of the next HELLO; None while the server is heard."""
        self._began_ns: int | None = None
        self._session: int | None = None
        self._server_boot_id: int | None = None
        self._echo = (0, 0)
        """Newest `server_ns` [server's clock], and the time it came."""
        self._epoch_ns: int | None = None
        self._step = 0
        """Step that comes next."""
        self._flown = 0
        """Step at whose start the plant's state is."""
        self._input = self._compensator.choose(0, plant.state())
        """Desired velocity flown now [m/s]; shape (axes,)."""
        self._covered = 0
        """Number of steps for which there was an input planned."""
        self._covered_last = 0
        """Step after the last of these."""
        self._idle = Idle.PLANS
        """Why the server makes no plan, as it said last."""
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
        """Take WELCOME, HORIZON and HEARTBEAT of this session; drop and count anything else."""
        try:
            payload = self._link.open(datagram.payload, now_ns=now_ns)
            if payload is None:
                self._hello_due_ns = now_ns if self._hello_due_ns is not None else None
                return
            match decode(payload, self._terms):
                case Welcome() as welcome:
                    self._welcome(welcome, now_ns)
                case Horizon() as horizon:
                    self._heard(horizon, now_ns)
                    self._idle = Idle.PLANS
                    self._compensator.offer(horizon, self._step, self._step_at(horizon.observed_ns))
                    self.counts["horizons"] += 1
                case Heartbeat() as heartbeat:
                    self._heard(heartbeat, now_ns)
                    self._idle = Idle(heartbeat.idle)
                case _:
                    raise ProtocolError("not for a client")
        except ProtocolError as error:
            self.counts[f"dropped: {error.reason}"] += 1

    def _welcome(self, welcome: Welcome, now_ns: int) -> None:
        if (welcome.vehicle, welcome.boot_id) != (self.vehicle, self._boot_id):
            raise ProtocolError("for another life")
        if welcome.terms != self._terms:
            if self._session is None and self.failure is None:
                differences = self._terms.differences(welcome.terms)
                self._fail(SessionRefused(vehicle=self.vehicle, differences=differences))
            raise ProtocolError("other terms")
        if welcome.refusal != ACCEPTED:
            self._note_refusal(welcome.refusal)
            raise ProtocolError(REFUSALS[welcome.refusal])
        self._refusal = None
        if self._server_boot_id not in (None, welcome.server_boot_id):
            self._events.append(ServerRestarted(vehicle=self.vehicle))
        self._session, self._server_boot_id = welcome.session, welcome.server_boot_id
        self._link.adopt(now_ns=now_ns)
        self._heard(welcome, now_ns)
        if self._epoch_ns is None:
            self._epoch_ns = now_ns
            self._events.append(Flying(vehicle=self.vehicle))

    def _note_refusal(self, refusal: int) -> None:
        """Note why there is no session, and say it once; a refusal that comes late is none."""
        if self._hello_due_ns is None or refusal not in (FULL, TAKEN):
            return
        host, port = self._server
        reason: Literal["full", "taken"] = "full" if refusal == FULL else "taken"
        said = NoSession(vehicle=self.vehicle, host=host, port=port, reason=reason)
        if said != self._refusal:
            self._refusal = said
            self._events.append(said)

    def _heard(self, message: Welcome | Horizon | Heartbeat, now_ns: int) -> None:
        if (message.vehicle, message.session) != (self.vehicle, self._session):
            raise ProtocolError("unknown session")
        if self._hello_due_ns is not None and self._epoch_ns is not None:
            self._events.append(ServerHeard(vehicle=self.vehicle))
        self._hello_due_ns = None
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
        self._fail(NoAnswer(vehicle=self.vehicle, host=host, port=port, waited_s=waited_s))

    def _fail(self, failure: Failure) -> None:
        self.failure = failure
        self._events.append(failure)

    # -- time --------------------------------------------------------------------------------

    def next_wake_ns(self) -> int | None:
        """Start of the next step; before the first, the time of the next HELLO."""
        if self.finished:
            return None
        if self._epoch_ns is None:
            return self._hello_due_ns
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
            if self._hello_due_ns is None and now_ns - self._echo[1] > self._timeout_ns:
                self._events.append(ServerSilent(vehicle=self.vehicle))
                self._hello_due_ns = now_ns
        if self._hello_due_ns is not None and now_ns >= self._hello_due_ns:
            self._hello_due_ns = now_ns + HELLO_NS
            hello = encode(Hello(self.vehicle, self._boot_id, self._terms))
            self._out.append(Datagram(self._link.hello(hello, now_ns=now_ns), self._server))

    def _fly(self, now_ns: int, epoch_ns: int) -> None:
        """Advance to the present step; one that was slept through was flown with the old input."""
        present = min((now_ns - epoch_ns) // self._dt_ns, self._steps - 1)
        self.missed += present - self._step
        for _ in range(self._flown, present):
            self._plant.advance(self._input)
        self._flown, self._step = present, present + 1
        state, stamp_ns = self._plant.state(), epoch_ns + present * self._dt_ns
        had_plan = self._compensator.covered
        self._input = self._compensator.choose(present, state)
        self._tell_of_plan(had_plan, self._compensator.covered)
        server_ns, received_ns = self._echo
        assert self._session is not None
        self._send(
            Observation(
                self.vehicle,
                self._session,
                present,
                stamp_ns,
                self._compensator.in_force,
                self._compensator.since,
                server_ns,
                received_ns,
                Mode.TRACK if self._compensator.covered else Mode.HOVER,
                1,
                state,
                self._input,
            )
        )
        if self._recorder is None:
            return
        observed_ns = self._compensator.observed_ns
        self._recorder.append_row(
            self.vehicle,
            present,
            *state.ravel().tolist(),
            *self._input.tolist(),
            self._compensator.covered,
            self._compensator.in_force,
            -1 if observed_ns < 0 else stamp_ns - observed_ns,
            self._compensator.stale,
            self.missed,
        )

    def _tell_of_plan(self, had: bool, has: bool) -> None:
        """Say when a plan ends and when another begins, and how the flight ended."""
        self._covered += has
        self._covered_last = self._step if has else self._covered_last
        why = "the server is silent" if self._hello_due_ns is not None else str(self._idle)
        if self.finished:
            without_ns = (self._step - self._covered_last) * self._dt_ns
            if self._covered and without_ns <= self._timeout_ns:
                finished = Finished(vehicle=self.vehicle, steps=self._steps, missed=self.missed)
                self._events.append(finished)
            else:
                covered, steps = self._covered, self._steps
                self._fail(NotFlown(vehicle=self.vehicle, covered=covered, steps=steps, why=why))
        elif had and not has:
            brakes = self._terms.exhausted == "brake"
            self._events.append(PlanEnded(vehicle=self.vehicle, brakes=brakes, why=why))
        elif has and not had and self._covered > 1:
            self._events.append(PlanResumed(vehicle=self.vehicle))

    def _send(self, message: Observation | Close) -> None:
        self._out.append(Datagram(self._link.seal(encode(message)), self._server))

    def close(self, *, now_ns: int) -> None:  # noqa: ARG002 - see `Endpoint`
        """Tell the server that the vehicle ends."""
        if self._session is not None:
            for _ in range(CLOSES):
                self._send(Close(self.vehicle, self._session))

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`."""
        return {
            "step": self._step,
            "steps": self._steps,
            "missed": self.missed,
            "counts": dict(self.counts),
        }
