"""The check on the bench: what `dropped` and `garbage_bytes` say of the autopilot's line."""

from typing import Any

import numpy as np
import pytest

from airborne import BOTH, SECOND, Air
from skytether.autopilot.flavours import FlavourName
from skytether.mavlink.codec import Codec, Message
from skytether.mavlink.dialect import dialect
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.events.aboard import AutopilotRefused
from skytether.shared.wire.protocol import Mode

BEGINS_S, CHECK_S = 10.0, 60.0
"""Time until the figures of a healthy line stand still, and length of the check [s]."""


class Station(Endpoint):
    """Ground station on another line of the autopilot: a heartbeat each second."""

    def __init__(self) -> None:
        super().__init__()
        self._codec, self._next_ns = Codec(255, 190), 0

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        pass

    def wake(self, *, now_ns: int) -> None:
        self._next_ns = now_ns + SECOND
        beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
        self.send(self._codec.encode(beat), ("autopilot", 0))

    def next_wake_ns(self) -> int:
        return self._next_ns


def checked(air: Air) -> dict[str, Any]:
    """Figures of the line, and by how much `dropped` and `garbage_bytes` have grown in a check."""
    air.world.add("station", Station())
    air.run(BEGINS_S)
    before = air.figures()
    air.run(CHECK_S)
    after = air.figures()
    return after | {
        "grown": sum(after["dropped"].values()) - sum(before["dropped"].values()),
        "garbage": after["garbage_bytes"] - before["garbage_bytes"],
    }


@pytest.mark.parametrize("flavour", BOTH)
def test_a_healthy_line_passes_the_check(flavour: FlavourName) -> None:
    """PX4 passes on what a ground station says, asks for the client's time, and sends messages that
    the dialect does not have.
    """
    air = Air(flavour, armed=False)
    line = checked(air)
    assert (line["grown"], line["garbage"]) == (0, 0)
    if flavour == "px4":
        assert line["ignored"]["foreign"] >= CHECK_S
        assert line["ignored"]["unknown"] >= 0.4 * CHECK_S
    assert not air.of(AutopilotRefused)


def test_flipped_bits_fail_the_check() -> None:
    air, rng = Air("px4", armed=False), np.random.default_rng(1)

    def flipped(message: Message) -> bytes | None:
        frame = bytearray(message.get_msgbuf())
        if rng.random() < 0.99:
            return None
        frame[rng.integers(len(frame))] ^= 1 << int(rng.integers(8))
        return bytes(frame)

    air.tap.alter = flipped
    assert checked(air)["garbage"] > 1000


def test_frames_that_come_twice_fail_the_check() -> None:
    air = Air("px4", armed=False)
    inner = air.tap.outbox
    air.tap.outbox = lambda: [each for each in inner() for _ in range(2)]  # type: ignore[method-assign]
    assert checked(air)["grown"] > 1000


@pytest.mark.parametrize("after_s", np.arange(1.0, 2.0, 0.2))
def test_a_pilot_is_noticed_at_once_though_px4_sends_a_heartbeat_a_second(after_s: float) -> None:
    """PX4 refuses every other rate of heartbeats."""
    air = Air("px4", duration=60.0)
    air.fly()
    air.until(lambda: air.mode is Mode.TRACK, 5.0)
    air.run(after_s)
    air.take_over()
    assert air.until(lambda: air.mode is Mode.MANUAL, 1.5) < 0.35
