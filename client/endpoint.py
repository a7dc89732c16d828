"""The client as an endpoint: one vehicle that receives plans, flies, and reports its state.

It combines `session` (the conversation with a server, made by `connections`), `pilot` (which flies
the vehicle) and `failsafe` (which decides what the vehicle may do). `ground` and `flight_log`
report what happens, and `orders` takes the orders of an operator. The steps follow the client's own
clock, so they continue on time without a server.
"""

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from operator import attrgetter
from typing import Any

from skytether.client.alone import Fresh, Parts, Reach
from skytether.client.connections import connect
from skytether.client.failsafe import CLOSING, HOLD, TRANSITIONS, Failsafe, brake_ns
from skytether.client.flight_log import FlightLog
from skytether.client.link import ClientLink
from skytether.client.pilot import Pilot
from skytether.client.session import ServerSession
from skytether.client.vehicle import Vehicle
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import MICROSECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import (
    VEHICLES_SHOWN_MAX,
    Address,
    Datagram,
    Endpoint,
    by_name,
)
from skytether.shared.endpoints.time_of_day import TimeOfDay
from skytether.shared.events.flight import (
    Failure,
    Flying,
    Leaving,
    address_text,
)
from skytether.shared.law.model import Array
from skytether.shared.scenario.catalogue import DECISIONS, keys_of
from skytether.shared.scenario.owners import InFlight
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason, Recorder
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import CLOSES, Close, Mode, stamp_us

ORDERS = keys_of(InFlight.ARMED) | {*DECISIONS}
"""Keys of the scenario that an operator can change in flight for every vehicle, see `orders`."""
VEHICLE_SOCKET = 1
"""Number of the socket of the vehicle's own port; socket 0 leads to the server."""
LATEST_NS = SECOND_NS
"""Time after its vehicle's motion in which a client that was asked to end does so [ns]."""
TIME_NS, TIME_ERROR_MAX_US = 2 * SECOND_NS, 2**32 - 1
"""Interval between two TIME messages [ns], and largest error of the time of day that a TIME message
can hold [µs]."""


