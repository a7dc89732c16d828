"""Companion computer for tests: speaks MAVLink with a scripted autopilot in virtual time."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from skytether.autopilot.endpoint import Autopilot
from skytether.autopilot.faults import parse
from skytether.autopilot.flavours import FLAVOURS, FlavourName, FlightMode
from skytether.mavlink.codec import Codec, Message
from skytether.mavlink.dialect import dialect
from skytether.mavlink.frames import turned
from skytether.mavlink.text import Texts
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.scenario.reading import check

VELOCITY_ONLY = 0b110111000111
"""Type mask of a set-point with velocities only."""
POSITION_AND_VELOCITY = 0b110111000000
ADDRESS = ("127.0.0.1", 40000)
STEP_NS = 20_000_000
LOCAL = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED


class Companion:
    """Companion computer, the autopilot that it flies, and their time.

    Args:
        ready_s: time until the autopilot may be armed [s].
        faults: faults of the autopilot, as on the command line.
        errs: whether the autopilot's velocity estimate has the errors of its flavour.
        vehicle: keys of the scenario's vehicle.
    """

    def __init__(
        self,
        flavour: FlavourName = "ardupilot",
        *,
        ready_s: float | None = 0.5,
        faults: tuple[str, ...] = (),
        seed: int = 1,
        errs: bool = False,
        **vehicle: Any,
    ) -> None:
        scenario = check({"seed": seed, "vehicle": vehicle}, "test")
        self.flavour = FLAVOURS[flavour]
        self.autopilot = Autopilot(
            scenario, flavour, ready_s=ready_s, faults=[parse(each) for each in faults]
        )
        if not errs:
            self.flight.flavour = replace(self.flavour, wander_mps=0.0)
        self.codec = Codec(255, 190)
        self.now_ns = 1_000_000_000
        self.heard: list[tuple[int, Message]] = []
        """Messages that arrived, and when [ns]."""
        self.velocity: tuple[float, float, float] | None = None
        """Set-point that is sent at every step [m/s]; None sends none."""
        self.position: tuple[float, float, float] | None = None
        """Position that is sent with the velocity [m]."""
        self.beats = True
        self.kinds = [18, 6] if self.flavour.bytewise else [18]
        """Types in its heartbeats: PX4 sends its texts only to ground stations."""
        self.autopilot.wake(now_ns=self.now_ns)

    @property
    def flight(self) -> Any:
        return self.autopilot.flight

    def send(self, message: Message, *, address: tuple[str, int] = ADDRESS) -> None:
        self.deliver(self.codec.encode(message), address=address)

    def deliver(self, payload: bytes, *, address: tuple[str, int] = ADDRESS) -> None:
        self.autopilot.receive(Datagram(payload, address), now_ns=self.now_ns)
        self._hear()

    def _hear(self) -> None:
        for payload, peer, _ in self.autopilot.outbox():
            if peer == ADDRESS:
                self.heard += [(self.now_ns, each) for each in self.codec.decode(payload)]

    def run(self, seconds: float, watch: Callable[[], bool] = lambda: False) -> float:
        """Run until a condition holds, for at most `seconds`; returns the time that passed [s]."""
        began_ns = self.now_ns
        until_ns = began_ns + round(1e9 * seconds)
        beat_ns = 0
        while self.now_ns < until_ns and not watch():
            if self.beats and self.now_ns >= beat_ns:
                for kind in self.kinds:
                    self.send(dialect.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3))
                beat_ns = self.now_ns + 1_000_000_000
            if self.velocity is not None:
                self.setpoint()
            for _ in range(4):
                self.now_ns += STEP_NS // 4
                self.autopilot.wake(now_ns=self.now_ns)
                self._hear()
        return (self.now_ns - began_ns) / 1e9

    def setpoint(self, mask: int | None = None) -> None:
        x, y, z = turned(self.position or (0.0, 0.0, 0.0))
        vx, vy, vz = turned(self.velocity or (0.0, 0.0, 0.0))
        if mask is None:
            mask = POSITION_AND_VELOCITY if self.position else VELOCITY_ONLY
        frame = dialect.MAV_FRAME_LOCAL_NED
        message = dialect.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, frame, mask, x, y, z, vx, vy, vz, 0.0, 0.0, 0.0, 0.0, 0.0
        )
        self.send(message)

    def command(self, command: int, *given: float) -> int:
        """Send a command; returns the result in its acknowledgement."""
        padded = [*given, *[0.0] * (7 - len(given))]
        self.send(dialect.MAVLink_command_long_message(1, 1, command, 0, *padded))
        ack = self.last("COMMAND_ACK")
        assert ack.command == command
        return int(ack.result)

    def mode(self, kind: FlightMode) -> int:
        number = self.flavour.number(kind)
        if self.flavour.bytewise:
            return self.command(176, 1.0, number >> 16 & 0xFF, number >> 24)
        return self.command(176, 1.0, number)

    def arm(self) -> int:
        return self.command(400, 1.0)

    def climb(self, altitude: float = 5.0) -> float:
        """Arm, take off and enter guided mode; returns the time of the climb [s]."""
        above_sea = self.flavour.home[2] if self.flavour.bytewise else 0.0
        self.run(1.0)
        if not self.flavour.bytewise:
            assert self.mode(FlightMode.GUIDED) == 0
        assert self.arm() == 0
        assert self.command(22, 0, 0, 0, 0, 0, 0, altitude + above_sea) == 0
        took = self.run(30.0, lambda: abs(self.flight.position()[2] - altitude) < 0.15)
        self.run(3.0)
        if self.flavour.bytewise:
            self.velocity = (0.0, 0.0, 0.0)
            self.run(0.5)
            assert self.mode(FlightMode.GUIDED) == 0
        return took

    def stream(self, rate: float, number: int = LOCAL) -> None:
        assert self.command(511, number, 1e6 / rate) == 0

    def last(self, name: str) -> Message:
        return next(message for _, message in reversed(self.heard) if message.get_type() == name)

    def all(self, name: str) -> list[Message]:
        return [message for _, message in self.heard if message.get_type() == name]

    def texts(self) -> list[str]:
        texts = Texts()
        said = [texts.take(message) for message in self.all("STATUSTEXT")]
        return [text for text in said if text is not None]

    def track(self, since: int = 0) -> np.ndarray:
        """Times [s], positions and velocities in our axes of all received states; shape (n, 7)."""
        rows = [
            (m.time_boot_ms / 1e3, *turned((m.x, m.y, m.z)), *turned((m.vx, m.vy, m.vz)))
            for m in self.all("LOCAL_POSITION_NED")[since:]
        ]
        return np.array(rows)
