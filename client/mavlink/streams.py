"""Streams of messages, requested again if they do not arrive.

If the rate of an autopilot's heartbeats is fixed, additional heartbeats are requested one by one.
"""

from collections.abc import Mapping

from skytether.client.mavlink.flavours import ARDUPILOT, Flavour
from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.shared.base.units import SECOND_NS

SET_INTERVAL = int(dialect.MAV_CMD_SET_MESSAGE_INTERVAL)
HEARTBEAT = int(dialect.MAVLINK_MSG_ID_HEARTBEAT)
SHARE = 0.7
"""Share of the requested rate at which a stream counts as present."""
WINDOW_NS = 2 * SECOND_NS
"""Shortest window in which messages are counted [ns]; longer if LEAST messages take more time."""
LEAST = 3.0
BACK_OFF_MAX = 8
"""Longest window of a missing stream, as a multiple of its shortest window."""
HEARTBEAT_HZ = 5.0
"""Requested rate of heartbeats [Hz]; they show when a pilot switches the mode."""
RATES = {
    int(dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE): 5.0,
    int(dialect.MAVLINK_MSG_ID_ATTITUDE): 10.0,
    int(dialect.MAVLINK_MSG_ID_GPS_RAW_INT): 5.0,
    int(dialect.MAVLINK_MSG_ID_SYS_STATUS): 2.0,
    int(dialect.MAVLINK_MSG_ID_BATTERY_STATUS): 1.0,
    int(dialect.MAVLINK_MSG_ID_HOME_POSITION): 0.5,
}
"""Requested rates of messages other than heartbeats, positions and estimator status [Hz]."""


def rates(flavour: Flavour, positions_hz: float) -> dict[int, float]:
    """Requested rate of each message [Hz], by its number; `positions_hz`: rate of positions."""
    estimate = (
        dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT
        if flavour is ARDUPILOT
        else dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS
    )
    position = int(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    requested = RATES | {position: positions_hz, int(estimate): 5.0}
    return requested if flavour.fixed_heartbeats else {HEARTBEAT: HEARTBEAT_HZ} | requested


def request(target: tuple[int, int], number: int) -> Message:
    """Request for one message of a type; `target`: numbers of system and component."""
    command, wanted = dialect.MAV_CMD_REQUEST_MESSAGE, float(number)
    return dialect.MAVLink_command_long_message(
        *target, command, 0, wanted, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    )


class _Stream:
    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.count = 0
        self.least_ns = max(WINDOW_NS, round(LEAST / rate * SECOND_NS))
        self.window_ns = 0
        """Length of the present window [ns]; 0 before the first window."""
        self.until_ns = 0
        """End of the window [ns]; a stream with too few messages is then requested again."""


class Streams:
    """Streams of one autopilot.

    Args:
        rates: rate of each message [Hz], by its number.
        target: numbers of the autopilot's system and component.
    """

    def __init__(self, rates: Mapping[int, float], target: tuple[int, int]) -> None:
        self._target = target
        self.newest = ""
        self._streams = {number: _Stream(rate) for number, rate in rates.items()}
        self._heartbeat_ns = 0
        """Time of the next request for a heartbeat [ns], if heartbeats are requested one by one."""

    def hear(self, number: int) -> None:
        if number in self._streams:
            self._streams[number].count += 1

    def ask(self, *, now_ns: int) -> list[Message]:
        """Requests that are due: for a heartbeat, and for the next missing stream."""
        if HEARTBEAT in self._streams or now_ns < self._heartbeat_ns:
            return self._ask_stream(now_ns)
        self._heartbeat_ns = now_ns + round(SECOND_NS / HEARTBEAT_HZ)
        return [request(self._target, HEARTBEAT), *self._ask_stream(now_ns)]

    def _ask_stream(self, now_ns: int) -> list[Message]:
        for number, stream in self._streams.items():
            if now_ns < stream.until_ns:
                continue
            expected = stream.rate * stream.window_ns / SECOND_NS
            comes = stream.window_ns > 0 and stream.count >= SHARE * expected
            longer_ns = min(2 * stream.window_ns, BACK_OFF_MAX * stream.least_ns)
            stream.window_ns = stream.least_ns if comes else max(stream.least_ns, longer_ns)
            stream.until_ns, stream.count = now_ns + stream.window_ns, 0
            if not comes:
                self.newest = dialect.mavlink_map[number].msgname
                command = dialect.MAVLink_command_long_message(
                    *self._target,
                    SET_INTERVAL,
                    0,
                    float(number),
                    1e6 / stream.rate,
                    0.0,
                    0.0,
                    0.0,
                    0.0,
                    0.0,
                )
                return [command]
        return []