class Client(Endpoint):
    """Endpoint of one vehicle.

    Args:
        scenario: scenario of the vehicle; its terms must equal the server's.
        server: address of the server, or of the netem in front of it; or a `Reach` of several
            servers or paths, see `client.several`.
        vehicle: number of the vehicle, unique among the vehicles of the server.
        boot_id: number unique to this run of the client.
        link: link to the server at an address; None: without keys.
        before: state saved by the previous run of the client, see `client.memory`; None: nothing.
    """

    _unsaved = False
    """Whether saving the client's state has failed; observations report this failure."""

    def __init__(
        self,
        scenario: Scenario,
        flies: Vehicle,
        *,
        server: Address | Reach,
        vehicle: int,
        boot_id: int,
        link: ClientLink | None = None,
        recorder: Recorder | None = None,
        before: Any = None,
    ) -> None:
        super().__init__()
        terms = scenario.terms()
        self._before = before or Fresh()
        self._keeps_apart, self._axes = scenario.keeps_apart, terms.axes
        self.vehicle = vehicle
        self._timeout_ns = seconds_to_ns(scenario.link.timeout_s)
        self._flies, self._port = flies, flies.port
        self._failsafe = Failsafe(
            HOLD if terms.exhausted == "hold" else TRANSITIONS,
            armed=scenario.armed,
            timeout_ns=self._timeout_ns,
            brake_ns=brake_ns(terms),
            land_after_ns=seconds_to_ns(scenario.vehicle.land_after_s),
            returns=scenario.vehicle.on_loss == "return",
        )
        self._pilot = Pilot(scenario, vehicle, flies, self._failsafe, recorder)
        parts = Parts(
            scenario=scenario,
            terms=terms,
            vehicle=vehicle,
            boot_id=boot_id,
            failsafe=self._failsafe,
            before=self._before,
            motion=self._pilot.motion_in_force,
            out=self._out,
            events=self._events,
        )
        reach = server if isinstance(server, Reach) else Reach(server, link)
        self._servers, self._ends = connect(reach, parts)
        self._sessions: list[ServerSession] = self._servers.sessions
        for key, undecided in DECISIONS.items():
            if (got := attrgetter(key)(scenario)) != undecided:
                expected = f"expected {undecided!r}: it is chosen in flight"
                raise ConfigError(f"{key}: got {got!r}, {expected}")
        self.changeable = flies.changeable | ORDERS
        self._log = FlightLog(
            scenario, vehicle, self._pilot, self._failsafe, self._servers, self._events
        )
        self._ground: dict[ServerSession, Any] = {}
        if self._port is not None:
            ground = load("skytether.client.ground", "a vehicle on the ground")
            self._ground = {
                each: ground.GroundReports(vehicle, each.address, self._timeout_ns, self._events)
                for each in self._sessions
            }
        self._time: TimeOfDay | None = None
        self._time_due_ns = 0
        self.horizons = 0
        self._leaves = False
        """Whether an operator has asked the client to end."""
        self.dropped: Counter[str] = Counter()

    @property
    def _session(self) -> ServerSession:
        """Session with the server whose plans are flown."""
        session: ServerSession = self._servers.followed
        return session

    @property
    def failure(self) -> Failure | None:
        return self._flies.failure or self._session.failure or self._log.failure

    @property
    def finished(self) -> bool:
        pilot = self._pilot
        if self._leaves and not pilot.is_moving:
            return True
        if pilot.next_ns is not None:
            return pilot.step >= pilot.steps and self._flies.is_down
        return self.failure is not None and self._flies.is_down

    @property
    def missed(self) -> int:
        return self._pilot.missed

    @property
    def began_ns(self) -> int:
        return self._pilot.began_ns

    @property
    def disturbance(self) -> Array:
        return self._pilot.disturbance

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Process a datagram of this session; drop and count any other datagram.

        Datagrams on the socket of the vehicle's own port are passed on to that port.
        """
        if datagram.socket == VEHICLE_SOCKET and self._port is not None:
            self._port.receive(datagram, now_ns=now_ns)
            self._attend(self._port, now_ns)
            return
        # Checked before decryption: a packet from another address costs only one comparison.
        end = self._ends.get((datagram.socket, datagram.peer))
        if end is None:
            self.dropped[Drop.ELSEWHERE] += 1
            return
        session, path = end
        try:
            horizon = session.hear(datagram.payload, path=path, now_ns=now_ns)
            if self._pilot.next_ns is None:
                self._begin(now_ns)
            elif self._failsafe.mode is Mode.INIT:  # the continued flight now has a session
                self._failsafe.meet(Reason.OPENED, now_ns=now_ns)
            elif horizon is not None:
                self._pilot.offer(horizon, now_ns=now_ns)
                self.horizons += 1
        except ProtocolError as error:
            self.dropped[error.reason] += 1
        if self._failsafe.transitions or self._pilot.transitions:
            self._note_transitions(now_ns)

    def _begin(self, now_ns: int) -> None:
        """Begin the flight once the first session is open and the vehicle can be flown.

        The flight of an earlier run continues at once, before there is a session: the vehicle
        follows the motion that was in force, or hovers.
        """
        before, flies = self._before, self._flies
        if self._session.number is not None:
            if not flies.take_off(now_ns=now_ns):
                return
        elif before.began_ns is None or not flies.is_up(now_ns=now_ns):
            return
        is_new = before.began_ns is None or flies.took_off
        if (motion := before.motion) and not is_new:
            knots = motion.knots(self._axes)
            self._pilot.compensator.go_on_along(
                motion.step, motion.observed, motion.spacing, knots, since=motion.since
            )
        self._pilot.begin(now_ns=now_ns, began_ns=before.began_ns)
        if is_new:
            self._events.append(Flying(vehicle=self.vehicle))
            self._failsafe.meet(Reason.OPENED, now_ns=now_ns)
            self._note_transitions(now_ns)
            return
        cause = Reason.RESUMED if motion else Reason.LOST
        for session in self._sessions:
            session.heard_ns = before.heard_ns
        self._failsafe.resume(cause, heard_ns=before.heard_ns, now_ns=now_ns)
        self._note_transitions(now_ns)

    def next_wake_ns(self) -> int | None:
        pilot, due_ns = self._pilot, None
        if pilot.next_ns is None:
            due_ns = self._due_ns()
        elif pilot.step < pilot.steps:
            due_ns = pilot.next_ns
        if self._port is None or self.finished:
            return due_ns
        port_ns = self._port.next_wake_ns()
        return port_ns if due_ns is None else min(due_ns, port_ns or due_ns)

    def _due_ns(self) -> int | None:
        pilot = self._pilot
        if pilot.next_ns is not None:
            return pilot.next_ns if pilot.step < pilot.steps else None
        if self.failure is not None or not self._flies.is_ready:
            return None
        return self._session.hello_ns

    def wake(self, *, now_ns: int) -> None:
        if self._port is not None:
            port_ns = self._port.next_wake_ns()
            if port_ns is not None and port_ns <= now_ns:
                self._port.wake(now_ns=now_ns)
        if self._pilot.next_ns is None and self._before.began_ns is not None:
            self._begin(now_ns)
        due_ns = self._due_ns()
        if due_ns is not None and due_ns <= now_ns:
            if self._pilot.next_ns is not None:
                self._fly(now_ns)
            elif not self._session.wait(now_ns=now_ns):
                return
            else:
                self._servers.follow(step=self._pilot.flown, on_ground=True, now_ns=now_ns)
            for session in self._sessions:
                session.ask(now_ns=now_ns)
                if self._pilot.next_ns is None:
                    session.rest(now_ns=now_ns)
        if self._port is not None:
            self._attend(self._port, now_ns)

    def _attend(self, port: Endpoint, now_ns: int) -> None:
        if self._pilot.next_ns is None:
            self._begin(now_ns)
        if self._pilot.next_ns is None and not self.failure:
            self._watch_ground(now_ns)
        self._out += [Datagram(payload, peer, VEHICLE_SOCKET) for payload, peer, _ in port.outbox()]
        self._events += port.events()

    def _watch_ground(self, now_ns: int) -> None:
        session, waits_for = self._session, self._flies.waits_for
        ground = self._ground[session]
        if session.number is not None:
            ground.hear(session.number, session.clock.echo.received_ns, now_ns=now_ns)
        elif self._flies.is_ready:
            waits_for = f"an answer of the server at {address_text(*session.address)}"
        ground.wait(waits_for, now_ns=now_ns)

    def _fly(self, now_ns: int) -> None:
        pilot = self._pilot
        pilot.fly(now_ns=now_ns)
        if pilot.transitions:
            self._note_transitions(now_ns)
        self._log.report_step(now_ns)
        if pilot.step >= pilot.steps:
            self._flies.land()
            self._log.report_end(now_ns)
        self._report(now_ns)

    def _report(self, now_ns: int) -> None:
        """Send the servers the messages that are due after a step."""
        pilot = self._pilot
        self._servers.follow(step=pilot.flown, on_ground=False, now_ns=now_ns)
        for session in self._sessions:
            observation = None
            if not session.role.may_observe:
                continue
            if session.role.is_followed:
                observation = pilot.observation(session)
            elif session.is_observation_due(pilot.flown):
                observation = pilot.observe(session)
            if observation is not None:
                if self._unsaved:
                    observation = observation._replace(unsaved=1)
                session.send(observation, now_ns=now_ns)
                self._tell_time(session, now_ns)
            session.route.watch(session, now_ns)

    @cached_property
    def _orders(self) -> Any:
        orders = load("skytether.client.orders", "a change")
        return orders.Orders(self._flies, self._pilot, self._failsafe, self._servers)

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:
        return str(self._orders.objection(scenario, keys))

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        self._orders.obey(scenario, keys, now_ns=now_ns)

    def learn_time(self, utc_ns: int, error_ns: int, *, now_ns: int) -> None:
        self._time = TimeOfDay(utc_ns - now_ns, error_ns, now_ns)

    def _tell_time(self, session: ServerSession, now_ns: int) -> None:
        if self._time is None or not self._keeps_apart or now_ns < self._time_due_ns:
            return
        error_ns = self._time.error_at(now_ns)
        if error_ns is None:
            return
        self._time_due_ns = now_ns + (TIME_NS if session.role.is_followed else 0)
        epoch_us = stamp_us(self._pilot.began_ns + self._time.ahead_ns)
        error_us = min(-(-error_ns // MICROSECOND_NS) + 1, TIME_ERROR_MAX_US)
        session.tell_time(self._pilot.flown, epoch_us, error_us, now_ns=now_ns)

    def leave(self, *, now_ns: int) -> int:
        """Prepare to end: a vehicle on a mission's motion flies to the end of the motion first."""
        self._leaves = True
        if not self._pilot.is_moving:
            return now_ns
        rests_ns = self._pilot.rest(now_ns=now_ns) + LATEST_NS
        self._note_transitions(now_ns)
        most_s = (rests_ns - now_ns) / SECOND_NS
        self._events.append(Leaving(vehicles=(self.vehicle,), most_s=most_s))
        return rests_ns

    def close(self, *, now_ns: int) -> None:
        """Send CLOSE to the server, and let the vehicle land by itself if it can."""
        if self._port is not None:
            self._port.close(now_ns=now_ns)
            self._attend(self._port, now_ns)
        for session in self._sessions:
            if session.number is not None:
                # A CLOSE is not acknowledged, so it is sent several times.
                for _ in range(CLOSES):
                    session.send(Close(self.vehicle, session.number), now_ns=now_ns)

    def _note_transitions(self, now_ns: int) -> None:
        """Let the pilot act on the failsafe's changes of mode, and log these changes."""
        self._pilot.obey()
        if any(each.cause in CLOSING for each in self._pilot.transitions):
            self._session.close()
        self._log.report_transitions(self._pilot.transitions, now_ns)
        self._pilot.transitions.clear()

    def figures(self) -> dict[str, Any]:
        return figures([self])

    def vehicle_figures(self) -> dict[str, Any]:
        pilot, counts = self._pilot, {"horizons": self.horizons, "dropped": by_name(self.dropped)}
        vehicle_figures = pilot.figures() | counts
        vehicle_figures |= self._servers.figures()
        if pilot.next_ns is not None:
            vehicle_figures |= self._session.route.figures(pilot.starts_ns(pilot.flown))
        if self._port is not None:
            vehicle_figures["autopilot"] = self._port.figures()
        return vehicle_figures


def figures(clients: Sequence[Client]) -> dict[str, Any]:
    """Figures of the clients in one process, see `Endpoint.figures`."""
    others = clients[VEHICLES_SHOWN_MAX:]
    return {
        "vehicles": len(clients),
        "missed": sum(client.missed for client in clients),
        "by_vehicle": {
            str(client.vehicle): client.vehicle_figures() for client in clients[:VEHICLES_SHOWN_MAX]
        },
        "others_dropped": by_name(sum((client.dropped for client in others), Counter())),
    }
