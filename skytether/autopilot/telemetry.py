"""Telemetry: MAVLink messages made from a flight."""

import math
from collections.abc import Callable
from struct import pack

from skytether.autopilot.flavours import CURRENT_MODE
from skytether.autopilot.flight import Landed, PilotedVehicle, Vector
from skytether.mavlink import parameters
from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.mavlink.frames import turned
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.formats.geographic import EARTH_M

HEARTBEAT = int(dialect.MAVLINK_MSG_ID_HEARTBEAT)
SENSORS = int(
    dialect.MAV_SYS_STATUS_SENSOR_GPS
    | dialect.MAV_SYS_STATUS_AHRS
    | dialect.MAV_SYS_STATUS_SENSOR_BATTERY
    | dialect.MAV_SYS_STATUS_PREARM_CHECK
)
"""Sensors whose health SYS_STATUS reports."""
KNOWS_ALL, KNOWS_ATTITUDE = 831, 167
"""Status flags of an estimate with and without a position, as ArduPilot and PX4 send them."""
UNKNOWN_MV = 65535
"""Voltage sent for a missing cell [mV]."""
CURRENT_MODE_EXTRA = 193
"""CRC_EXTRA of CURRENT_MODE: the byte of this message type that enters the checksum."""


class CurrentMode:
    """CURRENT_MODE, which pymavlink's dialect lacks; `mode` is the number of the mode."""

    def __init__(self, mode: int) -> None:
        self._payload = pack("<IIB", mode, mode, 0)

    def pack(self, mavlink: dialect.MAVLink) -> bytes:
        ids = mavlink.seq, mavlink.srcSystem, mavlink.srcComponent
        head = bytes([len(self._payload), 0, 0, *ids])
        checked = head + CURRENT_MODE.to_bytes(3, "little") + self._payload
        crc = dialect.x25crc(checked + bytes([CURRENT_MODE_EXTRA])).crc
        return b"\xfd" + checked + pack("<H", crc)


