"""The autopilot's line as an endpoint: what comes from the autopilot, and all that goes to it.

Its own loop sends a heartbeat each second and, while the pilot flies, the velocity that he wants,
never a position. Whatever ends that loop ends the setpoints, and the autopilot's own time-out acts:
nothing in here repeats what was said by somebody who is gone.
"""

import math
from collections import Counter
from typing import Any

from skytether.client.mavlink.clock import BootClock
from skytether.client.mavlink.condition import Condition
from skytether.client.mavlink.flavours import ARDUPILOT, FLAVOURS, Flavour, unfit
from skytether.client.mavlink.launch import Launch, Phase
from skytether.client.mavlink.obedience import Obedience
from skytether.client.mavlink.positions import Positions, Vector
from skytether.client.mavlink.rivals import Rivals
from skytether.client.mavlink.setup import Setup
from skytether.client.mavlink.streams import SET_INTERVAL, Streams
from skytether.client.navigation import Leaps
from skytether.client.vehicle import Frame
from skytether.mavlink.codec import Codec, Message
from skytether.mavlink.dialect import dialect
from skytether.mavlink.frames import turned
from skytether.mavlink.text import Texts
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.core.aboard import (
    AboardEvent,
    AboardFailure,
    AutopilotMode,
    AutopilotRefused,
    AutopilotText,
    NotTakenOff,
    SecondCommander,
    Strays,
)
from skytether.shared.core.endpoint import Address, Datagram, Endpoint, by_name
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
SETPOINTS_MAX_HZ = 50.0
"""Largest number of setpoints in a second."""
LATE = 1.1
"""Share of the time between two setpoints after which one is repeated: a step may come late."""
ZERO_NS = 50 * MILLISECOND_NS
"""Time between two setpoints of zero, where a mode needs a stream of them [ns]."""
FRESH_NS = 200 * MILLISECOND_NS
"""Age up to which a velocity is compared with what was told [ns]."""
CLOSES = 3
"""Times that a vehicle in the air is told to land when its process ends."""
SAME_TEXT_NS = 30 * SECOND_NS
"""Time for which a text is not told again [ns]."""
TEXTS_KEPT = 16
"""Texts that are remembered."""
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

    def __init__(self, scenario: Scenario, vehicle: int, line: Line, altitude: float) -> None:
        super().__init__()
        self._keys = keys = scenario.mavlink
        self._vehicle, self._altitude = vehicle, altitude
        self._peer: Address | None = line.peer
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
        self._texts = Texts()
        self._told_ns: dict[str, int] = {}
        """Texts that were told, and when."""
        self.sets_parameters = False
        """Whether parameters that are not safe are set."""
        self._target: tuple[int, int] | None = None
        """Numbers of the autopilot's system and component; None before it was heard."""
        self._flavour: Flavour = ARDUPILOT
        self._setup: Setup | None = None
        self._launch: Launch | None = None
        self._streams: Streams | None = None
        self._unfit: NotTakenOff | None = None
        self._counts: Counter[str] = Counter()
        self.now_ns = 0
        """Time of the newest call."""
        self._began_ns: int | None = None
        self._tick_ns = 0
        self._beat_ns = self._clock_ns = 0
        """Times of the next heartbeat, and of the next question for the clock."""
        self._velocity = (0.0, 0.0, 0.0)
        """Velocity that is flown, in our axes [m/s]."""
        self._flown_ns: int | None = None
        """Time at which the pilot said so; None before he did."""
        self._sent_ns: int | None = None
        """Time of the newest setpoint."""
        each = scenario.dt_ns
        parts = -(-each * keys.setpoints_hz // SECOND_NS)
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
    def failure(self) -> AboardFailure | None:
        """Event after which the vehicle is not flown."""
        if self._setup is None or self._launch is None:
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
        """Whether it was armed in this life of the client."""
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
        silence_ns = seconds_to_ns(self._keys.silence_s)
        came_ns = self.positions.came_ns
        silent = came_ns is None or now_ns - came_ns > silence_ns
        return Reason.MUTE if silent or not condition.is_fresh(now_ns=now_ns) else None

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
            return
        for message in self._codec.decode(datagram.payload):
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
        keys = self._keys
        self._flavour = flavour = FLAVOURS[message.autopilot]
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
            case "STATUSTEXT":
                self._hear_text(message, launch, now_ns)
            case "COMMAND_ACK" if message.command == SET_INTERVAL:
                self._hear_interval(message.result)
            case "COMMAND_ACK":
                launch.hear(message)
            case _:
                self._setup.hear(message)

    def _hear_text(self, message: Message, launch: Launch, now_ns: int) -> None:
        said = self._texts.take(message)
        if not said:
            return
        text = "".join(letter if letter.isprintable() else "?" for letter in said)
        if message.severity <= WARNING:
            launch.heard_words(text)
        told_ns = self._told_ns.pop(text, None)
        if told_ns is not None and now_ns - told_ns < SAME_TEXT_NS:
            self._told_ns[text] = told_ns
            return
        self._told_ns[text] = now_ns
        if len(self._told_ns) > TEXTS_KEPT:
            del self._told_ns[next(iter(self._told_ns))]
        self._events.append(
            AutopilotText(vehicle=self._vehicle, text=text, severity=message.severity)
        )

    def _hear_interval(self, result: int) -> None:
        """Count a refusal of a stream, and tell the first."""
        if result == dialect.MAV_RESULT_ACCEPTED:
            return
        if not self._counts["streams_refused"]:
            asked, answer = "send a stream at its rate", f"result {result}"
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
        if self._peer is not None and now_ns >= self._beat_ns and not self._is_given_up(now_ns):
            self._beat_ns = now_ns + HEARTBEAT_NS
            self._say(
                dialect.MAVLink_heartbeat_message(
                    dialect.MAV_TYPE_ONBOARD_CONTROLLER,
                    dialect.MAV_AUTOPILOT_INVALID,
                    0,
                    0,
                    dialect.MAV_STATE_ACTIVE,
                    3,
                )
            )
        if self._setup is None or self._launch is None or self._streams is None:
            patience_ns = seconds_to_ns(self._keys.patience_s)
            if self._target is None and now_ns - self._began_ns > patience_ns and not self._unfit:
                why = "no heartbeat of an autopilot has come, see vehicle.address"
                doing = f"not heard in {self._keys.patience_s:g} s"
                self._unfit = NotTakenOff(vehicle=self._vehicle, doing=doing, why=why)
                self._events.append(self._unfit)
            return
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

    def _setpoint_ns(self) -> int | None:
        """Time of the next setpoint; None where none is to be sent."""
        launch, sent_ns = self._launch, self._sent_ns
        if launch is None:
            return None
        if launch.streams_zeros:
            return self.now_ns if sent_ns is None else sent_ns + ZERO_NS
        if not self._may_fly():
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

    def _send_velocity(self, now_ns: int) -> None:
        """Send the velocity that is flown, or zero where a stream of that is wanted."""
        launch = self._launch
        if launch is None or self._target is None:
            return
        if not (launch.streams_zeros or self._may_fly()):
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
