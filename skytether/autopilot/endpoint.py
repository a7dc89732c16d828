"""Autopilot as an endpoint: MAVLink in datagrams, and the simulated flight of a quadrotor.

The autopilot sends to its peers: addresses given at the start, and each address from which a
MAVLink message has come. Each peer has its own streams, as each link of a real autopilot has.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any

import numpy as np

from skytether.autopilot.ardupilot import ArduPilot
from skytether.autopilot.faults import Script, ScriptedFault
from skytether.autopilot.flavours import FLAVOURS, FlavourName, FlightMode
from skytether.autopilot.flight import TICK_NS, PilotedVehicle, Result
from skytether.autopilot.px4 import PX4
from skytether.autopilot.telemetry import HEARTBEAT, STREAMS, Telemetry
from skytether.mavlink import parameters
from skytether.mavlink.codec import Codec, Message
from skytether.mavlink.dialect import dialect
from skytether.mavlink.frames import turned
from skytether.mavlink.text import chunks
from skytether.quadrotor.frames import FRAMES
from skytether.quadrotor.quadrotor import Quadrotor
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.events.aboard import AutopilotSaid
from skytether.shared.scenario.catalogue import keys_of
from skytether.shared.scenario.owners import InFlight
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Recorder

SYSTEM, COMPONENT = 1, int(dialect.MAV_COMP_ID_AUTOPILOT1)
"""System and component id of the autopilot."""
PEERS_MAX = 8
"""Largest number of peers at once; a new peer replaces the peer that was silent longest."""
PATIENCE_NS = SECOND_NS
"""Silence after which a peer may be replaced [ns]."""
BEHIND_MAX_NS = SECOND_NS
"""Longest time that is simulated at once after a late wake [ns]; time beyond it is skipped."""
FORCE = 21196.0
"""Magic number that forces arming or disarming."""

TRUTH_COLUMNS: np.dtype[np.void] = np.dtype(
    [
        ("time_ns", "<i8"),  # time on the autopilot's clock
        ("state", "<f8", (3, 2)),  # true position [m] and velocity [m/s]
    ]
)
"""Columns of a simulated autopilot's recording: one row per tick."""

PILOTS: dict[FlavourName, type[PilotedVehicle]] = {"ardupilot": ArduPilot, "px4": PX4}
POSITION_IGNORED, VELOCITY_IGNORED = 0b111, 0b111000
"""Bits of a set-point's type mask: ignore the position, and ignore the velocity."""
ACCELERATION_IGNORED = 0b111000000


class Peer:
    """Peer to which the autopilot sends.

    Args:
        pinned: whether the peer is kept even if it is silent for long.
        rates: initial rates of the peer's streams [Hz], by message id.
        now_ns: time now, on the autopilot's clock.
    """

    def __init__(
        self, address: Address, *, pinned: bool, rates: dict[int, float], now_ns: int
    ) -> None:
        self.address, self.pinned = address, pinned
        self.codec = Codec(SYSTEM, COMPONENT)
        self.heard_ns = now_ns
        self.is_station = False
        self.streams: dict[int, tuple[int, int]] = {}
        """Interval of each stream [ns] and time of its next message, by message id."""
        for number, rate in {HEARTBEAT: 1.0, **rates}.items():
            self.streams[number] = round(SECOND_NS / rate), now_ns

    def every(self, number: int, interval_ns: int, now_ns: int) -> None:
        """Start to send a message at an interval, at most once per tick."""
        interval_ns = max(interval_ns, TICK_NS)
        self.streams[number] = interval_ns, now_ns + interval_ns

    def due(self, now_ns: int) -> list[int]:
        """Ids of the messages that are due now; each message is scheduled again."""
        numbers = [number for number, (_, next_ns) in self.streams.items() if next_ns <= now_ns]
        for number in numbers:
            interval_ns, next_ns = self.streams[number]
            self.streams[number] = interval_ns, max(next_ns + interval_ns, now_ns)
        return numbers


