"""The connection to the autopilot as an endpoint: all messages from it and to it.

Its own loop sends a heartbeat each second and, while the pilot flies, the desired velocity, never a
position. If this loop ends, so do the set-points, and the autopilot's own time-out acts: nothing
here repeats the command of a pilot that is gone.
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

from skytether.client.mavlink.clock import DRIFT_MAX, BootClock
from skytether.client.mavlink.condition import Condition
from skytether.client.mavlink.flavours import ARDUPILOT, FLAVOURS, Flavour, unfit
from skytether.client.mavlink.launch import (
    ACCEPTED,
    IN_PROGRESS,
    QUIET_NS,
    RESULTS,
    Launch,
    Phase,
)
from skytether.client.mavlink.obedience import Obedience
from skytether.client.mavlink.positions import Positions, Vector
from skytether.client.mavlink.rivals import Rivals
from skytether.client.mavlink.setup import Setup
from skytether.client.mavlink.streams import SET_INTERVAL, Streams
from skytether.client.mavlink.texts import SAME_TEXT_NS, LoggedTexts
from skytether.client.navigation import Leaps
from skytether.client.vehicle import VehicleMemory
from skytether.mavlink.codec import Codec, Message
from skytether.mavlink.dialect import dialect
from skytether.mavlink.frames import turned
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.core.aboard import (
    AboardEvent,
    AboardFailure,
    AutopilotElsewhere,
    AutopilotMode,
    AutopilotMoved,
    AutopilotRefused,
    ClockSilent,
    NotTakenOff,
    PositionsDropped,
    SecondCommander,
    Strays,
)
from skytether.shared.core.endpoint import Address, Datagram, Endpoint, by_name
from skytether.shared.core.events import address_text
from skytether.shared.core.line import Line
from skytether.shared.law.model import ALTITUDE
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason

TICK_NS = 100 * MILLISECOND_NS
"""Interval between checks of what is due beside set-points [ns]."""
HEARTBEAT_NS = SECOND_NS
"""Interval between our heartbeats [ns]."""
CLOCK_BEGIN_NS, CLOCK_NS = 100 * MILLISECOND_NS, SECOND_NS
"""Interval between questions for the autopilot's clock [ns]: before it is known, and after."""
CLOCK_SILENT_NS = 10 * SECOND_NS
"""Time without an answer about the clock after which that is reported [ns]."""
UNFLOWN_NS = 500 * MILLISECOND_NS
"""Time after which a silent pilot counts as gone [ns]; then no set-point is sent."""
SETPOINTS_MIN_HZ, SETPOINTS_MAX_HZ = 20, 50.0
"""Least and largest number of set-points in a second."""
CURRENT_NS = 300 * MILLISECOND_NS
"""Time after a pause of set-points from which on a heartbeat counts as current [ns]: earlier ones
may have waited in a queue."""
LATE = 1.1
"""A set-point is repeated after this many intervals, since a step may come late."""
ZERO_NS = 50 * MILLISECOND_NS
"""Interval between zero set-points, if a mode needs a stream of them [ns]."""
FRESH_NS = 200 * MILLISECOND_NS
"""Age up to which a velocity is compared with the command [ns]."""
CLOSES = 3
"""Number of times that a vehicle in the air is told to land when the process ends."""
ADDRESSES_REPORTED = 4
"""Number of foreign addresses reported while the autopilot is silent."""
VELOCITY_ALONE = 0b110111000111
"""Type mask of a set-point with neither position nor acceleration, nor yaw or yaw rate."""
FRAME = int(dialect.MAV_FRAME_LOCAL_NED)
AUTOPILOT_COMPONENT = int(dialect.MAV_COMP_ID_AUTOPILOT1)
WARNING = int(dialect.MAV_SEVERITY_WARNING)
LOCAL_POSITION = int(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
RATES = {
    int(dialect.MAVLINK_MSG_ID_HEARTBEAT): 5.0,  # so that a pilot's mode switch is seen at once
    int(dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE): 5.0,
    int(dialect.MAVLINK_MSG_ID_ATTITUDE): 10.0,
    int(dialect.MAVLINK_MSG_ID_SYS_STATUS): 2.0,
    int(dialect.MAVLINK_MSG_ID_BATTERY_STATUS): 1.0,
    int(dialect.MAVLINK_MSG_ID_HOME_POSITION): 0.5,
}
"""Requested rates [Hz], beside those of positions and of the estimator status."""


def _start(scenario: Scenario, vehicle: int) -> Vector:
    """Position of take-off, in our axes [m]; on a mission, below its start position."""
    if not scenario.is_mission:
        return 0.0, 0.0, 0.0
    x, y = scenario.start_m(vehicle)[:2].tolist()
    return x, y, 0.0


def given_origin(scenario: Scenario) -> Vector | None:
    """Origin given by a scenario, in our axes [m]; None if it is the place of take-off."""
    match scenario.mavlink.origin:
        case "takeoff":
            return None
        case "autopilot":
            return 0.0, 0.0, 0.0
        case (x, y, *up):
            return float(x), float(y), float(up[0]) if up else 0.0
    raise AssertionError(scenario.mavlink.origin)  # `contradictions` has refused anything else


def returns_below_m(scenario: Scenario) -> float | None:
    """Altitude below which a vehicle without a link returns home [m], infinite without a fence;
    None for a vehicle that lands where it is.
    """
    if scenario.vehicle.on_loss != "return":
        return None
    high = scenario.fence.high_m[ALTITUDE:]
    return high[0] if high else math.inf


class Port(Endpoint):
    """Connection to one autopilot.

    Args:
        scenario: scenario, with its keys of `mavlink`.
        vehicle: number of the vehicle, for events.
        line: address of the autopilot.
        altitude: take-off altitude [m].
    """

    _setup: Setup | None = None
    """Check of its parameters; None, like launch and streams, until the autopilot is heard."""
    _launch: Launch | None = None
    _streams: Streams | None = None
    _unfit: NotTakenOff | None = None
    """Event that an unsuitable or silent vehicle is not flown."""
    _set_up_ns: int | None = None
    """Time at which everything but the clock was ready."""

    def __init__(self, scenario: Scenario, vehicle: int, line: Line, altitude: float) -> None:
        super().__init__()
        self._keys = keys = scenario.mavlink
        self._vehicle, self._altitude = vehicle, altitude
        self._peer: Address | None = line.peer
        self._line, self._may_move = scenario.vehicle.address, line.kind == "udp"
        """Address, and whether the autopilot may have another one after a restart."""
        self._elsewhere: list[Address] = []
        """Other addresses from which something arrived while the autopilot was silent."""
        self._codec = Codec(keys.system, keys.component, stream=line.kind in ("tcp", "serial"))
        self._clock = BootClock()
        self._condition = Condition(keys.battery_min, keys.battery_min_v)
        self.positions = Positions(
            scenario.model.axes,
            self._clock,
            start=_start(scenario, vehicle),
            origin=given_origin(scenario),
            leaps=Leaps(scenario),
        )
        """Measurements."""
        self._texts = LoggedTexts(vehicle, self._events)
        self.sets_parameters = False
        """Whether unsafe parameters are changed."""
        self._target: tuple[int, int] | None = None
        """Numbers of the autopilot's system and component; None until it is heard."""
        self._flavour: Flavour = ARDUPILOT
        self._counts: Counter[str] = Counter()
        self.now_ns = 0
        """Time of the newest call."""
        self._began_ns: int | None = None
        self._jumps, self._reported_unusable, self._reported_silent_clock = 0, False, False
        """Clock jumps up to the newest check of the parameters, and whether it was reported that
        positions cannot be used, and that the clock is not answered."""
        self._tick_ns = 0
        self._heartbeat_ns = self._clock_ns = 0
        """Times of the next heartbeat, and of the next question for the clock."""
        self._velocity = (0.0, 0.0, 0.0)
        """Desired velocity, in our axes [m/s]."""
        self._flown_ns: int | None = None
        """Time of the pilot's newest command; None before the first."""
        self._sent_ns: int | None = None
        """Time of the newest set-point."""
        self._mode_awaited_ns: int | None = None
        """Time since which, after a pause, set-points wait for a current mode; None if they do
        not."""
        step_ns = scenario.dt_ns
        parts = -(-step_ns * SETPOINTS_MIN_HZ // SECOND_NS)
        self._repeat_ns = round(LATE * step_ns / parts)
        self._was_armed = False
        """Whether a run of the client has armed it since an operator last allowed arming."""
        self._rivals, self._obedience = Rivals(), Obedience(scenario)
        self._yields = False
        """Whether a second commander has the vehicle, so that nothing is sent."""
        self._reported_ns: dict[Reason, int] = {}
        """Times at which a second commander was reported, by how it was detected."""
        self._returns_below_m = returns_below_m(scenario)
        self._was_disarmed = False
        """Whether it was disarmed since it flew, so that it is not flown again."""

    # -- what the vehicle asks ---------------------------------------------------------------

    @property
    def is_ready(self) -> bool:
        """Whether the autopilot is connected and configured safely."""
        return self._setup is not None and self._setup.is_done and self._clock.is_known

    @property
    def waits_for(self) -> str:
        """What is missing before the vehicle can be flown, in words; empty if nothing is."""
        if self._setup is None or self._launch is None:
            return f"a heartbeat of its autopilot at {self._line}"
        if not self._setup.is_done:
            return self._setup.waits_for
        return self._launch.waits_for if self._clock.is_known else self._clock_fault()

    def _clock_fault(self) -> str:
        """What is missing until the clock is known, in words."""
        rate = self._clock.wrong_rate
        if rate is None:
            return "an answer of its autopilot to TIMESYNC"
        expected = f"expected 1 within {DRIFT_MAX:.0%}"
        return f"a clock of its autopilot that can be followed: its speed is {rate:.3g}, {expected}"

    @property
    def failure(self) -> AboardFailure | None:
        """Event that makes the vehicle unusable."""
        if self._unfit or self._setup is None or self._launch is None:
            return self._unfit
        return self._setup.failure or self._launch.failure

    @property
    def is_down(self) -> bool:
        """Whether the vehicle needs no more control."""
        return self._launch is None or self._launch.is_down(now_ns=self.now_ns)

    def take_off(self, *, may_arm: bool, now_ns: int) -> bool:
        """Continue the take-off, see `Launch`."""
        self.now_ns = now_ns
        # If an earlier run has flown it since this boot, its parameters were safe.
        may_fly = self.is_ready or self.positions.is_recalled
        if self._launch is None or not may_fly or self.failure:
            return False
        return self._launch.take_off(may_arm=may_arm and self.is_ready, now_ns=now_ns)

    @property
    def took_off(self) -> bool:
        """Whether this run of the client has armed the autopilot."""
        return self._launch is not None and self._launch.took_off

    def recall(self, saved: VehicleMemory) -> None:
        """Restore state saved by an earlier run of the client."""
        self._was_armed = saved.armed
        self.positions.recall(saved)

    @property
    def frame(self) -> VehicleMemory:
        """State that the next run of the client needs."""
        return self.positions.frame(armed=self._was_armed or self.took_off)

    def arm(self) -> None:
        """Allow arming, as an operator said."""
        if self._launch is None:
            self._was_armed = False
            return
        self._launch.arm()
        self._was_armed = self._was_armed and bool(self._launch.why_not_armed)

    def hindrance(self, *, now_ns: int) -> Reason | None:
        """Reason that forbids following a plan now."""
        self.now_ns = now_ns
        condition = self._condition
        if not condition.armed or self._was_disarmed:
            self._was_disarmed = True
            return Reason.DISARMED
        self._yields = False
        if condition.mode != self._flavour.guided:
            self._obedience.begin()
            return Reason.TAKEN
        if rival := self._rival(now_ns):
            self._yields = self._keys.second_commander == "yield"
            return Reason.TAKEN if self._yields else rival
        if condition.is_astray(now_ns=now_ns):
            return Reason.ASTRAY
        if condition.battery_is_low(now_ns=now_ns):
            return Reason.BATTERY
        return self._silence(now_ns)

    def _silence(self, now_ns: int) -> Reason | None:
        """Reason why the autopilot sends nothing usable; None if it does."""
        if not self._is_past(self.positions.came_ns, now_ns):
            self._reported_unusable = False
            return None if self._condition.is_fresh(now_ns=now_ns) else Reason.MUTE
        if self._is_past(self.positions.heard_ns, now_ns):
            return Reason.MUTE
        self._report_unusable()
        return Reason.UNUSABLE

    def _is_past(self, came_ns: int | None, now_ns: int) -> bool:
        """Whether something arrived longer ago than the autopilot may be silent."""
        return came_ns is None or now_ns - came_ns > seconds_to_ns(self._keys.silence_s)

    def _report_unusable(self) -> None:
        """Report once why no position can be used."""
        if self._reported_unusable or not self.positions.fault:
            return
        self._reported_unusable = True
        fault = self.positions.fault
        if (rate := self._clock.wrong_rate) is not None:
            fault += (
                f", and the speed of its clock is {rate:.3g}, expected 1 within {DRIFT_MAX:.0%}"
            )
        self._events.append(PositionsDropped(vehicle=self._vehicle, why=fault))

    def _rival(self, now_ns: int) -> Reason | None:
        """How a second commander was detected; None if there is none."""
        rivals, obedience = self._rivals, self._obedience
        event: AboardEvent
        if rivals.are_there(now_ns=now_ns):
            system, component, content = rivals.newest
            cause = Reason.RIVAL
            event = SecondCommander(
                vehicle=self._vehicle, system=system, component=component, said=content
            )
        elif obedience.strays(now_ns=now_ns):
            cause = Reason.STRAYED
            event = Strays(vehicle=self._vehicle, off_mps=obedience.off_mps)
        else:
            return None
        if now_ns - self._reported_ns.get(cause, -SAME_TEXT_NS) >= SAME_TEXT_NS:
            self._reported_ns[cause] = now_ns
            self._events.append(event)
        return cause

    def fly(self, velocity: tuple[float, float, float]) -> None:
        """Send a velocity now, unless one was just sent, and repeat it for a while."""
        came_ns = self.positions.came_ns
        if came_ns is not None and self.now_ns - came_ns <= FRESH_NS:
            self._obedience.step(velocity, self.positions.velocity, now_ns=self.now_ns)
        else:
            self._obedience.begin()
        self._velocity, self._flown_ns = velocity, self.now_ns
        least_ns = SECOND_NS / SETPOINTS_MAX_HZ
        if self._sent_ns is None or self.now_ns - self._sent_ns >= 0.9 * least_ns:
            self._send_velocity(self.now_ns)

    def return_home(self) -> None:
        """Command the autopilot to return home by itself and land there."""
        if self._launch is not None:
            self._launch.return_home(now_ns=self.now_ns)
            self._tick_ns = self.now_ns

    def land(self) -> None:
        """Command the autopilot to land by itself."""
        if self._launch is not None:
            self._launch.land(now_ns=self.now_ns)
            self._tick_ns = self.now_ns

    # -- what comes --------------------------------------------------------------------------

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """See `Endpoint`."""
        self.now_ns = now_ns
        if self._peer is not None and datagram.peer != self._peer:
            self._counts["elsewhere"] += 1
            if self._is_quiet(now_ns):
                self._hear_elsewhere(datagram, now_ns)
            return
        messages = self._codec.decode(datagram.payload)
        for message in messages:
            sender = message.get_srcSystem(), message.get_srcComponent()
            if self._target is None and message.get_type() == "HEARTBEAT":
                self._meet(message, sender, datagram.peer)
            if sender != self._target:
                self._counts["foreign"] += 1
                self._hear_other(message, sender, now_ns)
            elif not self._is_for_us(message):
                self._counts["for_others"] += 1
            else:
                self._counts["heard"] += 1
                self._hear(message, now_ns)
        if self._target is None and self._is_quiet(now_ns) and self._may_move:
            self._report_elsewhere(datagram.peer, messages)

    def _is_quiet(self, now_ns: int) -> bool:
        """Whether the autopilot has been silent for a while, at its known address."""
        since_ns = self._condition.heard_ns or self._began_ns or now_ns
        return now_ns - since_ns > QUIET_NS

    def _hear_elsewhere(self, datagram: Datagram, now_ns: int) -> None:
        """Follow the autopilot to a new address if that is allowed; otherwise report what
        arrived.
        """
        codec = Codec(self._keys.system, self._keys.component)
        messages = codec.decode(datagram.payload)
        for message in messages:
            sender = message.get_srcSystem(), message.get_srcComponent()
            same = sender == self._target and message.get_type() == "HEARTBEAT"
            if same and self._may_move and self._is_on_the_ground(message):
                self._move(datagram.peer)
                self.receive(datagram, now_ns=now_ns)
                return
        self._report_elsewhere(datagram.peer, messages)

    def _report_elsewhere(self, peer: Address, messages: Sequence[Message]) -> None:
        """Report once per address that its datagrams are not from the autopilot."""
        if peer in self._elsewhere or len(self._elsewhere) == ADDRESSES_REPORTED:
            return
        self._elsewhere.append(peer)
        expected = address_text(*self._peer) if self._peer else self._line
        elsewhere = AutopilotElsewhere(
            vehicle=self._vehicle,
            came_from=address_text(*peer),
            expected=expected,
            content=_content(messages),
        )
        self._events.append(elsewhere)

    def _is_on_the_ground(self, heartbeat: Message) -> bool:
        """Whether the vehicle was disarmed before its silence, and still is."""
        armed = heartbeat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
        return not (self._condition.armed or armed)

    def _move(self, peer: Address) -> None:
        """Continue at the autopilot's new address: it has restarted, so check everything again."""
        assert self._peer is not None
        before, after = address_text(*self._peer), address_text(*peer)
        self._events.append(AutopilotMoved(vehicle=self._vehicle, before=before, after=after))
        self._peer = peer
        self._elsewhere.clear()
        self._set_up_anew()

    def _set_up_anew(self) -> None:
        """Check the parameters of a restarted autopilot again, unless it flies."""
        if self._target is not None and self._launch and self._launch.phase is Phase.GROUND:
            self._set_up(self._target)

    def _hear_other(self, message: Message, sender: tuple[int, int], now_ns: int) -> None:
        """Process a message that is neither from the autopilot nor from us."""
        if self._target is not None and sender != (self._keys.system, self._keys.component):
            self._rivals.hear(message, self._target[0], now_ns=now_ns)

    def _meet(self, message: Message, sender: tuple[int, int], peer: Address) -> None:
        """Adopt the sender of a heartbeat as our autopilot, if it is one."""
        system, component = sender
        if component != AUTOPILOT_COMPONENT or self._keys.autopilot not in (0, system):
            return
        if message.autopilot == dialect.MAV_AUTOPILOT_INVALID:
            return
        self._target, self._peer = sender, peer
        if why := unfit(message):
            self._unfit = NotTakenOff(vehicle=self._vehicle, doing="not flown", why=why)
            self._events.append(self._unfit)
            return
        self._flavour = FLAVOURS[message.autopilot]
        self._set_up(sender)

    def _set_up(self, sender: tuple[int, int]) -> None:
        """Start to check the parameters, and to request streams."""
        keys, flavour = self._keys, self._flavour
        self._set_up_ns = None
        self._setup = Setup(
            self._vehicle,
            flavour,
            sender,
            keys.system,
            sets=self.sets_parameters,
            returns_below_m=self._returns_below_m,
            events=self._events,
        )
        self._launch = Launch(
            self._vehicle,
            flavour,
            sender,
            altitude=self._altitude,
            patience_ns=seconds_to_ns(keys.patience_s),
            from_takeoff=keys.origin == "takeoff",
            condition=self._condition,
            positions=self.positions,
            events=self._events,
        )
        if self._was_armed:
            self._launch.why_not_armed = "an earlier run of its client has armed it"
        estimate = (
            dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT
            if flavour is ARDUPILOT
            else dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS
        )
        rates = RATES | {LOCAL_POSITION: keys.positions_hz, int(estimate): 5.0}
        self._streams = Streams(rates, sender)

    def _is_for_us(self, message: Message) -> bool:
        """Whether a message is for us or for all."""
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        return system in (0, self._keys.system) and component in (0, self._keys.component)

    def _hear(self, message: Message, now_ns: int) -> None:
        condition, launch = self._condition, self._launch
        if self._setup is None or launch is None or self._streams is None:
            return
        self._streams.hear(message.get_msgId())
        before = condition.mode, condition.armed
        condition.hear(message, now_ns=now_ns)
        if (condition.mode, condition.armed) != before:
            mode = self._flavour.mode_name(condition.mode)
            self._events.append(
                AutopilotMode(vehicle=self._vehicle, mode=mode, armed=condition.armed)
            )
        match message.get_type():
            case "LOCAL_POSITION_NED":
                self.positions.hear(message, now_ns=now_ns)
            case "TIMESYNC":
                taken = self._clock.hear(message.tc1, message.ts1, now_ns=now_ns)
                self._counts["untimely"] += not taken
                if self._clock.jumps != self._jumps and self._clock.wrong_rate is None:
                    self._jumps = self._clock.jumps
                    self._set_up_anew()  # as after a reboot
            case "STATUSTEXT":
                text = self._texts.hear(message, now_ns=now_ns)
                if text and message.severity <= WARNING:
                    launch.hear_text(text)
            case "COMMAND_ACK" if message.command == SET_INTERVAL:
                self._hear_interval(message.result)
            case "COMMAND_ACK":
                launch.hear(message)
            case _:
                self._setup.hear(message)

    def _hear_interval(self, result: int) -> None:
        """Count a refused stream, and report the first."""
        if result in (ACCEPTED, IN_PROGRESS):
            return
        if not self._counts["streams_refused"]:
            asked = f"send {self._streams.newest if self._streams else 'a stream'} at its rate"
            answer = RESULTS.get(result, f"result {result}")
            self._events.append(AutopilotRefused(vehicle=self._vehicle, asked=asked, answer=answer))
        self._counts["streams_refused"] += 1

    # -- what goes ---------------------------------------------------------------------------

    def wake(self, *, now_ns: int) -> None:
        """See `Endpoint`."""
        self.now_ns = now_ns
        if self._began_ns is None:
            self._began_ns = now_ns
        if now_ns >= self._tick_ns:
            self._tick_ns = now_ns + TICK_NS
            self._tick(now_ns)
        setpoint_ns = self._setpoint_ns()
        if setpoint_ns is not None and setpoint_ns <= now_ns:
            self._send_velocity(now_ns)

    def next_wake_ns(self) -> int:
        """See `Endpoint`."""
        setpoint_ns = self._setpoint_ns()
        return self._tick_ns if setpoint_ns is None else min(self._tick_ns, setpoint_ns)

    def _tick(self, now_ns: int) -> None:
        assert self._began_ns is not None
        self._texts.tick(now_ns=now_ns)
        if (
            self._peer is not None
            and now_ns >= self._heartbeat_ns
            and not self._is_given_up(now_ns)
        ):
            self._heartbeat_ns = now_ns + HEARTBEAT_NS
            self._say(_heartbeat(dialect.MAV_TYPE_ONBOARD_CONTROLLER))
            if self._may_be_station():
                self._say(_heartbeat(dialect.MAV_TYPE_GCS))
        if self._setup is None or self._launch is None or self._streams is None:
            patience_ns = seconds_to_ns(self._keys.patience_s)
            if self._target is None and now_ns - self._began_ns > patience_ns and not self._unfit:
                why = "no heartbeat of an autopilot has come, see vehicle.address"
                self._give_up("not heard", why)
            return
        self._await_clock(now_ns)
        self._watch_clock(now_ns)
        if now_ns >= self._clock_ns:
            self._clock_ns = now_ns + (CLOCK_NS if self._clock.is_known else CLOCK_BEGIN_NS)
            self._say(dialect.MAVLink_timesync_message(0, self._clock.ask(now_ns=now_ns)))
        for message in (
            *self._setup.ask(now_ns=now_ns),
            *self._streams.ask(now_ns=now_ns),
            *self._launch.ask(now_ns=now_ns),
        ):
            self._say(message)

    def _is_given_up(self, now_ns: int) -> bool:
        """Whether it does not obey the command to land: without our heartbeats its own failsafe
        lands it.
        """
        launch = self._launch
        lands = launch is not None and launch.phase is Phase.LANDING
        return lands and not self._condition.is_fresh(now_ns=now_ns)

    def _may_be_station(self) -> bool:
        """Whether to announce ourselves to PX4 as a ground station too: only those receive its
        texts.

        Not if PX4 reacts to losing its ground station: it would miss the loss of another one.
        """
        setup = self._setup
        return (
            setup is not None
            and setup.is_done
            and self._flavour.words_for_stations
            and setup.value("NAV_DLL_ACT") == 0.0
        )

    def _await_clock(self, now_ns: int) -> None:
        """Give up if everything but the clock has been ready for too long."""
        assert self._setup is not None
        if not self._setup.is_done or self._clock.is_known or self._unfit:
            self._set_up_ns = None
        elif self._set_up_ns is None:
            self._set_up_ns = now_ns
        elif now_ns - self._set_up_ns > seconds_to_ns(self._keys.patience_s):
            self._give_up("its autopilot's clock is not known", f"it waits for {self.waits_for}")

    def _watch_clock(self, now_ns: int) -> None:
        """Report once that the autopilot, which is heard, no longer answers about its clock."""
        was_reported, clock = self._reported_silent_clock, self._clock
        is_heard = self._condition.is_fresh(now_ns=now_ns)
        silent_ns = now_ns - clock.heard_ns if clock.is_known and is_heard else 0
        self._reported_silent_clock = silent_ns > CLOCK_SILENT_NS
        if self._reported_silent_clock and not was_reported:
            silent_s = silent_ns / SECOND_NS
            self._events.append(ClockSilent(vehicle=self._vehicle, silent_s=silent_s))

    def _give_up(self, doing: str, why: str) -> None:
        """Fail because something did not arrive in time."""
        doing = f"{doing} in {self._keys.patience_s:g} s"
        self._unfit = NotTakenOff(vehicle=self._vehicle, doing=doing, why=why)
        self._events.append(self._unfit)

    def _setpoint_ns(self) -> int | None:
        """Time of the next set-point; None if none is to be sent."""
        launch, sent_ns = self._launch, self._sent_ns
        if launch is None:
            return None
        if launch.streams_zeros:
            return self.now_ns if sent_ns is None else sent_ns + ZERO_NS
        if not self._may_fly() or self._mode_awaited_ns is not None:
            return None
        assert self._flown_ns is not None
        due_ns = self._flown_ns if sent_ns is None else sent_ns + self._repeat_ns
        return due_ns if due_ns - self._flown_ns <= UNFLOWN_NS else None

    def _may_fly(self) -> bool:
        """Whether the pilot flies, and the autopilot follows our set-points."""
        condition, launch = self._condition, self._launch
        return (
            launch is not None
            and launch.phase is Phase.FLYING
            and self._flown_ns is not None
            and not (self._was_disarmed or self._yields)
            and condition.armed
            and condition.mode == self._flavour.guided
        )

    def _may_go_on(self, now_ns: int) -> bool:
        """Whether set-points may continue; after a long pause the autopilot has to be heard first.

        PX4 has then left its guided mode, and the first set-point would bring it back.
        """
        if not self._flavour.streams_first or self._sent_ns is None or self._setup is None:
            return True
        loss_s = self._setup.value(self._flavour.time_out) or 0.0
        if self._mode_awaited_ns is None and now_ns - self._sent_ns > seconds_to_ns(loss_s):
            self._mode_awaited_ns = now_ns
        if self._mode_awaited_ns is None:
            return True
        heard_ns = self._condition.heartbeat_ns
        if heard_ns is not None and heard_ns - self._mode_awaited_ns >= CURRENT_NS:
            self._mode_awaited_ns = None
        return self._mode_awaited_ns is None

    def _send_velocity(self, now_ns: int) -> None:
        """Send the desired velocity, or zero if a stream of zeros is needed."""
        launch = self._launch
        if launch is None or self._target is None:
            return
        if not (launch.streams_zeros or (self._may_fly() and self._may_go_on(now_ns))):
            return
        velocity = (0.0, 0.0, 0.0) if launch.streams_zeros else self._velocity
        north, east, down = turned(velocity)
        self._sent_ns = now_ns
        self._counts["setpoints"] += 1
        self._say(
            dialect.MAVLink_set_position_target_local_ned_message(
                self.now_ns // MILLISECOND_NS % 2**32,
                *self._target,
                FRAME,
                VELOCITY_ALONE,
                0.0,
                0.0,
                0.0,
                north,
                east,
                down,
                0.0,
                0.0,
                0.0,
                0.0,
                0.0,
            )
        )

    def _say(self, message: Message) -> None:
        if self._peer is not None:
            self.send(self._codec.encode(message), self._peer)

    def close(self, *, now_ns: int) -> None:
        """See `Endpoint`; a vehicle in the air under our control lands by itself."""
        self.now_ns = now_ns
        if self._launch is None:
            return
        for message in self._launch.close(now_ns=now_ns) * CLOSES:
            self._say(message)

    # -- figures -----------------------------------------------------------------------------

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`; unknown figures are left out."""
        condition, clock, counts = self._condition, self._clock, self._counts
        port_figures: dict[str, Any] = {
            "mode": self._flavour.mode_name(condition.mode),
            "mode_number": condition.mode,
            "armed": int(condition.armed),
            "measurements": self.positions.taken,
            "heard": counts["heard"],
            "setpoints": counts["setpoints"],
            "dropped": {
                name: counts[name] for name in ("foreign", "for_others", "elsewhere", "untimely")
            }
            | by_name(self.positions.dropped),
            "garbage_bytes": self._codec.garbage_bytes,
            "drift_ppm": 1e6 * clock.drift,
        }
        if clock.round_trip_ns is not None:
            port_figures["round_trip_ms"] = clock.round_trip_ns / MILLISECOND_NS
        if condition.charge is not None:
            port_figures["battery"] = condition.charge
        if condition.voltage is not None:
            port_figures["voltage_v"] = condition.voltage
        if condition.home is not None:
            names = ("latitude_deg", "longitude_deg", "altitude_m")
            port_figures["home"] = dict(zip(names, condition.home, strict=True))
        if self._setup is not None and self._setup.fence:
            port_figures["fence"] = self._setup.fence
        return port_figures


def _content(messages: Sequence[Message]) -> str:
    """Content of a datagram in words."""
    if not messages:
        return "what is no MAVLink"
    newest = messages[-1]
    sender = f"system {newest.get_srcSystem()}, component {newest.get_srcComponent()}"
    return f"{newest.get_type()} of {sender}"


def _heartbeat(kind: int) -> Message:
    """Heartbeat of a MAV_TYPE that is not an autopilot."""
    active = dialect.MAV_STATE_ACTIVE
    return dialect.MAVLink_heartbeat_message(kind, dialect.MAV_AUTOPILOT_INVALID, 0, 0, active, 3)
