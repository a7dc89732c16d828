"""Flights over a bad line between client and autopilot, on which others send too.

`python tests/bad_line.py --minutes 60` flies for an hour, and prints the result of each flight.
"""

import argparse
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from heapq import heappop, heappush
from typing import Any, NamedTuple

import numpy as np

from airborne import Air
from bench.autopilots import MODELS
from bench.straight import state_at
from skytether.autopilot.flavours import FlavourName, FlightMode
from skytether.mavlink.codec import Codec, Message
from skytether.mavlink.dialect import dialect
from skytether.mavlink.text import chunks
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.events.aboard import AutopilotMode
from skytether.shared.events.flight import Flying
from skytether.shared.scenario import reading
from skytether.shared.wire.protocol import Mode

CLIENT, AUTOPILOT = ("client", 1), ("autopilot", 0)
LOST, DOUBLED, LATE, CUT, FLIPPED = 0.1, 0.05, 0.05, 0.1, 0.1
"""Shares of frames that are lost, duplicated, delayed, truncated (an additional part), and
corrupted (an additional copy with flipped bits).
"""
LATE_NS = 400 * MILLISECOND_NS
OTHERS_NS = 20 * MILLISECOND_NS
FLIGHT_S = 240.0
SETTLE_S = 20.0
"""Initial time without an error limit, in which the vehicle reaches the reference [s]."""
FENCE = {"low_m": [-7.0, -7.0, 2.0], "high_m": [7.0, 7.0, 8.0]}
STATION, VEHICLE, CAMERA, TWIN = (255, 190), (2, 1), (1, 100), (245, 190)
"""System and component of a ground station, another vehicle, a camera aboard, and a station with
the client's own system number.
"""
MODES = (0, 4, 5, 6, 9, 6 << 16, 3 << 16, 4 << 16 | 6 << 24)
ARM, SET_MODE = 400, 176


