"""Ground station that flies an autopilot by set-points only, as autopilots are usually flown.

    heartbeat → streams requested, clock offset known → armed, climbed (`client.mavlink.launch`)
              → a set-point at every step of the flight → landed

Every request is repeated until it is confirmed, because the network may lose it. While a pilot or
the autopilot itself flies the vehicle, the station sends nothing, and it does not take control back
afterwards.
"""

import numpy as np

from bench.laws import Heard, Law, Setpoint, setpoint
from skytether.client.clock import BootClock
from skytether.client.mavlink.condition import Condition
from skytether.client.mavlink.flavours import FLAVOURS, PX4, Flavour, unfit
from skytether.client.mavlink.launch import Launch
from skytether.client.mavlink.positions import Positions
from skytether.client.mavlink.vehicle import altitude
from skytether.client.vehicle import Measurement
from skytether.mavlink.codec import Codec, Message
from skytether.mavlink.dialect import dialect
from skytether.mavlink.frames import turned
from skytether.mavlink.text import Texts
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.events.aboard import AutopilotText, NotTakenOff
from skytether.shared.events.flight import Finished, Flying
from skytether.shared.law.model import Array
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Recorder

SYSTEM, COMPONENT = 255, int(dialect.MAV_COMP_ID_MISSIONPLANNER)
"""System and component id of the ground station; ArduPilot accepts commands of this system id."""
VEHICLE = 1
TICK_NS = 100 * MILLISECOND_NS
"""Interval at which requests other than set-points are checked [ns]."""
HEARTBEAT_NS = SECOND_NS
CLOCK_BEGIN_NS, CLOCK_NS = 200 * MILLISECOND_NS, 5 * SECOND_NS
"""Intervals of requests for the autopilot's clock, before the flight and during it [ns]."""
STREAM_NS = 500 * MILLISECOND_NS
"""Interval of stream requests [ns], one stream after the other, until the flight begins, because
the network loses some. A stream starts again when it is requested again, so its interval of
requests must be longer than that of its messages.
"""
AGE_MAX_NS = 10 * SECOND_NS
"""Largest usable age of a position, and longest usable round-trip time [ns]."""
FRAME = int(dialect.MAV_FRAME_LOCAL_NED)
VELOCITY_ALONE, POSITION_AND_VELOCITY = 0b110111000111, 0b110111000000
"""Type masks of set-points, with neither acceleration nor yaw."""
SET_INTERVAL = int(dialect.MAV_CMD_SET_MESSAGE_INTERVAL)
LOCAL_POSITION = int(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
SLOW = (
    int(dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE),
    int(dialect.MAVLINK_MSG_ID_HOME_POSITION),
)
"""Messages that the take-off needs, requested once a second."""
UNASKED = (int(dialect.MAVLINK_MSG_ID_ATTITUDE), int(dialect.MAVLINK_MSG_ID_SYS_STATUS))
"""Messages that PX4 sends unrequested, and that the station does not use."""


def station_columns(axes: int) -> np.dtype[np.void]:
    """Columns of the ground station's part: one row per step."""
    return np.dtype(
        [
            ("time_ns", "<i8"),
            ("step", "<i8"),
            ("input", "<f8", (axes,)),  # velocity of the set-point [m/s]
            ("measured", "<f8", (axes,)),  # newest position received [m]; NaN before the first
            ("age_ns", "<i8"),  # age of that position; -1 before the first
            # whether the station was in control of the autopilot, and so sent a set-point
            ("obeyed", "?"),
            ("late", "<i8"),  # number of positions so far that arrived after newer ones
        ]
    )


class Station(Endpoint):
    """Ground station that flies one vehicle.

    Args:
        law: law that chooses set-points.
        recorder: takes one row per step, see `station_columns`.

    Raises:
        ConfigError: the scenario's flight begins on the ground.
    """

    def __init__(self, scenario: Scenario, law: Law, recorder: Recorder | None = None) -> None:
        super().__init__()
        self._law, self._recorder = law, recorder
        self._axes = scenario.model.axes
        self._dt_ns, self._steps = scenario.dt_ns, scenario.steps
        self._reference = scenario.make_reference()
        self._altitude = altitude(scenario)
        self._may_arm = scenario.armed
        self._patience_ns = seconds_to_ns(scenario.mavlink.patience_s)
        self._codec = Codec(SYSTEM, COMPONENT)
        self._clock = BootClock(AGE_MAX_NS)
        self._condition = Condition(0.0, 0.0)
        self._positions = Positions(self._axes, self._clock, AGE_MAX_NS)
        self._texts = Texts()
        self._peer: Address | None = None
        self._target = (0, 0)
        self._flavour: Flavour | None = None
        self._launch: Launch | None = None
        self._failure: NotTakenOff | None = None
        self.setpoints = 0
        """Number of set-points sent."""
        self._since_ns: int | None = None
        """Start of the wait for the autopilot [ns]: first for a heartbeat, then for its time."""
        self._tick_ns = self._beat_ns = self._clock_ns = self._stream_ns = 0
        """Times of the next tick, heartbeat, clock request and stream request [ns]."""
        self._asked = 0
        self._epoch_ns: int | None = None
        self._step_ns = 0
        self._step = 0
        self._newest: Measurement | None = None

    @property
    def failure(self) -> NotTakenOff | None:
        return self._failure or (self._launch.failure if self._launch else None)

    @property
    def finished(self) -> bool:
        if not (self._is_over or self.failure):
            return False
        now_ns = self._tick_ns - TICK_NS
        return self._launch is None or self._launch.is_down(now_ns=now_ns)

    @property
    def _is_over(self) -> bool:
        return self._step >= self._steps

    # -- incoming ----------------------------------------------------------------------------

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        for message in self._codec.decode(datagram.payload):
            sender = message.get_srcSystem(), message.get_srcComponent()
            if self._peer is None and message.get_type() == "HEARTBEAT":
                self._meet(message, sender, datagram.peer)
            if sender != self._target or datagram.peer != self._peer:
                continue
            if self._launch is not None:
                self._hear(message, self._launch, now_ns)

    def _meet(self, message: Message, sender: tuple[int, int], peer: Address) -> None:
        """Accept the sender of an autopilot's heartbeat as the vehicle."""
        if sender[1] != dialect.MAV_COMP_ID_AUTOPILOT1:
            return
        self._target, self._peer = sender, peer
        self._since_ns = None
        if why := unfit(message):
            self._fail("not flown", why)
            return
        self._flavour = FLAVOURS[message.autopilot]
        self._launch = Launch(
            VEHICLE,
            self._flavour,
            sender,
            altitude=self._altitude,
            patience_ns=self._patience_ns,
            from_takeoff=False,
            condition=self._condition,
            positions=self._positions,
            events=self._events,
        )

    def _hear(self, message: Message, launch: Launch, now_ns: int) -> None:
        self._condition.hear(message, now_ns=now_ns)
        match message.get_type():
            case "LOCAL_POSITION_NED":
                self._positions.hear(message, now_ns=now_ns)
            case "TIMESYNC":
                self._clock.hear(message.tc1, message.ts1, now_ns=now_ns)
            case "COMMAND_ACK":
                launch.hear(message)
            case "STATUSTEXT" if text := self._texts.take(message):
                printable_text = "".join(each if each.isprintable() else "?" for each in text)
                if message.severity <= dialect.MAV_SEVERITY_WARNING:
                    launch.hear_text(printable_text)
                self._events.append(
                    AutopilotText(vehicle=VEHICLE, text=printable_text, severity=message.severity)
                )

    def _fail(self, doing: str, why: str) -> None:
        self._failure = NotTakenOff(vehicle=VEHICLE, doing=doing, why=why)
        self._events.append(self._failure)

    # -- outgoing ---------------------------------------------------------------------------

    def next_wake_ns(self) -> int | None:
        if self.finished:
            return None
        return min(self._tick_ns, self._step_ns) if self._streams else self._tick_ns

    @property
    def _streams(self) -> bool:
        """Whether set-points are due: in flight, and as zeros before a mode that needs them."""
        flies = self._epoch_ns is not None and not self._is_over
        return flies or (self._launch is not None and self._launch.streams_zeros)

    def wake(self, *, now_ns: int) -> None:
        if now_ns >= self._tick_ns:
            self._tick_ns = now_ns + TICK_NS
            self._tick(now_ns)
        if self._streams and now_ns >= self._step_ns:
            if self._epoch_ns is None:
                self._step_ns = now_ns + self._dt_ns
                zeros = np.zeros(self._axes)
                self._say_setpoint(Setpoint(zeros, None))
            else:
                self._fly(self._epoch_ns, now_ns)

    def _tick(self, now_ns: int) -> None:
        launch = self._launch
        self._wait(now_ns)
        if launch is None or self._failure:
            return
        if now_ns >= self._beat_ns:
            self._beat_ns = now_ns + HEARTBEAT_NS
            kind, none = dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID
            active = dialect.MAV_STATE_ACTIVE
            self._say(dialect.MAVLink_heartbeat_message(kind, none, 0, 0, active, 3))
        flies = self._epoch_ns is not None
        if now_ns >= self._clock_ns:
            self._clock_ns = now_ns + (CLOCK_NS if flies else CLOCK_BEGIN_NS)
            self._say(dialect.MAVLink_timesync_message(0, self._clock.ask(now_ns=now_ns)))
        if not flies:
            self._begin(launch, now_ns)
        for message in launch.ask(now_ns=now_ns):
            self._say(message)

    def _wait(self, now_ns: int) -> None:
        """Fail if the autopilot has not answered within a time limit."""
        self._since_ns = now_ns if self._since_ns is None else self._since_ns
        if self._clock.is_known or self._failure or now_ns - self._since_ns <= self._patience_ns:
            return
        waited = f"in {self._patience_ns / SECOND_NS:g} s"
        if self._launch is None:
            self._fail(f"not heard {waited}", "no heartbeat of an autopilot has come")
        else:
            self._fail(f"no time told {waited}", "TIMESYNC is not answered")

    def _begin(self, launch: Launch, now_ns: int) -> None:
        """Request the next stream and continue the take-off; once it is done, start the flight."""
        if now_ns >= self._stream_ns:
            self._stream_ns = now_ns + STREAM_NS
            self._ask_stream()
        if self._clock.is_known and launch.take_off(may_arm=self._may_arm, now_ns=now_ns):
            self._epoch_ns = self._step_ns = now_ns
            self._events.append(Flying(vehicle=VEHICLE))

    def _ask_stream(self) -> None:
        intervals = {LOCAL_POSITION: self._dt_ns / 1e3, **dict.fromkeys(SLOW, 1e6)}
        if self._flavour is PX4:
            intervals |= dict.fromkeys(UNASKED, -1.0)
        number, interval_us = list(intervals.items())[self._asked % len(intervals)]
        self._asked += 1
        self._say(
            dialect.MAVLink_command_long_message(
                *self._target, SET_INTERVAL, 0, float(number), interval_us, 0.0, 0.0, 0.0, 0.0, 0.0
            )
        )

    def _fly(self, epoch_ns: int, now_ns: int) -> None:
        """Send the set-point of the present step, unless a pilot or the autopilot flies."""
        launch = self._launch
        assert launch is not None
        time_s = (now_ns - epoch_ns) / SECOND_NS
        measured = self._positions.take(now_ns=now_ns)
        self._newest = newest = measured[-1] if measured else self._newest
        heard = None
        if newest is not None and newest.position is not None:
            then_s = (newest.stamp_ns - epoch_ns) / SECOND_NS
            heard = Heard(then_s, np.array(newest.position))
        chosen = setpoint(self._law, self._reference, time_s, heard)
        obeys = self._obeys
        if obeys:
            self._say_setpoint(chosen)
        self._record(now_ns, chosen.velocity, obeys=obeys)
        self._step += 1
        self._step_ns = epoch_ns + self._step * self._dt_ns
        if self._is_over:
            self._events.append(Finished(vehicle=VEHICLE, steps=self._steps, missed=0))
            launch.land(now_ns=now_ns)

    @property
    def _obeys(self) -> bool:
        """Whether the vehicle was armed and in the mode for set-points, by its newest message."""
        assert self._flavour is not None
        return self._condition.armed and self._condition.mode == self._flavour.guided

    def _record(self, now_ns: int, velocity: Array, *, obeys: bool) -> None:
        if self._recorder is None:
            return
        newest = self._newest
        position = newest.position if newest and newest.position else [np.nan] * self._axes
        age_ns = now_ns - newest.stamp_ns if newest else -1
        late = self._positions.dropped["late"]
        numbers = (*velocity.tolist(), *position)
        self._recorder.append_row(now_ns, self._step, *numbers, age_ns, obeys, late)

    def _say_setpoint(self, chosen: Setpoint) -> None:
        x, y, *up = chosen.velocity.tolist()
        velocity = turned((x, y, up[0] if up else 0.0))
        place, mask = (0.0, 0.0, 0.0), VELOCITY_ALONE
        if chosen.position is not None:
            x, y, *up = chosen.position.tolist()
            place = turned((x, y, up[0] if up else self._altitude))
            mask = POSITION_AND_VELOCITY
        self.setpoints += 1
        unused = (0.0, 0.0, 0.0, 0.0, 0.0)
        self._say(
            dialect.MAVLink_set_position_target_local_ned_message(
                0, *self._target, FRAME, mask, *place, *velocity, *unused
            )
        )

    def _say(self, message: Message) -> None:
        assert self._peer is not None
        self.send(self._codec.encode(message), self._peer)
