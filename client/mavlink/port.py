"""The autopilot's line as an endpoint: what comes from the autopilot, and all that goes to it.

Its own loop sends a heartbeat each second and, while the pilot flies, the velocity that he wants,
never a position. Whatever ends that loop ends the setpoints, and the autopilot's own time-out acts:
nothing in here repeats what was said by somebody who is gone.
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
from skytether.client.vehicle import Frame
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
"""Time between two looks at what is due beside setpoints [ns]."""
HEARTBEAT_NS = SECOND_NS
"""Time between two heartbeats of ours [ns]."""
CLOCK_BEGIN_NS, CLOCK_NS = 100 * MILLISECOND_NS, SECOND_NS
"""Time between two questions for the autopilot's clock [ns]: before it is known, and then."""
UNFLOWN_NS = 500 * MILLISECOND_NS
"""Time after which a pilot that says nothing is gone [ns]: then nothing is sent either."""
SETPOINTS_MIN_HZ, SETPOINTS_MAX_HZ = 20, 50.0
"""Least and largest number of setpoints in a second."""
LOOK_NS = 300 * MILLISECOND_NS
"""Time after a pause of setpoints from which on a heartbeat tells of now [ns]: those before it may
have waited for us in a queue."""
LATE = 1.1
"""Share of the time between two setpoints after which one is repeated: a step may come late."""
ZERO_NS = 50 * MILLISECOND_NS
"""Time between two setpoints of zero, where a mode needs a stream of them [ns]."""
FRESH_NS = 200 * MILLISECOND_NS
"""Age up to which a velocity is compared with what was told [ns]."""
CLOSES = 3
"""Times that a vehicle in the air is told to land when its process ends."""
ADDRESSES_TOLD = 4
"""Most addresses of others that are told while the autopilot is silent."""
VELOCITY_ALONE = 0b110111000111
"""Type mask of a setpoint: neither position nor acceleration, nor yaw or its rate."""
FRAME = int(dialect.MAV_FRAME_LOCAL_NED)
AUTOPILOT_COMPONENT = int(dialect.MAV_COMP_ID_AUTOPILOT1)
WARNING = int(dialect.MAV_SEVERITY_WARNING)
LOCAL_POSITION = int(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
RATES = {
    int(dialect.MAVLINK_MSG_ID_HEARTBEAT): 5.0,  # so that a pilot's switch is seen at once
    int(dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE): 5.0,
    int(dialect.MAVLINK_MSG_ID_ATTITUDE): 10.0,
    int(dialect.MAVLINK_MSG_ID_SYS_STATUS): 2.0,
    int(dialect.MAVLINK_MSG_ID_BATTERY_STATUS): 1.0,
    int(dialect.MAVLINK_MSG_ID_HOME_POSITION): 0.5,
}
"""Rates that are asked for [Hz], beside those of positions and of the estimate's health."""


def _start(scenario: Scenario, vehicle: int) -> Vector:
    """Place of take-off, in our axes [m]: on a mission, below where it begins."""
    if not scenario.is_mission:
        return 0.0, 0.0, 0.0
    x, y = scenario.start_m(vehicle)[:2].tolist()
    return x, y, 0.0


def given_origin(scenario: Scenario) -> Vector | None:
    """Origin that a scenario states, in our axes [m]; None of one that is where it takes off."""
    match scenario.mavlink.origin:
        case "takeoff":
            return None
        case "autopilot":
            return 0.0, 0.0, 0.0
        case (x, y, *up):
            return float(x), float(y), float(up[0]) if up else 0.0
    raise AssertionError(scenario.mavlink.origin)  # `contradictions` has refused it


def returns_below_m(scenario: Scenario) -> float | None:
    """Altitude below which a lost vehicle returns home [m], infinite without a fence; None of one
    that lands where it is.
    """
    if scenario.vehicle.on_loss != "return":
        return None
    high = scenario.fence.high_m[ALTITUDE:]
    return high[0] if high else math.inf


class Port(Endpoint):
    """Line to one autopilot.

    Args:
        scenario: its keys of `mavlink`.
        vehicle: number of the vehicle, for what is told.
        line: where the autopilot is.
        altitude: altitude to take off to [m].
    """

    _setup: Setup | None = None
    """Judge of its parameters; None, as its launch and its streams, before it was heard."""
    _launch: Launch | None = None
    _streams: Streams | None = None
    _unfit: NotTakenOff | None = None
    """Event after which it is not flown, of one that is unfit or was not heard."""
    _set_up_ns: int | None = None
    """Time at which all was set up but the clock."""

    def __init__(self, scenario: Scenario, vehicle: int, line: Line, altitude: float) -> None:
        super().__init__()
        self._keys = keys = scenario.mavlink
        self._vehicle, self._altitude = vehicle, altitude
        self._peer: Address | None = line.peer
        self._line, self._may_move = scenario.vehicle.address, line.kind == "udp"
        """Line, and whether the autopilot may have another address on it after a restart."""
        self._elsewhere: list[Address] = []
        """Other addresses from which something came while the autopilot was silent."""
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
        """Whether parameters that are not safe are set."""
        self._target: tuple[int, int] | None = None
        """Numbers of the autopilot's system and component; None before it was heard."""
        self._flavour: Flavour = ARDUPILOT
        self._counts: Counter[str] = Counter()
        self.now_ns = 0
        """Time of the newest call."""
        self._began_ns: int | None = None
        self._jumps, self._unusable = 0, False
        """Jumps of the clock before it was set up; whether it was told that positions are
        dropped."""
        self._tick_ns = 0
        self._beat_ns = self._clock_ns = 0
        """Times of the next heartbeat, and of the next question for the clock."""
        self._velocity = (0.0, 0.0, 0.0)
        """Velocity that is flown, in our axes [m/s]."""
        self._flown_ns: int | None = None
        """Time at which the pilot said so; None before he did."""
        self._sent_ns: int | None = None
        """Time of the newest setpoint."""
        self._looks_ns: int | None = None
        """Time since which setpoints wait for the mode to be heard, after a pause; else None."""
        each = scenario.dt_ns
        parts = -(-each * SETPOINTS_MIN_HZ // SECOND_NS)
        self._repeat_ns = round(LATE * each / parts)
        self._was_armed = False
        """Whether a life of the client has armed it since a person last said that it may be."""
        self._rivals, self._obedience = Rivals(), Obedience(scenario)
        self._yields = False
        """Whether a second commander has the vehicle: nothing is sent."""
        self._said_ns: dict[Reason, int] = {}
        """Times at which a second commander was told of, by the way it was noticed."""
        self._returns_below_m = returns_below_m(scenario)
        self._was_disarmed = False
        """Whether it was disarmed since it flew: it is not flown again."""

    # -- what the vehicle asks ---------------------------------------------------------------

    @property
    def is_ready(self) -> bool:
        """Whether the autopilot is there, and set up safely."""
        return self._setup is not None and self._setup.is_done and self._clock.is_known

    @property
    def waits_for(self) -> str:
        """What is missing before the vehicle can be flown, in words; empty where nothing is."""
        if self._setup is None or self._launch is None:
            return f"a heartbeat of its autopilot at {self._line}"
        if not self._setup.is_done:
            return self._setup.waits_for
        return self._launch.waits_for if self._clock.is_known else self._clock_fault()

    def _clock_fault(self) -> str:
        """What is missing of a clock that is not known, in words."""
        rate = self._clock.wrong_rate
        if rate is None:
            return "an answer of its autopilot to TIMESYNC"
        expected = f"expected 1 within {DRIFT_MAX:.0%}"
        return f"a clock of its autopilot that can be followed: its speed is {rate:.3g}, {expected}"

    @property
    def failure(self) -> AboardFailure | None:
        """Event after which the vehicle is not flown."""
        if self._unfit or self._setup is None or self._launch is None:
            return self._unfit
        return self._setup.failure or self._launch.failure

    @property
    def is_down(self) -> bool:
        """Whether the vehicle needs no more care."""
        return self._launch is None or self._launch.is_down(now_ns=self.now_ns)

    def take_off(self, *, may_arm: bool, now_ns: int) -> bool:
        """Go on with the take-off, see `Launch`."""
        self.now_ns = now_ns
        # Where an earlier life has flown it since this boot, its parameters were safe.
        may_fly = self.is_ready or self.positions.is_recalled
        if self._launch is None or not may_fly or self.failure:
            return False
        return self._launch.take_off(may_arm=may_arm and self.is_ready, now_ns=now_ns)

    @property
    def took_off(self) -> bool:
        """Whether this run of the client has armed the autopilot."""
        return self._launch is not None and self._launch.took_off

    def recall(self, frame: Frame) -> None:
        """Take what an earlier life of the client has kept."""
        self._was_armed = frame.armed
        self.positions.recall(frame)

    @property
    def frame(self) -> Frame:
        """What the next life of the client needs to know."""
        return self.positions.frame(armed=self._was_armed or self.took_off)

    def arm(self) -> None:
        """Take a person's word that the vehicle may be armed."""
        if self._launch is None:
            self._was_armed = False
            return
        self._launch.arm()
        self._was_armed = self._was_armed and bool(self._launch.waits_for_word)

    def hindrance(self, *, now_ns: int) -> Reason | None:
        """Cause for which the vehicle must not follow a plan now."""
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
        """Cause that the autopilot says nothing that can be used, if that is so."""
        if not self._is_past(self.positions.came_ns, now_ns):
            self._unusable = False
            return None if self._condition.is_fresh(now_ns=now_ns) else Reason.MUTE
        if self._is_past(self.positions.heard_ns, now_ns):
            return Reason.MUTE
        self._tell_unusable()
        return Reason.UNUSABLE

    def _is_past(self, came_ns: int | None, now_ns: int) -> bool:
        """Whether something came longer ago than the autopilot may be silent."""
        return came_ns is None or now_ns - came_ns > seconds_to_ns(self._keys.silence_s)

    def _tell_unusable(self) -> None:
        """Say once why no position can be used."""
        if self._unusable or not self.positions.fault:
            return
        self._unusable = True
        fault = self.positions.fault
        if (rate := self._clock.wrong_rate) is not None:
            fault += (
                f", and the speed of its clock is {rate:.3g}, expected 1 within {DRIFT_MAX:.0%}"
            )
        self._events.append(PositionsDropped(vehicle=self._vehicle, why=fault))

    def _rival(self, now_ns: int) -> Reason | None:
        """How a second commander is noticed; None where there is none."""
        rivals, obedience = self._rivals, self._obedience
        event: AboardEvent
        if rivals.are_there(now_ns=now_ns):
            system, component, said = rivals.newest
            cause = Reason.RIVAL
            event = SecondCommander(
                vehicle=self._vehicle, system=system, component=component, said=said
            )
        elif obedience.strays(now_ns=now_ns):
            cause = Reason.STRAYED
            event = Strays(vehicle=self._vehicle, off_mps=obedience.off_mps)
        else:
            return None
        if now_ns - self._said_ns.get(cause, -SAME_TEXT_NS) >= SAME_TEXT_NS:
            self._said_ns[cause] = now_ns
            self._events.append(event)
        return cause

    def fly(self, velocity: tuple[float, float, float]) -> None:
        """Send a velocity now, unless one was sent just before, and repeat it for a while."""
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
        """Command the autopilot to return home by itself, and to land there."""
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
            self._tell_elsewhere(datagram.peer, messages)

    def _is_quiet(self, now_ns: int) -> bool:
        """Whether the autopilot has been silent for a while, at the address that it has."""
        since_ns = self._condition.heard_ns or self._began_ns or now_ns
        return now_ns - since_ns > QUIET_NS

    def _hear_elsewhere(self, datagram: Datagram, now_ns: int) -> None:
        """Take the autopilot from its new address, where it may have one, or say what comes."""
        codec = Codec(self._keys.system, self._keys.component)
        messages = codec.decode(datagram.payload)
        for message in messages:
            sender = message.get_srcSystem(), message.get_srcComponent()
            same = sender == self._target and message.get_type() == "HEARTBEAT"
            if same and self._may_move and self._is_on_the_ground(message):
                self._move(datagram.peer)
                self.receive(datagram, now_ns=now_ns)
                return
        self._tell_elsewhere(datagram.peer, messages)

    def _tell_elsewhere(self, peer: Address, messages: Sequence[Message]) -> None:
        """Say once of each address that what comes from there is not the autopilot's."""
        if peer in self._elsewhere or len(self._elsewhere) == ADDRESSES_TOLD:
            return
        self._elsewhere.append(peer)
        expected = address_text(*self._peer) if self._peer else self._line
        said = AutopilotElsewhere(
            vehicle=self._vehicle,
            came_from=address_text(*peer),
            expected=expected,
            content=_content(messages),
        )
        self._events.append(said)

    def _is_on_the_ground(self, heartbeat: Message) -> bool:
        """Whether the vehicle was disarmed before its silence, and says so now."""
        armed = heartbeat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
        return not (self._condition.armed or armed)

    def _move(self, peer: Address) -> None:
        """Go on with the autopilot at another address: it has restarted, so all is set up anew."""
        assert self._peer is not None
        before, after = address_text(*self._peer), address_text(*peer)
        self._events.append(AutopilotMoved(vehicle=self._vehicle, before=before, after=after))
        self._peer = peer
        self._elsewhere.clear()
        self._set_up_anew()

    def _set_up_anew(self) -> None:
        """Look at the parameters of an autopilot that has restarted, before a flight alone."""
        if self._target is not None and self._launch and self._launch.phase is Phase.GROUND:
            self._set_up(self._target)

    def _hear_other(self, message: Message, sender: tuple[int, int], now_ns: int) -> None:
        """Take a message of neither the autopilot nor us."""
        if self._target is not None and sender != (self._keys.system, self._keys.component):
            self._rivals.hear(message, self._target[0], now_ns=now_ns)

    def _meet(self, message: Message, sender: tuple[int, int], peer: Address) -> None:
        """Take who sends a heartbeat for our autopilot, if it is one."""
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
        """Begin to look at the parameters, and to ask for streams."""
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
            self._launch.waits_for_word = "an earlier run of its client has armed it"
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
                    launch.heard_words(text)
            case "COMMAND_ACK" if message.command == SET_INTERVAL:
                self._hear_interval(message.result)
            case "COMMAND_ACK":
                launch.hear(message)
            case _:
                self._setup.hear(message)

    def _hear_interval(self, result: int) -> None:
        """Count a refusal of a stream, and tell the first."""
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
        if self._peer is not None and now_ns >= self._beat_ns and not self._is_given_up(now_ns):
            self._beat_ns = now_ns + HEARTBEAT_NS
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
        """Whether it is to land, and does not say that it does: without our heartbeats its own
        failsafe lands it.
        """
        launch = self._launch
        lands = launch is not None and launch.phase is Phase.LANDING
        return lands and not self._condition.is_fresh(now_ns=now_ns)

    def _may_be_station(self) -> bool:
        """Whether we tell PX4 that we are a ground station too: it says nothing in words to others.

        Not where PX4 acts when it loses its ground station: it would miss the loss of another one.
        """
        setup = self._setup
        return (
            setup is not None
            and setup.is_done
            and self._flavour.words_for_stations
            and setup.value("NAV_DLL_ACT") == 0.0
        )

    def _await_clock(self, now_ns: int) -> None:
        """Give up where everything but the clock was set up long ago."""
        assert self._setup is not None
        if not self._setup.is_done or self._clock.is_known or self._unfit:
            self._set_up_ns = None
        elif self._set_up_ns is None:
            self._set_up_ns = now_ns
        elif now_ns - self._set_up_ns > seconds_to_ns(self._keys.patience_s):
            self._give_up("its autopilot's clock is not known", f"it waits for {self.waits_for}")

    def _give_up(self, doing: str, why: str) -> None:
        """Fail: something has not come in time."""
        doing = f"{doing} in {self._keys.patience_s:g} s"
        self._unfit = NotTakenOff(vehicle=self._vehicle, doing=doing, why=why)
        self._events.append(self._unfit)

    def _setpoint_ns(self) -> int | None:
        """Time of the next setpoint; None where none is to be sent."""
        launch, sent_ns = self._launch, self._sent_ns
        if launch is None:
            return None
        if launch.streams_zeros:
            return self.now_ns if sent_ns is None else sent_ns + ZERO_NS
        if not self._may_fly() or self._looks_ns is not None:
            return None
        assert self._flown_ns is not None
        due_ns = self._flown_ns if sent_ns is None else sent_ns + self._repeat_ns
        return due_ns if due_ns - self._flown_ns <= UNFLOWN_NS else None

    def _may_fly(self) -> bool:
        """Whether the pilot flies, and the autopilot obeys us."""
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
        """Whether setpoints may go on; after a long pause the autopilot has to be heard first.

        PX4 has left its guided mode then, and the first setpoint would bring it back by itself.
        """
        if not self._flavour.streams_first or self._sent_ns is None or self._setup is None:
            return True
        loss_s = self._setup.value(self._flavour.time_out) or 0.0
        if self._looks_ns is None and now_ns - self._sent_ns > seconds_to_ns(loss_s):
            self._looks_ns = now_ns
        if self._looks_ns is None:
            return True
        heard_ns = self._condition.heartbeat_ns
        if heard_ns is not None and heard_ns - self._looks_ns >= LOOK_NS:
            self._looks_ns = None
        return self._looks_ns is None

    def _send_velocity(self, now_ns: int) -> None:
        """Send the velocity that is flown, or zero where a stream of that is wanted."""
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
        """See `Endpoint`; a vehicle in the air that is ours lands by itself."""
        self.now_ns = now_ns
        if self._launch is None:
            return
        for message in self._launch.close(now_ns=now_ns) * CLOSES:
            self._say(message)

    # -- figures -----------------------------------------------------------------------------

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`; what is not known is left out."""
        condition, clock, counts = self._condition, self._clock, self._counts
        told: dict[str, Any] = {
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
            told["round_trip_ms"] = clock.round_trip_ns / MILLISECOND_NS
        if condition.charge is not None:
            told["battery"] = condition.charge
        if condition.voltage is not None:
            told["voltage_v"] = condition.voltage
        if condition.home is not None:
            names = ("latitude_deg", "longitude_deg", "altitude_m")
            told["home"] = dict(zip(names, condition.home, strict=True))
        if self._setup is not None and self._setup.fence:
            told["fence"] = self._setup.fence
        return told


def _content(messages: Sequence[Message]) -> str:
    """Content of a datagram in words."""
    if not messages:
        return "what is no MAVLink"
    newest = messages[-1]
    sender = f"system {newest.get_srcSystem()}, component {newest.get_srcComponent()}"
    return f"{newest.get_type()} of {sender}"


def _heartbeat(kind: int) -> Message:
    """Heartbeat of a MAV_TYPE that is no autopilot."""
    active = dialect.MAV_STATE_ACTIVE
    return dialect.MAVLink_heartbeat_message(kind, dialect.MAV_AUTOPILOT_INVALID, 0, 0, active, 3)