class BadLine(Endpoint):
    """Line that loses, duplicates, delays and corrupts frames, and on which others send.

    With `is_bad` false it passes everything on unchanged.
    """

    def __init__(self, seed: int, *, is_bad: bool = True) -> None:
        super().__init__()
        self.is_bad = is_bad
        self._rng = np.random.default_rng(seed)
        self._codecs = {each: Codec(*each) for each in (STATION, VEHICLE, CAMERA, TWIN)}
        self._reader = Codec(9, 9)
        self._held: list[tuple[int, int, bytes, Address]] = []
        """Heap of delayed frames: time [ns], number, frame and receiver."""
        self._others_ns = 0
        self.counts: Counter[str] = Counter()
        self.sent: list[tuple[int, Message]] = []
        """Messages of the client with their times [ns], without heartbeats and requests."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        from_client = datagram.peer == CLIENT
        receiver = AUTOPILOT if from_client else CLIENT
        if from_client:
            for message in self._reader.decode(datagram.payload):
                if message.get_type() in ("COMMAND_LONG", "SET_POSITION_TARGET_LOCAL_NED"):
                    self.sent.append((now_ns, message))
        self.counts["frames"] += 1
        if not self.is_bad:
            self.send(datagram.payload, receiver)
            return
        if self._happens("lost", LOST):
            return
        if self._happens("late", LATE):
            self._hold(datagram.payload, receiver, now_ns)
        else:
            self.send(datagram.payload, receiver)
        if self._happens("doubled", DOUBLED):
            self._hold(datagram.payload, receiver, now_ns)
        if self._happens("cut", CUT):
            self.send(datagram.payload[: self._draw(len(datagram.payload))], receiver)
        if self._happens("flipped", FLIPPED):
            spoilt = bytearray(datagram.payload)
            for _ in range(1 + self._draw(8)):
                spoilt[self._draw(len(spoilt))] ^= 1 << self._draw(8)
            self.send(bytes(spoilt), receiver)

    def _draw(self, count: int) -> int:
        return int(self._rng.integers(count))

    def _happens(self, what: str, share: float) -> bool:
        happens = self._rng.random() < share
        self.counts[what] += happens
        return bool(happens)

    def _hold(self, payload: bytes, receiver: Address, now_ns: int) -> None:
        heappush(self._held, (now_ns + self._draw(LATE_NS), len(self._held), payload, receiver))

    def wake(self, *, now_ns: int) -> None:
        while self._held and self._held[0][0] <= now_ns:
            _, _, payload, receiver = heappop(self._held)
            self.send(payload, receiver)
        if self.is_bad and now_ns >= self._others_ns:
            self._others_ns = now_ns + OTHERS_NS
            self._talk(now_ns // MILLISECOND_NS)

    def next_wake_ns(self) -> int | None:
        if not self.is_bad:
            return None
        return min([self._others_ns, *(each[0] for each in self._held[:1])])

    def _talk(self, now_ms: int) -> None:
        for sender in (VEHICLE, CAMERA, STATION, TWIN):
            said = self._foreign(now_ms)
            self.counts["foreign"] += 1
            self.send(self._codecs[sender].encode(said), CLIENT)
        asked = self._asked(now_ms)
        self.send(self._codecs[STATION].encode(asked), AUTOPILOT)
        for receiver in (CLIENT, AUTOPILOT):
            self.counts["random"] += 1
            noise = self._rng.bytes(1 + self._draw(60))
            start = (b"", b"\xfd", b"\xfe")[self._draw(3)]
            self.send(start + noise, receiver)

    def _foreign(self, now_ms: int) -> Message:
        """Message of another system, dangerous if the client took it for its autopilot's."""
        rng, mode = self._rng, MODES[self._draw(len(MODES))]
        armed, client = 128 * self._draw(2), (245, 191)
        x, y, z, *v = rng.uniform(30.0, 99.0, 6).tolist()
        long = dialect.MAVLink_command_long_message
        makers: list[Callable[[], Message]] = [
            lambda: dialect.MAVLink_heartbeat_message(2, (3, 12)[mode > 99], 1 + armed, mode, 4, 3),
            lambda: dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
            lambda: dialect.MAVLink_local_position_ned_message(now_ms, x, y, -z, *v),
            lambda: dialect.MAVLink_extended_sys_state_message(0, 1 + self._draw(2)),
            lambda: dialect.MAVLink_sys_status_message(0, 0, 0, 0, 9000, 0, 2, 0, 0, 0, 0, 0, 0),
            lambda: dialect.MAVLink_ekf_status_report_message(0, 9.0, 9.0, 9.0, 9.0, 9.0),
            lambda: dialect.MAVLink_estimator_status_message(0, 0, 9.0, 9, 9, 9, 9, 9, 9.0, 9.0),
            lambda: dialect.MAVLink_command_ack_message(
                (ARM, SET_MODE, 22)[self._draw(3)],
                self._draw(5),
                target_system=(0, *client)[self._draw(2)],
            ),
            lambda: dialect.MAVLink_timesync_message(now_ms * 900_000, now_ms * MILLISECOND_NS),
            lambda: dialect.MAVLink_param_value_message(b"GUID_TIMEOUT", 30.0, 9, 500, 7),
            lambda: dialect.MAVLink_param_value_message(b"COM_OF_LOSS_T", 30.0, 9, 500, 7),
            lambda: dialect.MAVLink_param_set_message(1, 1, b"GUID_TIMEOUT", 30.0, 9),
            lambda: long(*client, ARM, 0, float(self._draw(2)), 0, 0, 0, 0, 0, 0),
            lambda: long(1, 1, SET_MODE, 0, 1.0, float(mode % 256), 0, 0, 0, 0, 0),
            lambda: dialect.MAVLink_set_mode_message(1, 1, mode),
            lambda: dialect.MAVLink_set_position_target_local_ned_message(
                now_ms, 2, 1, 1, 0b110111000000, x, y, -z, *v, 0, 0, 0, 0, 0
            ),
            lambda: dialect.MAVLink_home_position_message(
                1, 2, 3, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0
            ),
            lambda: chunks(0, "EMERGENCY! Crash: disarming", self._draw(2))[0],
        ]
        return makers[self._draw(len(makers))]()

    def _asked(self, now_ms: int) -> Message:
        """Request of a ground station to the autopilot, or a command to another vehicle.

        The client receives the autopilot's answers as well.
        """
        mode = MODES[self._draw(len(MODES))]
        long = dialect.MAVLink_command_long_message
        makers: list[Callable[[], Message]] = [
            lambda: dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
            lambda: dialect.MAVLink_timesync_message(0, now_ms * MILLISECOND_NS),
            lambda: dialect.MAVLink_param_request_read_message(1, 1, b"GUID_TIMEOUT", -1),
            lambda: dialect.MAVLink_param_request_list_message(1, 1),
            lambda: long(1, 1, 512, 0, 32.0, 0, 0, 0, 0, 0, 0),  # a position, once
            lambda: long(1, 1, 31000, 0, 0, 0, 0, 0, 0, 0, 0),  # an unknown command
            lambda: long(2, 1, ARM, 0, float(self._draw(2)), 21196.0, 0, 0, 0, 0, 0),
            lambda: long(2, 1, SET_MODE, 0, 1.0, float(mode % 256), 0, 0, 0, 0, 0),
            lambda: dialect.MAVLink_set_mode_message(2, 1, mode),
            lambda: dialect.MAVLink_set_position_target_local_ned_message(
                now_ms, 2, 1, 1, 0b110111000111, 0, 0, 0, 9.0, 9.0, 0, 0, 0, 0, 0, 0
            ),
        ]
        return makers[self._draw(len(makers))]()


