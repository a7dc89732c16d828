"""The autopilot from its first heartbeat to a vehicle that can be flown: set-up, clock, launch.

    heartbeat → flavour → parameters, streams and clock → ready → launch

Messages of the autopilot are distributed to these parts; the requests of the parts are sent by
`port`.
"""

from typing import NamedTuple

from skytether.client.clock import BootClock
from skytether.client.mavlink.condition import Condition
from skytether.client.mavlink.flavours import ARDUPILOT, FLAVOURS, Flavour, unfit
from skytether.client.mavlink.keys import MavlinkConfig
from skytether.client.mavlink.launch import (
    ACCEPTED,
    IN_PROGRESS,
    QUIET_NS,
    RESULTS,
    Launch,
    Phase,
)
from skytether.client.mavlink.positions import Positions, given_origin
from skytether.client.mavlink.safety import returns_below_m
from skytether.client.mavlink.setup import Setup
from skytether.client.mavlink.streams import SET_INTERVAL, Streams, rates
from skytether.client.mavlink.texts import LoggedTexts
from skytether.client.mavlink.timesync import Timesync
from skytether.client.navigation import Leaps
from skytether.client.positions import take_off_place
from skytether.client.vehicle import VehicleMemory
from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.endpoints.endpoint import Events
from skytether.shared.events.aboard import AutopilotMode, AutopilotRefused, NotTakenOff
from skytether.shared.events.flight import Failure
from skytether.shared.scenario.schema import Scenario

WARNING = int(dialect.MAV_SEVERITY_WARNING)


class Parts(NamedTuple):
    """Parts that depend on the kind of autopilot, and are created once that kind is known."""

    setup: Setup
    launch: Launch
    streams: Streams