class Telemetry:
    def __init__(self, flight: PilotedVehicle) -> None:
        self._flight = flight

    @property
    def _boot_ms(self) -> int:
        return self._flight.now_ns // MILLISECOND_NS

    def heartbeat(self) -> Message:
        flight = self._flight
        base = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        base |= dialect.MAV_MODE_FLAG_SAFETY_ARMED if flight.armed else 0
        state = dialect.MAV_STATE_ACTIVE if flight.armed else dialect.MAV_STATE_STANDBY
        return dialect.MAVLink_heartbeat_message(
            dialect.MAV_TYPE_QUADROTOR, flight.flavour.autopilot, base, flight.number, state, 3
        )

    def local_position(self) -> Message | None:
        if not self._flight.ready:
            return None
        position = turned(self._flight.estimate())
        velocity = turned(self._flight.velocity())
        return dialect.MAVLink_local_position_ned_message(
            self._boot_ms,
            position[0],
            position[1],
            position[2],
            velocity[0],
            velocity[1],
            velocity[2],
        )

    def _globe(self, place: Vector) -> tuple[int, int, int]:
        """Latitude and longitude [1e-7 degrees], and altitude above the sea [mm]."""
        north, east, up = place
        latitude, longitude, altitude = self._flight.flavour.home
        degree_m = math.radians(1.0) * EARTH_M
        longitude += east / (degree_m * math.cos(math.radians(latitude)))
        return (
            round(1e7 * (latitude + north / degree_m)),
            round(1e7 * longitude),
            round(1e3 * (altitude + up)),
        )

    def gps(self) -> Message:
        """Message of the GPS receiver. It reports no fix until the estimate is ready."""
        flight = self._flight
        has_fix = flight.ready and flight.fixes
        fix = dialect.GPS_FIX_TYPE_3D_FIX if has_fix else dialect.GPS_FIX_TYPE_NO_FIX
        place, (north, east, _) = flight.received()
        latitude, longitude, altitude_mm = self._globe(place) if has_fix else (0, 0, 0)
        return dialect.MAVLink_gps_raw_int_message(
            1000 * self._boot_ms if flight.flavour.stamps_fixes else 0,
            fix,
            latitude,
            longitude,
            altitude_mm,
            121,
            200,
            round(100.0 * math.hypot(north, east)),
            round(100.0 * math.degrees(math.atan2(east, north))) % 36000,
            10 if has_fix else 0,
            h_acc=300,
        )

    def time_request(self) -> Message:
        return dialect.MAVLink_timesync_message(0, self._flight.now_ns)

    def current_mode(self) -> Message:
        return CurrentMode(self._flight.number)

    def attitude(self) -> Message:
        roll, pitch, yaw, rates = self._flight.quadrotor.attitude()
        return dialect.MAVLink_attitude_message(
            self._boot_ms, roll, pitch, yaw, rates[0], rates[1], rates[2]
        )

    def system_status(self) -> Message:
        battery = self._flight.quadrotor.battery()
        healthy = SENSORS | int(dialect.MAV_SYS_STATUS_GEOFENCE)
        if not self._flight.ready:
            healthy &= ~int(dialect.MAV_SYS_STATUS_SENSOR_GPS | dialect.MAV_SYS_STATUS_AHRS)
        if self._flight.why_not_armed():
            healthy &= ~int(dialect.MAV_SYS_STATUS_PREARM_CHECK)
        return dialect.MAVLink_sys_status_message(
            SENSORS,
            SENSORS,
            healthy,
            200,
            round(1000.0 * battery.voltage),
            round(100.0 * battery.current),
            round(100.0 * battery.charge),
            0,
            0,
            0,
            0,
            0,
            0,
        )

    def battery_status(self) -> Message:
        """Battery state, sent as if the battery had one cell."""
        battery = self._flight.quadrotor.battery()
        voltages = [round(1000.0 * battery.voltage)] + [UNKNOWN_MV] * 9
        return dialect.MAVLink_battery_status_message(
            0,
            dialect.MAV_BATTERY_FUNCTION_ALL,
            dialect.MAV_BATTERY_TYPE_LIPO,
            32767,
            voltages,
            round(100.0 * battery.current),
            -1,
            -1,
            round(100.0 * battery.charge),
        )

    def extended_state(self) -> Message:
        landed: Landed = self._flight.landed
        return dialect.MAVLink_extended_sys_state_message(
            dialect.MAV_VTOL_STATE_UNDEFINED, landed.value
        )

    def home(self) -> Message | None:
        if not self._flight.ready:
            return None
        latitude, longitude, altitude = self._flight.flavour.home
        return dialect.MAVLink_home_position_message(
            round(1e7 * latitude),
            round(1e7 * longitude),
            round(1e3 * altitude),
            0.0,
            0.0,
            0.0,
            [1.0, 0.0, 0.0, 0.0],
            0.0,
            0.0,
            0.0,
        )

    def version(self) -> Message:
        can = dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        can |= dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        can |= dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        if self._flight.flavour.bytewise:
            can |= dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        else:
            can |= dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
        major, minor, patch = self._flight.flavour.version
        software = major << 24 | minor << 16 | patch << 8 | 255
        none = [0] * 8
        return dialect.MAVLink_autopilot_version_message(
            can, software, 0, 0, 0, none, none, none, 0, 0, 0
        )

    def estimate(self) -> Message:
        """State of the position estimate, in the message that this autopilot uses."""
        knows = KNOWS_ALL if self._flight.ready else KNOWS_ATTITUDE
        if self._flight.flavour.bytewise:
            return dialect.MAVLink_estimator_status_message(
                1000 * self._boot_ms, knows, 0.05, 0.05, 0.05, 0.05, 0.0, 0.0, 0.1, 0.1
            )
        return dialect.MAVLink_ekf_status_report_message(knows, 0.05, 0.05, 0.05, 0.05, 0.0)

    def parameter(self, name: str) -> Message:
        values = self._flight.parameters
        value, bytewise = values[name], self._flight.flavour.bytewise
        return dialect.MAVLink_param_value_message(
            name.encode(),
            parameters.to_wire(value, bytewise=bytewise),
            parameters.type_of(value),
            len(values),
            list(values).index(name),
        )


STREAMS: dict[int, Callable[[Telemetry], Message | None]] = {
    HEARTBEAT: Telemetry.heartbeat,
    int(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED): Telemetry.local_position,
    int(dialect.MAVLINK_MSG_ID_GPS_RAW_INT): Telemetry.gps,
    int(dialect.MAVLINK_MSG_ID_TIMESYNC): Telemetry.time_request,
    CURRENT_MODE: Telemetry.current_mode,
    int(dialect.MAVLINK_MSG_ID_ATTITUDE): Telemetry.attitude,
    int(dialect.MAVLINK_MSG_ID_SYS_STATUS): Telemetry.system_status,
    int(dialect.MAVLINK_MSG_ID_BATTERY_STATUS): Telemetry.battery_status,
    int(dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE): Telemetry.extended_state,
    int(dialect.MAVLINK_MSG_ID_HOME_POSITION): Telemetry.home,
    int(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION): Telemetry.version,
    int(dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT): Telemetry.estimate,
    int(dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS): Telemetry.estimate,
}
"""Telemetry messages by id, which can be streamed or requested once."""
