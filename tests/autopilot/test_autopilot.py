"""The scripted autopilot answers as ArduCopter 4.5.6 and PX4 1.17 did in simulation.

Measured values stand in the docstrings, tolerances beside the values in the tests. All in virtual
time.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from companion import ADDRESS, POSITION_AND_VELOCITY, VELOCITY_ONLY, Companion
from skytether.autopilot import faults
from skytether.autopilot.endpoint import PEERS_MAX, Autopilot
from skytether.autopilot.flavours import FLAVOURS, FlavourName, FlightMode
from skytether.autopilot.flight import Landed, Result
from skytether.mavlink import parameters
from skytether.mavlink.codec import Codec
from skytether.mavlink.dialect import dialect
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.scenario.reading import check
from skytether.shared.scenario.whole import Scenario

Steps = tuple[np.ndarray, np.ndarray]
BOTH: tuple[FlavourName, ...] = ("ardupilot", "px4")


def step(companion: Companion, size: float, axis: int = 0) -> Steps:
    """Times [s] and velocities relative to the size, of an isolated step on an axis."""
    companion.velocity = (0.0, 0.0, 0.0)
    companion.run(5.0)
    since = len(companion.all("LOCAL_POSITION_NED"))
    began_s = companion.flight.now_ns / 1e9
    velocity = [0.0, 0.0, 0.0]
    velocity[axis] = size
    companion.velocity = (velocity[0], velocity[1], velocity[2])
    companion.run(3.0)
    track = companion.track(since)
    return track[:, 0] - began_s, track[:, 4 + axis] / size


def crossing(times: np.ndarray, values: np.ndarray, level: float) -> float:
    """Time at which values first reach a level, interpolated [s]."""
    k = int(np.argmax(values >= level))
    share = (level - values[k - 1]) / (values[k] - values[k - 1])
    return float(times[k - 1] + share * (times[k] - times[k - 1]))


def fitted(times: np.ndarray, values: np.ndarray) -> tuple[float, float, float]:
    """Gain, time constant [s] and dead time [s] of a first-order model, by least squares."""

    def residual(p: np.ndarray) -> np.ndarray:
        return p[0] * (1.0 - np.exp(-np.maximum(times - p[2], 0.0) / p[1])) - values

    gain, tau_s, dead_s = least_squares(residual, [1.0, 0.4, 0.2]).x
    return float(gain), float(tau_s), float(dead_s)


def climbed(flavour: FlavourName = "ardupilot", **parameters: float) -> Companion:
    """Autopilot in the air, in guided mode, with some parameters set before."""
    companion = Companion(flavour)
    for name, value in parameters.items():
        set_parameter(companion, name, value)
    companion.climb()
    return companion


@pytest.fixture(scope="module")
def ardupilot() -> Companion:
    """ArduCopter in the air, sending its position at 50 Hz."""
    companion = climbed()
    companion.stream(50.0)
    return companion


# Velocities


def test_a_step_of_1_mps_is_as_measured(ardupilot: Companion) -> None:
    """Measured: 10, 50, 63 and 90 % after 0.30, 0.60, 0.72 and 1.32 s."""
    times, values = step(ardupilot, 1.0)
    reached = [crossing(times, values, level) for level in (0.1, 0.5, 0.632, 0.9)]
    np.testing.assert_allclose(reached, [0.30, 0.60, 0.72, 1.32], rtol=0, atol=0.03)
    gain, tau_s, dead_s = fitted(times, values)
    assert gain == pytest.approx(1.01, abs=0.03)
    assert tau_s == pytest.approx(0.47, abs=0.04)
    assert dead_s == pytest.approx(0.27, abs=0.02)


@pytest.mark.long
@pytest.mark.parametrize(
    ("size", "tau_s", "dead_s"), [(0.3, 0.40, 0.16), (2.0, 0.50, 0.36), (4.0, 0.78, 0.50)]
)
def test_larger_steps_are_slower_as_measured(
    ardupilot: Companion, size: float, tau_s: float, dead_s: float
) -> None:
    """Tolerances are wide because limits of jerk shape the response."""
    _, tau, dead = fitted(*step(ardupilot, size, axis=1))
    assert tau == pytest.approx(tau_s, abs=0.15)
    assert dead == pytest.approx(dead_s, abs=0.04)


@pytest.mark.long
def test_a_vertical_step_is_as_measured(ardupilot: Companion) -> None:
    """Measured for 0.5 m/s: gain 1.01, time constant 0.21 s, dead time 0.24 s."""
    gain, tau_s, dead_s = fitted(*step(ardupilot, 0.5, axis=2))
    assert gain == pytest.approx(1.01, abs=0.03)
    assert tau_s == pytest.approx(0.21, abs=0.05)
    assert dead_s == pytest.approx(0.24, abs=0.09)


def test_px4_stays_below_what_it_is_told() -> None:
    """Measured: gain 0.79 to 0.89 in 3 s, time constant 0.25 to 0.78 s, dead time 0.03 to 0.20
    s.
    """
    companion = climbed("px4")
    companion.stream(50.0)
    times, values = step(companion, 1.0)
    assert 0.77 < values[-1] < 0.91
    gain, tau_s, dead_s = fitted(times, values)
    assert 0.76 < gain < 0.91
    assert 0.25 < tau_s < 0.78
    assert 0.03 < dead_s < 0.20


@pytest.mark.long
def test_px4_errs_as_measured() -> None:
    """Estimation errors over three minutes of hovering with zero velocity.

    In ten flights of PX4 1.17 the standard deviation on a horizontal axis was 0.08 to 0.34 m/s for
    velocity and 0.07 to 0.23 m for position, correlated. The vehicle drifted 1.1 to 1.6 m within 10
    s (RMS).
    """
    companion = Companion("px4", errs=True)
    companion.climb()
    companion.stream(50.0)
    companion.velocity, began = (0.0, 0.0, 0.0), len(companion.heard)
    truth = []
    for _ in range(9000):
        truth.append([companion.flight.position(), companion.flight.quadrotor.velocity()])
        companion.run(0.02)
    positions = [m for _, m in companion.heard[began:] if m.get_type() == "LOCAL_POSITION_NED"]
    east = np.array([[m.y, m.vy] for m in positions])[-9000:]
    position, velocity = east.T - np.array(truth)[-len(east) :, :, 1].T
    assert 0.08 < velocity.std() < 0.34
    assert 0.05 < position.std() < 0.23
    assert np.corrcoef(position, velocity)[0, 1] > 0.7
    at = np.array(truth)[:, 0, :2]
    assert 0.8 < np.sqrt(np.mean((at[500:] - at[:-500]) ** 2)) < 1.8


# Silence


def test_ardupilot_stands_after_its_time_out_and_goes_on_when_setpoints_do(
    ardupilot: Companion,
) -> None:
    """Measured: below 0.9, 0.5 and 0.1 m/s 3.30, 3.60 and 4.25 s after the last set-point; moves
    again 0.28 s after new ones.
    """
    step(ardupilot, 1.0)
    since = len(ardupilot.all("LOCAL_POSITION_NED"))
    last_s = ardupilot.flight.now_ns / 1e9 - 0.02
    ardupilot.velocity = None
    ardupilot.run(8.0)
    track = ardupilot.track(since)
    times, values = track[:, 0] - last_s, -track[:, 4]
    below = [crossing(times, values, -level) for level in (0.9, 0.5, 0.1)]
    np.testing.assert_allclose(below, [3.30, 3.60, 4.25], rtol=0, atol=0.1)
    assert ardupilot.flight.mode_name == "GUIDED"
    assert ardupilot.flight.armed
    assert np.ptp(track[:, 3]) < 0.05
    times, values = step(ardupilot, 1.0)
    assert crossing(times, values, 0.08) == pytest.approx(0.28, abs=0.03)


def test_px4_flies_home_and_lands_after_its_time_out() -> None:
    """Measured: PX4 leaves OFFBOARD 1.2 s after the last set-point."""
    companion = climbed("px4")
    companion.velocity = (2.0, 0.0, 0.0)
    companion.run(4.0)
    companion.velocity = None
    assert companion.run(
        5.0, lambda: companion.flight.mode is not FlightMode.GUIDED
    ) == pytest.approx(1.2, abs=0.05)
    assert companion.flight.mode_name == "AUTO.RTL"
    assert "Failsafe activated: no offboard signal" in companion.texts()
    companion.run(60.0, lambda: not companion.flight.armed)
    assert not companion.flight.armed
    assert math.hypot(*companion.flight.position()) < 0.2


@pytest.mark.parametrize(("value", "name"), [(4, "AUTO.LAND"), (5, "AUTO.LOITER")])
def test_px4_does_what_its_parameter_says(value: int, name: str) -> None:
    companion = climbed("px4")
    for parameter, number in (("COM_OBL_RC_ACT", value), ("COM_OF_LOSS_T", 0.5)):
        set_parameter(companion, parameter, number)
    companion.velocity = None
    past_s = companion.run(5.0, lambda: companion.flight.mode is not FlightMode.GUIDED)
    assert past_s == pytest.approx(0.7, abs=0.05)
    assert companion.flight.mode_name == name


def test_px4_is_not_guided_without_a_stream() -> None:
    companion = Companion("px4")
    companion.run(1.0)
    assert companion.mode(FlightMode.GUIDED) == Result.REJECTED
    assert companion.texts()[-1] == "Switching to mode 'Offboard' is currently not possible"
    companion.velocity = (0.0, 0.0, 0.0)
    companion.run(0.2)
    assert companion.mode(FlightMode.GUIDED) == Result.ACCEPTED


def test_ardupilot_forgets_setpoints_of_before() -> None:
    companion = climbed()
    companion.velocity = (1.0, 0.0, 0.0)
    companion.run(3.0)
    companion.mode(FlightMode.PILOT)
    companion.velocity = None
    companion.run(1.0)
    assert companion.mode(FlightMode.GUIDED) == Result.ACCEPTED
    companion.run(2.0)
    assert math.hypot(*companion.flight.velocity()) < 0.1


# Arming, climbing, landing


@pytest.mark.parametrize(("flavour", "ready_s"), [("ardupilot", 41.5), ("px4", 4.6)])
def test_it_is_armed_once_it_knows_where_it_is(flavour: FlavourName, ready_s: float) -> None:
    """Measured: 41.5 s after its start for ArduCopter, 4.6 s for PX4. Until then the autopilot
    reports a reason and no position.
    """
    companion = Companion(flavour, ready_s=None)
    companion.run(ready_s - 0.1)
    assert companion.arm() == companion.flight.refusal
    assert companion.texts()[-1].rstrip() in (
        "PreArm: Need Position Estimate",
        "Arming denied: Resolve system health failures first",
    )
    assert companion.all("LOCAL_POSITION_NED") == []
    companion.run(0.3)
    assert companion.arm() == Result.ACCEPTED
    assert companion.last("HEARTBEAT").base_mode & 128 == 0
    companion.run(1.1)
    assert companion.last("HEARTBEAT").base_mode & 128


def test_ardupilot_climbs_and_lands_as_measured() -> None:
    """Measured: 7.6 s to 5 m; 12 to 13 s until landed and disarmed."""
    companion = Companion()
    assert companion.climb() == pytest.approx(7.6, abs=0.3)
    assert companion.command(21) == 0
    landing_s = companion.run(30.0, lambda: not companion.flight.armed)
    assert 12.0 <= landing_s <= 13.0
    assert companion.flight.landed is Landed.ON_GROUND
    assert companion.flight.quadrotor.stands()


def test_a_setpoint_alone_lifts_px4_and_not_ardupilot() -> None:
    for flavour, flies in (("ardupilot", False), ("px4", True)):
        companion = Companion(flavour)
        companion.velocity = (0.0, 0.0, 0.5)
        companion.run(1.0)
        assert companion.mode(FlightMode.GUIDED) == 0
        assert companion.arm() == 0
        companion.run(3.0)
        assert companion.flight.flying is flies


@pytest.mark.parametrize("flavour", BOTH)
def test_it_disarms_by_itself_where_it_is_not_flown(flavour: FlavourName) -> None:
    companion = Companion(flavour)
    companion.run(1.0)
    assert companion.arm() == (0 if companion.flight.why_not_armed() == "" else 4)
    assert companion.run(20.0, lambda: not companion.flight.armed) == pytest.approx(10.0, abs=0.1)


@pytest.mark.parametrize("flavour", BOTH)
def test_it_is_not_disarmed_in_the_air_unless_it_must(flavour: FlavourName) -> None:
    companion = climbed(flavour)
    assert companion.command(400, 0.0) == companion.flight.refusal
    assert companion.flight.armed
    assert companion.command(400, 0.0, 21196.0) == 0
    companion.run(2.0)
    assert companion.flight.quadrotor.stands()


# Faults and failsafes


def fly_with(fault: str, flavour: FlavourName, seconds: float, **keys: float) -> Companion:
    """Flight at 1 m/s with a fault from arming on."""
    companion = Companion(flavour, faults=(fault,))
    for name, value in keys.items():
        set_parameter(companion, name, value)
    companion.climb()
    companion.velocity = (1.0, 0.0, 0.0)
    companion.run(60.0, lambda: companion.flight.now_ns >= companion.flight.armed_ns + 10e9)
    companion.run(seconds)
    return companion


@pytest.mark.parametrize("flavour", BOTH)
def test_a_pilot_takes_over(flavour: FlavourName) -> None:
    companion = fly_with("pilot@10", flavour, 3.0)
    assert companion.flight.mode is FlightMode.PILOT
    assert math.hypot(*companion.flight.velocity()) < 0.2


@pytest.mark.parametrize("flavour", BOTH)
def test_it_lands_where_it_does_not_know_its_place(flavour: FlavourName) -> None:
    companion = fly_with("estimate@10", flavour, 3.0)
    assert companion.flight.mode is FlightMode.LAND
    assert companion.mode(FlightMode.GUIDED) == companion.flight.refusal
    before = len(companion.all("LOCAL_POSITION_NED"))
    companion.run(1.0)
    assert len(companion.all("LOCAL_POSITION_NED")) == before
    assert companion.command(512, dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT) == 0
    reported = companion.heard[-2][1]
    assert reported.flags & dialect.ESTIMATOR_POS_HORIZ_ABS == 0


@pytest.mark.parametrize(
    ("flavour", "keys", "mode"),
    [
        ("ardupilot", {}, FlightMode.GUIDED),
        ("ardupilot", {"BATT_FS_LOW_ACT": 2}, FlightMode.RETURN),
        ("px4", {"COM_LOW_BAT_ACT": 2}, FlightMode.LAND),
    ],
)
def test_a_low_battery_is_told_and_does_what_the_parameter_says(
    flavour: FlavourName, keys: dict[str, float], mode: FlightMode
) -> None:
    companion = fly_with("battery@10", flavour, 1.0, **keys)
    assert companion.flight.mode is mode
    assert any("attery" in text for text in companion.texts())
    companion.command(512, dialect.MAVLINK_MSG_ID_SYS_STATUS)
    assert companion.last("SYS_STATUS").battery_remaining <= 5


def test_what_is_silent_says_nothing_and_flies_on() -> None:
    companion = Companion(faults=("silence@15-17",))
    companion.climb()
    companion.stream(50.0)
    companion.velocity = (1.0, 0.0, 0.0)
    companion.run(8.0)
    times = companion.track()[:, 0]
    armed_s = companion.flight.armed_ns / 1e9
    gap = int(np.argmax(np.diff(times)))
    assert times[gap] - armed_s == pytest.approx(15.0, abs=0.05)
    assert times[gap + 1] - times[gap] == pytest.approx(2.0, abs=0.05)
    assert companion.flight.velocity()[0] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("flavour", "keys", "after_s"),
    [
        ("ardupilot", {"FS_GCS_ENABLE": 1}, 5.0),
        ("px4", {"NAV_DLL_ACT": 2}, 10.0),
        ("px4", {}, None),
    ],
)
def test_a_lost_ground_station_sends_it_home_where_it_is_to(
    flavour: FlavourName, keys: dict[str, float], after_s: float | None
) -> None:
    companion = Companion(flavour)
    for name, value in keys.items():
        set_parameter(companion, name, value)
    companion.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    companion.climb()
    companion.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    companion.beats, companion.velocity = False, (0.0, 0.0, 0.0)
    left_s = companion.run(11.0, lambda: companion.flight.mode is FlightMode.RETURN)
    assert (companion.flight.mode is FlightMode.RETURN) == (after_s is not None)
    assert left_s == pytest.approx(after_s or 11.0, abs=0.1)


@pytest.mark.parametrize(
    ("flavour", "keys"),
    [
        ("ardupilot", {"FENCE_ENABLE": 1, "FENCE_RADIUS": 5.0, "FENCE_ACTION": 4}),
        ("px4", {"GF_MAX_HOR_DIST": 5.0, "GF_ACTION": 2}),
    ],
)
def test_its_own_fence_holds_it(flavour: FlavourName, keys: dict[str, float]) -> None:
    companion = climbed(flavour, **keys)
    companion.velocity = (2.0, 0.0, 0.0)
    companion.run(8.0)
    assert companion.flight.mode is FlightMode.HOLD
    assert 5.0 < companion.flight.position()[0] < 9.0


@pytest.mark.parametrize(
    "text", ["", "pilot", "pilot@", "pilot@-1", "pilto@3", "pilot@3-5", "silence@5-4", "silence@x"]
)
def test_a_fault_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^--fault: got"):
        faults.parse(text)


# Messages


def set_parameter(companion: Companion, name: str, value: float) -> None:
    before = companion.flight.parameters[name]
    given = int(value) if isinstance(before, int) else float(value)
    sent = parameters.to_wire(given, bytewise=companion.flavour.bytewise)
    kind = parameters.type_of(given)
    companion.send(dialect.MAVLink_param_set_message(1, 1, name.encode(), sent, kind))


@pytest.mark.parametrize("flavour", BOTH)
def test_parameters_are_read_and_set(flavour: FlavourName) -> None:
    companion = Companion(flavour)
    own, bytewise = FLAVOURS[flavour].parameters, FLAVOURS[flavour].bytewise
    for number in range(len(own)):
        companion.send(dialect.MAVLink_param_request_read_message(1, 1, b"", number))
    parameters_read = {
        message.param_id: parameters.from_wire(
            message.param_value, message.param_type, bytewise=bytewise
        )
        for message in companion.all("PARAM_VALUE")
    }
    assert parameters_read == pytest.approx(own, rel=1e-6)
    name = "COM_OBL_RC_ACT" if bytewise else "GUID_TIMEOUT"
    set_parameter(companion, name, 5)
    companion.send(dialect.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
    value = companion.last("PARAM_VALUE")
    assert value.param_id == name
    assert value.param_count == len(own)
    kind = value.param_type
    assert parameters.from_wire(value.param_value, kind, bytewise=bytewise) == 5
    count = len(companion.all("PARAM_VALUE"))
    companion.send(dialect.MAVLink_param_request_read_message(1, 1, b"NO_SUCH", -1))
    companion.send(dialect.MAVLink_param_set_message(1, 1, b"NO_SUCH", 1.0, 9))
    assert len(companion.all("PARAM_VALUE")) == count


@pytest.mark.parametrize("rate", [10.0, 200.0])
def test_a_stream_is_exact_by_its_own_stamp(rate: float) -> None:
    companion = Companion()
    companion.run(1.0)
    companion.stream(rate)
    since = len(companion.all("LOCAL_POSITION_NED"))
    companion.run(2.0)
    times = companion.track(since)[:, 0]
    np.testing.assert_allclose(np.diff(times), 1.0 / rate, rtol=0, atol=1e-9)
    companion.stream(1000.0)
    since = len(companion.all("LOCAL_POSITION_NED"))
    companion.run(1.0)
    assert len(companion.all("LOCAL_POSITION_NED")) - since == 200


def test_a_stream_that_is_stopped_stops() -> None:
    """Interval -1 stops a stream, 0 restores its default; an unknown message is refused."""
    companion = Companion("px4")
    companion.run(1.0)
    number = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED
    for interval_us, count in ((-1.0, 0), (0.0, 30)):
        assert companion.command(511, number, interval_us) == 0
        since = len(companion.all("LOCAL_POSITION_NED"))
        companion.run(1.0)
        assert len(companion.all("LOCAL_POSITION_NED")) - since == pytest.approx(count, abs=1)
    assert companion.command(511, 4711, 1e5) == Result.DENIED
    assert companion.command(511, number, math.nan) == Result.DENIED


def test_time_is_told_at_once() -> None:
    companion = Companion()
    companion.run(1.0)
    companion.now_ns += 1_234_567
    companion.send(dialect.MAVLink_timesync_message(0, 4711))
    answer = companion.last("TIMESYNC")
    assert answer.ts1 == 4711
    assert answer.tc1 == companion.now_ns - 1_000_000_000
    count = len(companion.all("TIMESYNC"))
    companion.send(dialect.MAVLink_timesync_message(5, 4711))
    assert len(companion.all("TIMESYNC")) == count


@pytest.mark.parametrize(
    "name",
    [
        "HEARTBEAT",
        "LOCAL_POSITION_NED",
        "ATTITUDE",
        "SYS_STATUS",
        "BATTERY_STATUS",
        "EXTENDED_SYS_STATE",
        "HOME_POSITION",
        "AUTOPILOT_VERSION",
    ],
)
def test_a_message_is_sent_on_request(name: str) -> None:
    companion = Companion("px4")
    companion.run(1.0)
    number = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
    companion.heard.clear()
    assert companion.command(512, number) == 0
    assert [message.get_type() for _, message in companion.heard] == [name, "COMMAND_ACK"]
    assert companion.command(512, 4711) == Result.DENIED
    assert companion.command(31000) == Result.UNSUPPORTED


def test_the_attitude_is_that_of_what_it_flies(ardupilot: Companion) -> None:
    """Nose down to fly north, right side down to fly east, in NED signs."""
    ardupilot.velocity = (0.0, 0.0, 0.0)
    ardupilot.run(5.0)
    ardupilot.velocity = (1.0, 1.0, 0.0)
    ardupilot.run(0.5)
    ardupilot.command(512, dialect.MAVLINK_MSG_ID_ATTITUDE)
    attitude = ardupilot.last("ATTITUDE")
    assert attitude.pitch < -0.05
    assert attitude.roll > 0.05
    assert abs(attitude.yaw) < 0.03


def test_position_and_velocity_are_flown_together(ardupilot: Companion) -> None:
    x, y, z = ardupilot.flight.position()
    for k in range(500):
        ardupilot.position = (x + 0.02 * k, y, z)
        ardupilot.velocity = (1.0, 0.0, 0.0)
        ardupilot.run(0.02)
    ahead = x + 0.02 * 500 - ardupilot.flight.position()[0]
    ardupilot.position = None
    assert abs(ahead) < 0.2


def test_a_position_is_flown_to_when_nobody_is_left() -> None:
    """With a position in the set-points, ArduCopter continues far beyond its timeout. So the client
    sends velocities only.
    """
    companion = climbed()
    companion.position, companion.velocity = (60.0, 0.0, 5.0), (0.0, 0.0, 0.0)
    companion.setpoint()
    companion.position = companion.velocity = None
    companion.run(20.0)
    assert companion.flight.position()[0] == pytest.approx(60.0, abs=0.5)


def test_a_setpoint_that_cannot_be_flown_is_none() -> None:
    companion = climbed()
    before = companion.autopilot.figures()["rejected"]
    for velocity_mps, position_m, mask in (
        (math.nan, 0.0, VELOCITY_ONLY),
        (math.inf, 0.0, VELOCITY_ONLY),
        (1.0, 0.0, 0b111111111111),
        (1.0, 0.0, 0b110000000111),
        (0.0, math.nan, POSITION_AND_VELOCITY),
    ):
        companion.velocity = (velocity_mps, 0.0, 0.0)
        companion.position = (position_m, 0.0, 0.0)
        companion.setpoint(mask)
        before += 1
        assert companion.autopilot.figures()["rejected"] == before
        companion.velocity = companion.position = None
        companion.run(1.0)
        assert math.hypot(*companion.flight.velocity()) < 0.05


# Traffic


def test_it_heeds_its_own_number_alone() -> None:
    companion = Companion()
    companion.run(1.0)
    arm = dialect.MAVLink_command_long_message(2, 1, 400, 0, 1.0, 0, 0, 0, 0, 0, 0)
    companion.send(arm)
    camera = dialect.MAVLink_command_long_message(1, 100, 400, 0, 1.0, 0, 0, 0, 0, 0, 0)
    companion.send(camera)
    ours = dialect.MAVLink_command_long_message(1, 1, 400, 0, 1.0, 0, 0, 0, 0, 0, 0)
    companion.deliver(Codec(1, 1).encode(ours))
    assert not companion.flight.armed
    assert companion.autopilot.figures()["foreign"] == 3


def test_other_peers_hear_it_and_a_crowd_moves_nobody_out() -> None:
    companion = Companion()
    companion.run(1.0)
    companion.stream(50.0)
    beat = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    for port in range(100):
        companion.send(beat, address=("192.0.2.1", port))
    figures = companion.autopilot.figures()
    assert figures["peers"] == PEERS_MAX
    assert figures["refused"] == 100 - PEERS_MAX + 1
    since = len(companion.all("LOCAL_POSITION_NED"))
    companion.run(1.0)
    assert len(companion.all("LOCAL_POSITION_NED")) - since == 50
    companion.send(beat)
    companion.send(beat, address=("192.0.2.2", 1))
    assert ("192.0.2.2", 1) in companion.autopilot._peers
    assert ADDRESS in companion.autopilot._peers


def test_whom_it_is_told_of_hears_it_from_the_start() -> None:
    address = ("192.0.2.9", 14540)
    autopilot = Autopilot(Scenario(), "px4", peers=[address], ready_s=0.0)
    autopilot.wake(now_ns=0)
    autopilot.wake(now_ns=5_000_000)
    assert {peer for _, peer, _ in autopilot.outbox()} == {address}


@settings(max_examples=15, deadline=None)
@given(st.lists(st.binary(max_size=80), max_size=20))
def test_garbage_is_counted(garbage: list[bytes]) -> None:
    autopilot = Autopilot(Scenario(), "ardupilot", ready_s=0.0)
    for k, payload in enumerate(garbage):
        from_ = ("192.0.2.1", k)
        autopilot.receive(Datagram(payload, from_), now_ns=k * 1_000_000)
    assert autopilot.figures()["garbage_bytes"] == sum(map(len, garbage))
    assert autopilot.figures()["peers"] == 0
    assert autopilot.outbox() == []


@settings(max_examples=20, deadline=None)
@given(st.data())
def test_any_message_with_any_fields_is_survived(data: st.DataObject) -> None:
    numbers = st.floats(width=32)
    companion = Companion(data.draw(st.sampled_from(BOTH)), ready_s=100.0)
    target = data.draw(st.sampled_from([0, 1, 2]))
    given_ = [data.draw(numbers) for _ in range(7)]
    command = data.draw(st.sampled_from([20, 21, 22, 176, 400, 511, 512, 31000]))
    mask = data.draw(st.integers(0, 0xFFFF))
    vector = [data.draw(numbers) for _ in range(11)]
    kind = data.draw(st.integers(0, 255))
    name = data.draw(st.sampled_from([b"GUID_TIMEOUT", b"COM_OBL_RC_ACT", b"\xff\xfe", b""]))
    for message in (
        dialect.MAVLink_command_long_message(target, 1, command, 0, *given_),
        dialect.MAVLink_command_int_message(
            target, 1, 0, command, 0, 0, *given_[:4], 1, -1, given_[4]
        ),
        dialect.MAVLink_set_position_target_local_ned_message(0, target, 1, 1, mask, *vector),
        dialect.MAVLink_param_set_message(target, 1, name, given_[0], kind),
        dialect.MAVLink_param_request_read_message(target, 1, name, kind - 9),
        dialect.MAVLink_set_mode_message(target, 1, data.draw(st.integers(0, 2**32 - 1))),
    ):
        companion.send(message)
        companion.run(0.02)
    assert not companion.flight.armed
    assert np.isfinite(companion.flight.position()).all()


# Time


def test_a_process_that_has_slept_goes_on_from_where_it_was() -> None:
    companion = climbed()
    before_ns = companion.flight.now_ns
    companion.now_ns += 3600 * 10**9
    companion.autopilot.wake(now_ns=companion.now_ns)
    assert companion.flight.now_ns - before_ns == pytest.approx(1e9, abs=1e7)


def test_the_same_seed_is_the_same_flight() -> None:
    places = []
    for seed in (1, 1, 2):
        companion = Companion(seed=seed, turbulence_mps=6.0, steady_wind_mps=[6.0, 0.0])
        companion.climb()
        companion.run(4.0)
        places.append(companion.flight.position())
        assert abs(companion.flight.quadrotor.attitude().yaw) < 0.05
        assert math.hypot(*places[-1][:2]) < 2.0
    assert places[0] == places[1] != places[2]


def test_another_wind_blows_when_it_is_told() -> None:
    companion = climbed()
    before = companion.flight.quadrotor.attitude().roll
    windy = check({"vehicle": {"steady_wind_mps": [0.0, 5.0]}}, "test")
    companion.autopilot.change(windy, frozenset({"vehicle.steady_wind_mps"}), now_ns=0)
    companion.run(5.0)
    assert companion.flight.quadrotor.attitude().roll < before - 0.02