class OverLine(Air):
    """Flight of the scenario `autopilot` over a line.

    Args:
        seed: seed of network and line.
        is_bad: whether the line is bad.
    """

    def __init__(
        self, flavour: FlavourName, seed: int, *, is_bad: bool = True, **table: Any
    ) -> None:
        given = reading.to_table(reading.load("autopilot"))
        given |= {"seed": seed, "fence": FENCE, **table}
        given["model"] |= MODELS[flavour]
        given["vehicle"] |= {"address": "udpout:line:0"}
        given["mavlink"] |= {"autopilot": 1}
        super().__init__(flavour, parameters={}, sets=True, **given)
        self.line = BadLine(seed, is_bad=is_bad)
        self.world.add("line", self.line)
        self.had: list[tuple[str, bool]] = []
        """True modes of the autopilot, and whether it was armed, in order."""

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> float:
        """Run as `Air` does, and record the modes of the autopilot."""

        def watched() -> bool:
            now = self.flight.mode_name, self.flight.armed
            if not self.had or self.had[-1] != now:
                self.had.append(now)
            return until()

        return super().run(seconds, watched)

    @property
    def believed(self) -> list[tuple[str, bool]]:
        """Modes and arming that the client believed, in order."""
        return [(each.mode, each.armed) for each in self.of(AutopilotMode)]

    def sent(self, command: int) -> list[int]:
        return [t for t, each in self.line.sent if getattr(each, "command", None) == command]

    def setpoints_from_client(self, since_ns: int) -> int:
        return sum(t >= since_ns and not hasattr(each, "command") for t, each in self.line.sent)


def is_in_order(part: list[Any], whole: list[Any]) -> bool:
    left = iter(whole)
    return all(each in left for each in part)


class Figures(NamedTuple):
    flavour: FlavourName
    seed: int
    rmse_m: float
    """RMS error between true position and reference in the plane [m]."""
    over_m: float
    """Largest distance beyond the fence [m]; negative inside."""
    off_m: float
    pilot_s: float
    """Time until the client yielded to a pilot who took over [s]."""
    arms: int
    frames: int
    foreign: int


def fly(
    flavour: FlavourName, seed: int, *, is_bad: bool = True, duration: float = FLIGHT_S
) -> Figures:
    """Fly until shortly before the end, let a pilot take over, and check the invariants."""
    air = OverLine(flavour, seed, is_bad=is_bad, duration=duration)
    air.run(90.0, lambda: air.flight.armed)
    armed_ns = air.world.now_ns
    arms = air.sent(ARM)
    assert air.flight.armed, air.said()[-5:]
    assert arms, "it armed by itself"
    assert arms[0] <= armed_ns
    air.fly()
    air.run(duration - 5.0 + float(np.random.default_rng(seed).random()))
    assert air.client.failure is None
    assert air.client._failsafe.mode in (Mode.TRACK, Mode.COAST), air.said()[-5:]
    air.flight.act(FlightMode.PILOT, "Pilot has taken over")
    pilot_s = air.run(2.0, lambda: air.client._failsafe.mode is Mode.MANUAL)
    manual_ns = air.world.now_ns
    air.run(2.0)
    assert air.client._failsafe.mode is Mode.MANUAL, air.said()[-5:]
    assert not air.setpoints_from_client(manual_ns + 1)
    assert air.flight.mode is FlightMode.PILOT
    assert is_in_order(air.believed, air.had), (air.believed, air.had)
    return _figures(air, flavour, seed, pilot_s, len(arms))


def _figures(air: OverLine, flavour: FlavourName, seed: int, pilot_s: float, arms: int) -> Figures:
    rows = air.rows()
    rows = rows[rows["mode"] != Mode.MANUAL]
    began_ns = next(t for t, _, event in air.events if isinstance(event, Flying))
    steps_s = rows["step"] * air.scenario.control.dt
    truth = state_at(air.truth.rows(), began_ns + rows["step"] * air.scenario.dt_ns)
    truth = truth[:, :, 0]
    error = truth - air.scenario.make_reference()(steps_s)[:, :, 0]
    settled = steps_s > SETTLE_S
    low, high = np.array(FENCE["low_m"]), np.array(FENCE["high_m"])
    return Figures(
        flavour,
        seed,
        rmse_m=float(np.sqrt(np.mean(np.sum(error[settled, :2] ** 2, axis=1)))),
        over_m=float(np.maximum(low - truth, truth - high).max()),
        off_m=float(np.nanmax(np.linalg.norm(rows["measured"][:, :, 0] - truth, axis=1))),
        pilot_s=pilot_s,
        arms=arms,
        frames=air.line.counts["frames"],
        foreign=air.line.counts["foreign"],
    )


def main() -> None:
    """Fly both flavours in turn for the requested time, and print the results."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    count = -(-options.minutes * 60 // round(FLIGHT_S))
    flavours: list[FlavourName] = [("ardupilot", "px4")[n % 2] for n in range(count)]
    with ProcessPoolExecutor(options.jobs) as pool:
        for told in pool.map(compared, flavours, range(1, count + 1)):
            print(told, flush=True)


def compared(flavour: FlavourName, seed: int) -> str:
    bad, good = fly(flavour, seed), fly(flavour, seed, is_bad=False)
    named = ", ".join(f"{name} {value:.4g}" for name, value in list(bad._asdict().items())[2:])
    return f"{flavour} {seed}: {named}; {bad.rmse_m / good.rmse_m:.2f} times that of a good line"


if __name__ == "__main__":
    main()