class Autopilot:
    """One autopilot, and its state according to its messages; `altitude`: take-off altitude [m]."""

    parts: Parts | None = None
    """Parts of the autopilot; None until a heartbeat of a suitable autopilot has arrived."""
    _unfit: NotTakenOff | None = None
    """Failure event if the autopilot is unsuitable or silent; None otherwise."""
    _set_up_ns: int | None = None
    """Time at which everything except the clock was ready."""
    _began_ns: int | None = None

    def __init__(self, scenario: Scenario, vehicle: int, altitude: float, events: Events) -> None:
        self._scenario, self._vehicle, self._altitude = scenario, vehicle, altitude
        self._keys = scenario.section(MavlinkConfig)
        self._patience_ns = seconds_to_ns(self._keys.patience_s)
        self._events = events
        self.clock = BootClock()
        self.timesync = Timesync(self.clock, vehicle, events)
        self.condition = Condition(self._keys.battery_min, self._keys.battery_min_v)
        self.positions = Positions(
            scenario.model.axes,
            self.clock,
            start=take_off_place(scenario, vehicle),
            origin=given_origin(scenario),
            leaps=Leaps(scenario),
        )
        self._texts = LoggedTexts(vehicle, events)
        self.sets_parameters = False
        self.flavour: Flavour = ARDUPILOT
        self._target = (0, 0)
        self._streams_refused = 0
        self._was_armed = False
        """Whether a run of the client has armed the vehicle since an operator last allowed
        arming."""

    @property
    def is_ready(self) -> bool:
        return self.parts is not None and self.parts.setup.is_done and self.clock.is_known

    @property
    def waits_for(self) -> str:
        """Reason why the vehicle cannot fly yet, in words; empty if there is none."""
        if self.parts is None:
            return f"a heartbeat of its autopilot at {self._scenario.vehicle.address}"
        setup, launch, _ = self.parts
        if not setup.is_done:
            return setup.waits_for
        return launch.waits_for if self.clock.is_known else self.timesync.fault

    @property
    def failure(self) -> Failure | None:
        if self._unfit or self.parts is None:
            return self._unfit
        return self.parts.setup.failure or self.parts.launch.failure

    def is_quiet(self, *, now_ns: int) -> bool:
        since_ns = self.condition.heard_ns or self._began_ns or now_ns
        return now_ns - since_ns > QUIET_NS

    def take_off(self, *, may_arm: bool, now_ns: int) -> bool:
        # `is_recalled`: an earlier run flew the vehicle since this boot, so it checked the
        # parameters.
        may_fly = self.is_ready or self.positions.is_recalled
        if self.parts is None or not may_fly or self.failure:
            return False
        return self.parts.launch.take_off(may_arm=may_arm and self.is_ready, now_ns=now_ns)

    @property
    def took_off(self) -> bool:
        return self.parts is not None and self.parts.launch.took_off

    def arm(self) -> None:
        if self.parts is None:
            self._was_armed = False
            return
        launch = self.parts.launch
        launch.arm()
        self._was_armed = self._was_armed and bool(launch.why_not_armed)

    def recall(self, saved: VehicleMemory) -> None:
        self._was_armed = saved.armed
        self.positions.recall(saved)

    @property
    def frame(self) -> VehicleMemory:
        return self.positions.frame(armed=self._was_armed or self.took_off)

    def meet(self, heartbeat: Message, target: tuple[int, int]) -> None:
        """Begin the set-up of the autopilot that sent a heartbeat, if its vehicle can be flown.

        `target` has the numbers of the autopilot's system and component.
        """
        if why := unfit(heartbeat):
            self._fail("not flown", why)
            return
        self._target, self.flavour = target, FLAVOURS[heartbeat.autopilot]
        self._set_up()

    def restart(self) -> None:
        """Check the parameters of a restarted autopilot again, unless it flies."""
        if self.parts is not None and self.parts.launch.phase is Phase.GROUND:
            self._set_up()

    def _set_up(self) -> None:
        keys, flavour = self._keys, self.flavour
        self._set_up_ns = None
        setup = Setup(
            self._vehicle,
            flavour,
            self._target,
            keys.system,
            sets=self.sets_parameters,
            returns_below_m=returns_below_m(self._scenario),
            events=self._events,
        )
        launch = Launch(
            self._vehicle,
            flavour,
            self._target,
            altitude=self._altitude,
            patience_ns=self._patience_ns,
            from_takeoff=keys.origin == "takeoff",
            condition=self.condition,
            positions=self.positions,
            events=self._events,
        )
        if self._was_armed:
            launch.why_not_armed = "an earlier run of its client has armed it"
        streams = Streams(rates(flavour, keys.positions_hz), self._target)
        self.parts = Parts(setup, launch, streams)

    def hear(self, message: Message, *, now_ns: int) -> None:
        """Process a message of the autopilot, or ignore it if the autopilot is unsuitable."""
        if self.parts is None:
            return
        condition, (setup, launch, streams) = self.condition, self.parts
        streams.hear(message.get_msgId())
        before = condition.mode, condition.armed
        condition.hear(message, now_ns=now_ns)
        if (condition.mode, condition.armed) != before:
            mode = self.flavour.mode_name(condition.mode)
            self._events.append(
                AutopilotMode(vehicle=self._vehicle, mode=mode, armed=condition.armed)
            )
        match message.get_type():
            case "LOCAL_POSITION_NED":
                self.positions.hear(message, now_ns=now_ns)
            case "GPS_RAW_INT" if condition.has_new_fix:
                receiver = condition.receiver
                self.positions.hear_fix(receiver.velocity, receiver.stamp_ns, now_ns=now_ns)
            case "TIMESYNC":
                if self.timesync.hear(message, now_ns=now_ns):
                    self.restart()
            case "STATUSTEXT":
                text = self._texts.hear(message, now_ns=now_ns)
                if text and message.severity <= WARNING:
                    launch.hear_text(text)
            case "COMMAND_ACK" if message.command == SET_INTERVAL:
                self._hear_interval(message.result, streams.newest)
            case "COMMAND_ACK":
                launch.hear(message)
            case _:
                setup.hear(message)

    def _hear_interval(self, result: int, stream: str) -> None:
        if result in (ACCEPTED, IN_PROGRESS):
            return
        if not self._streams_refused:
            request = f"send {stream} at its rate"
            answer = RESULTS.get(result, f"result {result}")
            self._events.append(
                AutopilotRefused(vehicle=self._vehicle, asked=request, answer=answer)
            )
        self._streams_refused += 1

    def ask(self, *, now_ns: int) -> list[Message]:
        if self._began_ns is None:
            self._began_ns = now_ns
        self._texts.tick(now_ns=now_ns)
        if self.parts is None:
            if now_ns - self._began_ns > self._patience_ns and not self._unfit:
                why = "no heartbeat of an autopilot has arrived, see vehicle.address"
                self._give_up("not heard", why)
            return []
        setup, launch, streams = self.parts
        self._await_clock(setup, now_ns)
        is_heard = self.condition.is_fresh(now_ns=now_ns)
        return [
            *self.timesync.ask(is_heard=is_heard, now_ns=now_ns),
            *setup.ask(now_ns=now_ns),
            *streams.ask(now_ns=now_ns),
            *launch.ask(now_ns=now_ns),
        ]

    def _await_clock(self, setup: Setup, now_ns: int) -> None:
        """Give up if the clock is still unknown long after everything else was ready."""
        if not setup.is_done or self.clock.is_known or self._unfit:
            self._set_up_ns = None
        elif self._set_up_ns is None:
            self._set_up_ns = now_ns
        elif now_ns - self._set_up_ns > self._patience_ns:
            self._give_up("its autopilot's clock is not known", f"it waits for {self.waits_for}")

    def _give_up(self, doing: str, why: str) -> None:
        self._fail(f"{doing} in {self._keys.patience_s:g} s", why)

    def _fail(self, doing: str, why: str) -> None:
        self._unfit = NotTakenOff(vehicle=self._vehicle, doing=doing, why=why)
        self._events.append(self._unfit)