class Autopilot(Endpoint):
    """Simulated vehicle that speaks MAVLink.

    Args:
        scenario: only its frame, battery, wind and seed are used.
        peers: addresses to which the vehicle sends from the start.
        ready_s: time until the vehicle may be armed; None for the flavour's default.
        recorder: takes the true state at each tick, as rows of TRUTH_COLUMNS.
    """

    changeable = keys_of(InFlight.WIND)

    def __init__(
        self,
        scenario: Scenario,
        flavour: FlavourName,
        *,
        peers: Sequence[Address] = (),
        ready_s: float | None = None,
        faults: Sequence[ScriptedFault] = (),
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__()
        self._flavour = FLAVOURS[flavour]
        vehicle = scenario.vehicle
        quadrotor = Quadrotor(
            FRAMES[self._flavour.frame if vehicle.frame == "auto" else vehicle.frame],
            self._flavour.gains,
            stream(scenario.seed, "autopilot"),
            position=np.zeros(3),
            ground_m=0.0,
            charge=vehicle.battery,
            hovers=False,
        )
        quadrotor.blow(vehicle.steady_wind_mps, vehicle.turbulence_mps)
        ready_s = self._flavour.ready_s if ready_s is None else ready_s
        self.flight = PILOTS[flavour](
            self._flavour, quadrotor, ready_s, stream(scenario.seed, "estimate")
        )
        self._telemetry = Telemetry(self.flight)
        self.script = Script(faults)
        self._recorder = recorder
        self._began_ns: int | None = None
        """Time at which the autopilot's own clock began [ns; the driver's clock]."""
        self._peers: dict[Address, Peer] = {}
        for address in peers:
            self._meet(address, pinned=True)
        self._reader = Codec(SYSTEM, COMPONENT)
        self._texts = 0
        self._counts: Counter[str] = Counter()
        self._handlers: dict[str, Callable[[Message, Peer, int], None]] = {
            "HEARTBEAT": self._on_heartbeat,
            "TIMESYNC": self._on_timesync,
            "PARAM_REQUEST_READ": self._on_parameter_read,
            "PARAM_SET": self._on_parameter_set,
            "COMMAND_LONG": self._on_command,
            "COMMAND_INT": self._on_command,
            "SET_MODE": self._on_mode,
            "SET_POSITION_TARGET_LOCAL_NED": self._on_setpoint,
        }

    # Driver interface

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self._fly(now_ns)
        messages = self._reader.decode(datagram.payload)
        peer = self._peers.get(datagram.peer)
        for message in messages:
            if message.get_srcSystem() == SYSTEM:  # an echo, or a message from a system with our id
                self._counts["foreign"] += 1
                continue
            peer = peer or self._meet(datagram.peer)
            if peer is None:
                self._counts["refused"] += 1
                return
            peer.heard_ns = self.flight.now_ns
            handler = self._handlers.get(message.get_type())
            if handler is None or not _is_ours(message):
                self._counts["foreign"] += 1
                continue
            self._counts["heard"] += 1
            handler(message, peer, now_ns)
        self._speak()

    def wake(self, *, now_ns: int) -> None:
        self._fly(now_ns)

    def next_wake_ns(self) -> int:
        return 0 if self._began_ns is None else self._began_ns + self.flight.now_ns + TICK_NS

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:  # noqa: ARG002
        """Set a new wind; no other key may change in flight."""
        vehicle = scenario.vehicle
        self.flight.quadrotor.blow(vehicle.steady_wind_mps, vehicle.turbulence_mps)

    def figures(self) -> dict[str, Any]:
        x, y, z = self.flight.position()
        names = ("heard", "foreign", "refused", "setpoints", "commands", "rejected", "sent")
        return {
            "peers": len(self._peers),
            "garbage_bytes": self._reader.garbage_bytes,
            **{name: self._counts[name] for name in names},
            "armed": int(self.flight.armed),
            "mode": self.flight.number,
            "battery": self.flight.quadrotor.battery().charge,
            "position_m": {"x": x, "y": y, "z": z},
        }

    # Flight and telemetry

    def _fly(self, now_ns: int) -> None:
        """Fly until `now_ns`, tick by tick, and send the messages due at each tick."""
        if self._began_ns is None:
            self._began_ns = now_ns
        behind_ns = now_ns - self._began_ns - self.flight.now_ns
        if behind_ns > BEHIND_MAX_NS:
            self._began_ns += behind_ns - BEHIND_MAX_NS
        while self._began_ns + self.flight.now_ns + TICK_NS <= now_ns:
            self.script.play(self.flight)
            self.flight.tick()
            self._record(self._began_ns + self.flight.now_ns)
            self._speak()
            for peer in self._peers.values():
                for number in peer.due(self.flight.now_ns):
                    self._tell(peer, number)

    def _record(self, time_ns: int) -> None:
        if self._recorder is not None:
            x, y, z = self.flight.position()
            vx, vy, vz = self.flight.quadrotor.velocity().tolist()
            self._recorder.append_row(time_ns, x, vx, y, vy, z, vz)

    def _meet(self, address: Address, *, pinned: bool = False) -> Peer | None:
        """Add a peer, and return it; None if PEERS_MAX peers are active."""
        now_ns = self.flight.now_ns
        if len(self._peers) == PEERS_MAX:
            others = [peer for peer in self._peers.values() if not peer.pinned]
            oldest = min(others, key=lambda peer: peer.heard_ns, default=None)
            if oldest is None or now_ns - oldest.heard_ns < PATIENCE_NS:
                return None
            del self._peers[oldest.address]
        peer = Peer(address, pinned=pinned, rates=self._flavour.streams, now_ns=now_ns)
        self._peers[address] = peer
        return peer

    def _send(self, peer: Peer, message: Message) -> None:
        if not self.script.silent:
            self._counts["sent"] += 1
            self.send(peer.codec.encode(message), peer.address)

    def _tell(self, peer: Peer, number: int) -> bool:
        """Send a peer a telemetry message by its id; returns whether there is such a message."""
        make = STREAMS.get(number)
        message = make(self._telemetry) if make else None
        if message is not None:
            self._send(peer, message)
        return make is not None

    def _speak(self) -> None:
        for severity, text in self.flight.said:
            self.tell(AutopilotSaid(text=text, severity=int(severity)))
            self._texts = self._texts % 65535 + 1
            for message in chunks(int(severity), text, self._texts):
                for peer in self._peers.values():
                    if peer.is_station or not self._flavour.words_for_stations:
                        self._send(peer, message)
        self.flight.said.clear()

    # Incoming messages

    def _on_heartbeat(self, message: Message, peer: Peer, now_ns: int) -> None:  # noqa: ARG002
        peer.is_station |= message.type == dialect.MAV_TYPE_GCS
        for other in self._peers.values() if self._flavour.forwards else ():
            if other is not peer and not self.script.silent:
                self.send(bytes(message.get_msgbuf()), other.address)
        if self.flight.is_station(message.get_srcSystem(), message.type):
            self.flight.station_ns = self.flight.now_ns

    def _on_timesync(self, message: Message, peer: Peer, now_ns: int) -> None:
        if message.tc1 == 0:
            assert self._began_ns is not None
            own_ns = now_ns - self._began_ns
            self._send(peer, dialect.MAVLink_timesync_message(own_ns, message.ts1))

    def _on_parameter_read(self, message: Message, peer: Peer, now_ns: int) -> None:  # noqa: ARG002
        names = list(self.flight.parameters)
        index, name = message.param_index, message.param_id
        if 0 <= index < len(names):
            name = names[index]
        if name in self.flight.parameters:
            self._send(peer, self._telemetry.parameter(name))

    def _on_parameter_set(self, message: Message, peer: Peer, now_ns: int) -> None:  # noqa: ARG002
        name, before = message.param_id, self.flight.parameters.get(message.param_id)
        if before is None:
            return
        kind = parameters.type_of(before) if self._flavour.bytewise else message.param_type
        value = parameters.from_wire(message.param_value, kind, bytewise=self._flavour.bytewise)
        if value is not None:
            self.flight.set(name, round(value) if isinstance(before, int) else float(value))
        for receiver in self._peers.values():
            self._send(receiver, self._telemetry.parameter(name))

    def _on_mode(self, message: Message, peer: Peer, now_ns: int) -> None:  # noqa: ARG002
        self._acknowledge(
            peer, message, dialect.MAVLINK_MSG_ID_SET_MODE, self.flight.switch(message.custom_mode)
        )

    def _on_setpoint(self, message: Message, peer: Peer, now_ns: int) -> None:  # noqa: ARG002
        mask = message.type_mask
        velocity = (0.0, 0.0, 0.0)
        position = None
        if not mask & VELOCITY_IGNORED:
            velocity = turned((message.vx, message.vy, message.vz))
        if not mask & POSITION_IGNORED:
            position = turned((message.x, message.y, message.z))
        numbers = (*velocity, *(position or ()))
        is_usable = position is not None or not mask & VELOCITY_IGNORED
        if (
            is_usable
            and mask & ACCELERATION_IGNORED == ACCELERATION_IGNORED
            and message.coordinate_frame == dialect.MAV_FRAME_LOCAL_NED
            and all(map(isfinite, numbers))
        ):
            self._counts["setpoints"] += 1
            self.flight.want(velocity, position)
        else:
            self._counts["rejected"] += 1

    def _on_command(self, message: Message, peer: Peer, now_ns: int) -> None:  # noqa: ARG002
        long = message.get_type() == "COMMAND_LONG"
        seventh = message.param7 if long else message.z
        parameters = (message.param1, message.param2, message.param3, seventh)
        result = self._obey(message.command, parameters, peer)
        self._counts["commands" if result is Result.ACCEPTED else "rejected"] += 1
        self._acknowledge(peer, message, message.command, result)

    def _obey(self, command: int, given: tuple[float, float, float, float], peer: Peer) -> Result:
        """Execute a command, if possible.

        Args:
            command: MAV_CMD.
            given: parameters 1, 2, 3 and 7 of the command.
            peer: sender of the command.
        """
        first, second, third, seventh = given
        flight = self.flight
        match command:
            case dialect.MAV_CMD_COMPONENT_ARM_DISARM:
                result = flight.arm() if first == 1.0 else flight.disarm(force=second == FORCE)
            case dialect.MAV_CMD_DO_SET_MODE:
                result = flight.switch(flight.mode_number(_whole(second), _whole(third)))
            case dialect.MAV_CMD_NAV_TAKEOFF:
                result = flight.take_off(seventh)
            case dialect.MAV_CMD_NAV_LAND:
                result = flight.switch(self._flavour.number(FlightMode.LAND))
            case dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                result = flight.switch(self._flavour.number(FlightMode.RETURN))
            case dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
                result = self._set_interval(_whole(first), second, peer)
            case dialect.MAV_CMD_REQUEST_MESSAGE:
                result = Result.ACCEPTED if self._tell(peer, _whole(first)) else Result.DENIED
            case _:
                result = Result.UNSUPPORTED
        return result

    def _set_interval(self, number: int, interval_us: float, peer: Peer) -> Result:
        """Set the interval of a peer's stream; 0 restores the default, below 0 stops the stream."""
        if number not in STREAMS or not isfinite(interval_us):
            return Result.DENIED
        if number == HEARTBEAT and self._flavour.fixed_heartbeats:
            return Result.FAILED
        if interval_us == 0.0:
            rate = {HEARTBEAT: 1.0, **self._flavour.streams}.get(number)
            interval_us = 1e6 / rate if rate else -1.0
        if interval_us < 0.0:
            peer.streams.pop(number, None)
        else:
            peer.every(number, round(1000.0 * interval_us), self.flight.now_ns)
        return Result.ACCEPTED

    def _acknowledge(self, peer: Peer, message: Message, command: int, result: Result) -> None:
        self._speak()
        system, component = message.get_srcSystem(), message.get_srcComponent()
        self._send(
            peer,
            dialect.MAVLink_command_ack_message(
                command, int(result), target_system=system, target_component=component
            ),
        )


def _is_ours(message: Message) -> bool:
    """Whether a message is addressed to this system, or to all."""
    system = getattr(message, "target_system", 0)
    component = getattr(message, "target_component", 0)
    return system in (0, SYSTEM) and component in (0, COMPONENT)


def _whole(value: float) -> int:
    """Integer value of a command's float parameter; -1 if the value is not an integer."""
    return int(value) if isfinite(value) and value == int(value) else -1
