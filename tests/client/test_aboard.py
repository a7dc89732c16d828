"""Vehicles with scripted autopilots in virtual time, see `airborne`.

Covers each row of the failsafe for the autopilot, each refusal, and each kind of foreign traffic.
"""

from collections.abc import Callable

import numpy as np
import pytest

from airborne import (
    ARM,
    BOTH,
    SAFE,
    SECOND,
    SET_MODE,
    TAKE_OFF,
    Air,
    altered,
    flying,
    modes,
    scenario,
)
from skytether.autopilot.flavours import FlavourName, FlightMode
from skytether.client import vehicles
from skytether.client.mavlink.setpoints import VELOCITY_ALONE
from skytether.mavlink.codec import Codec, Message
from skytether.mavlink.dialect import dialect
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.events.aboard import (
    AutopilotFound,
    AutopilotMode,
    AutopilotRefused,
    AutopilotText,
    NotTakenOff,
    ParametersRead,
    ParametersSet,
    ParametersUnsafe,
)
from skytether.shared.events.flight import Flying
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.protocol import Mode


@pytest.fixture(scope="module", params=BOTH)
def flown(request: pytest.FixtureRequest) -> Air:
    """Flight of 8 s to its end; the client knows the dead time, and its clock drifts."""
    air = Air(request.param, duration=8.0, drift_ppm=50.0, model={"dead_time_s": [0.27]})
    air.fly()
    air.end()
    return air


@pytest.fixture(scope="module")
def aloft() -> Air:
    """Vehicle in the air; each test that takes it leaves it flying a plan."""
    return flying("ardupilot")


def why(air: Air) -> tuple[str, str]:
    """Stage in which the client gave up, and the reason."""
    failure = air.client.failure
    assert isinstance(failure, NotTakenOff)
    return failure.doing, failure.why


# A flight


def test_a_flight_follows_its_reference(flown: Air) -> None:
    assert flown.client.failure is None
    assert flown.rmse() < 1.0
    assert not flown.flight.armed
    assert flown.flight.position()[2] < 0.05


def test_setpoints_are_velocities_alone_at_the_rate_of_steps(flown: Air) -> None:
    sent = flown.setpoints()
    masks = {(each.type_mask, each.coordinate_frame) for _, each in sent}
    assert masks == {(VELOCITY_ALONE, dialect.MAV_FRAME_LOCAL_NED)}
    times = np.array([time_ns for time_ns, _ in sent])
    assert np.diff(times)[20:].max() < 0.06 * SECOND
    assert np.diff(times)[20:].min() > 0.019 * SECOND
    commands = flown.heard("COMMAND_LONG")
    request = dialect.MAV_CMD_REQUEST_MESSAGE
    landing = [each for each in commands if each[1].command != request][-1]
    assert landing[1].command == SET_MODE
    assert times[-1] <= landing[0]


def test_no_setpoint_but_a_zero_comes_before_the_climb_is_over(flown: Air) -> None:
    """PX4 needs a stream of zeros before OFFBOARD; ArduCopter gets no set-points at all."""
    (began_ns,) = [at_ns for at_ns, _, event in flown.events if isinstance(event, Flying)]
    before = [each for time_ns, each in flown.setpoints() if time_ns < began_ns]
    assert all((each.vx, each.vy, each.vz) == (0.0, 0.0, 0.0) for each in before)
    assert bool(before) == (flown.flight.flavour.title == "PX4")


def test_one_heartbeat_a_second_is_that_of_an_onboard_computer(flown: Air) -> None:
    """To PX4 the client is a ground station as well, because PX4 sends texts only to those."""
    all_beats = flown.heard("HEARTBEAT")
    kinds = {(each.type, each.get_srcSystem(), each.get_srcComponent()) for _, each in all_beats}
    station = {(dialect.MAV_TYPE_GCS, 245, 191)} if flown.flight.flavour.title == "PX4" else set()
    assert kinds == {(dialect.MAV_TYPE_ONBOARD_CONTROLLER, 245, 191)} | station
    beats = [beat for beat in all_beats if beat[1].type == dialect.MAV_TYPE_ONBOARD_CONTROLLER]
    times = np.array([time_ns for time_ns, _ in beats])
    assert np.all(np.abs(np.diff(times) - SECOND) < 0.11 * SECOND)
    assert abs(times[-1] - flown.world.now_ns) < 1.2 * SECOND


def test_measurements_are_those_of_their_stamps(flown: Air) -> None:
    rows = flown.rows()
    assert np.isfinite(rows["measured"]).all()
    figures = flown.figures()
    assert figures["measurements"] > 500
    assert {name: count for name, count in figures["dropped"].items() if count} == {}
    assert rows["estimate"][0, 2, 0] == pytest.approx(2.0, abs=0.35)
    assert figures["drift_ppm"] == pytest.approx(50.0, abs=5.0)


def test_the_way_into_the_air_is_the_autopilots_own(flown: Air) -> None:
    asked = [each.command for _, each in flown.heard("COMMAND_LONG")]
    way = [command for command in asked if command in (ARM, TAKE_OFF, SET_MODE)]
    in_order = {"ArduCopter": [SET_MODE, ARM, TAKE_OFF], "PX4": [ARM, TAKE_OFF, SET_MODE]}
    assert way == [*in_order[flown.flight.flavour.title], SET_MODE]


def test_what_the_autopilot_is_and_does_in_silence_is_told(flown: Air) -> None:
    ((found,), (read,)) = flown.of(AutopilotFound), flown.of(ParametersRead)
    assert found.name.startswith(flown.flight.flavour.title)
    said = str(read)
    for name, value in SAFE["px4" if found.name.startswith("PX4") else "ardupilot"].items():
        assert f"{name} = {value:g}: " in said
    assert ("COM_OBL_ACT = missing" in said) == found.name.startswith("PX4")
    kinds = [type(event) for _, host, event in flown.events if host == "client"]
    assert kinds.index(ParametersRead) < kinds.index(AutopilotText)


def test_px4_is_not_told_of_a_station_where_it_acts_on_the_loss_of_one() -> None:
    air = Air("px4", parameters={"COM_OBL_RC_ACT": 4, "NAV_DLL_ACT": 2}, armed=False)
    air.run(8.0)
    kinds = {each.type for _, each in air.heard("HEARTBEAT")}
    assert kinds == {dialect.MAV_TYPE_ONBOARD_CONTROLLER}


def test_figures_have_what_a_pilot_looks_at(flown: Air) -> None:
    figures = flown.figures()
    assert figures["mode"] in ("LAND", "OFFBOARD")  # PX4 returns to the mode before its landing
    assert (figures["armed"], figures["garbage_bytes"]) == (0, 0)
    assert 0.9 < figures["battery"] <= 1.0
    assert figures["home"]["altitude_m"] == pytest.approx(flown.flight.flavour.home[2])
    assert set(figures["fence"]) & {"FENCE_ALT_MAX", "GF_MAX_VER_DIST"}


# Parameters


@pytest.mark.parametrize(
    ("flavour", "wrong"),
    [
        ("ardupilot", {"GUID_TIMEOUT": 3.0}),
        ("px4", {"COM_OBL_RC_ACT": 7}),
    ],
)
def test_an_unsafe_parameter_is_a_line_and_nothing_is_armed(
    flavour: FlavourName, wrong: dict[str, float]
) -> None:
    air = Air(flavour, parameters=SAFE[flavour] | wrong)
    air.end(20.0)
    failure = air.client.failure
    assert isinstance(failure, ParametersUnsafe)
    ((name, value),) = wrong.items()
    (line,) = str(failure).splitlines()
    assert line.startswith(f"vehicle 1: {name} = {value:g}: ")
    assert ": set " in line
    assert not air.commands(ARM)
    assert not air.commands(SET_MODE)
    assert not air.heard("PARAM_SET")


def test_parameters_are_set_and_read_back_where_that_is_allowed(flavour: FlavourName) -> None:
    air = Air(flavour, parameters={}, sets=True)
    lost: list[bytes] = []

    def lose(message: Message) -> bytes | None:
        if message.get_type() == "PARAM_VALUE" and air.heard("PARAM_SET") and not lost:
            lost.append(b"")
            return b""
        return None

    air.tap.alter = lose
    air.run(20.0, lambda: air.flies.is_ready)
    assert lost
    before = dict(air.flight.flavour.parameters)
    after = air.flight.parameters
    changed = {name: after[name] for name in after if after[name] != before[name]}
    assert changed == SAFE[flavour]
    (event,) = air.of(ParametersSet)
    assert {name for name, _, _ in event.changes} == set(changed)


def test_a_parameter_that_cannot_be_set_is_refused() -> None:
    air = Air("ardupilot", parameters=SAFE["ardupilot"] | {"GUID_TIMEOUT": 3.0}, sets=True)
    air.flight.set = lambda *_: None
    air.end(20.0)
    failure = air.client.failure
    assert isinstance(failure, ParametersUnsafe)
    assert "GUID_TIMEOUT = 3" in str(failure)
    assert failure.brief == (
        "vehicle 1 is not armed: GUID_TIMEOUT; --set-parameters could not set them"
    )


def test_no_flag_sets_what_an_autopilot_does_not_tell() -> None:
    air = Air("ardupilot")
    air.tap.alter = lambda message: b"" if message.get_type() == "PARAM_VALUE" else None
    air.end(20.0)
    failure = air.client.failure
    assert isinstance(failure, ParametersUnsafe)
    assert {each.value for each in failure.parameters} == {None}
    assert failure.parameters[0].name in failure.brief
    assert "--set-parameters" not in failure.brief


@pytest.mark.parametrize(
    ("flavour", "name", "refused"),
    [
        ("ardupilot", "GUID_TIMEOUT", True),
        ("ardupilot", "FENCE_RADIUS", False),
        ("px4", "COM_OBL_RC_ACT", True),
        ("px4", "GF_ACTION", False),
    ],
)
def test_a_parameter_that_is_missing_is_refused_where_it_must_be_known(
    flavour: FlavourName, name: str, refused: bool
) -> None:
    air = Air(flavour)
    del air.flight.parameters[name]
    air.run(20.0, lambda: air.flies.is_ready or air.flies.failure is not None)
    assert air.flies.is_ready != refused
    (read,) = air.of(ParametersRead)
    assert f"{name} = missing" in str(read)


def test_the_newer_name_of_a_parameter_will_do() -> None:
    air = Air("ardupilot")
    air.flight.parameters["MAV_GCS_SYSID"] = air.flight.parameters.pop("SYSID_MYGCS")
    air.flight.is_station = lambda *_: True
    air.until(lambda: air.flies.is_ready, 20.0)


# Arming and taking off


def test_what_keeps_it_from_arming_is_told_and_tried_again() -> None:
    air = Air("ardupilot", ready_s=8.0, mavlink={"patience_s": 20.0})
    air.flight.why_not_armed = (  # it knows its position, and refuses to arm for another reason
        lambda: "" if air.flight.now_ns > 10 * SECOND else "PreArm: Compass not calibrated"
    )
    air.until(lambda: air.flight.armed, 30.0)
    assert air.of(AutopilotRefused) == [AutopilotRefused(vehicle=1, asked="arm", answer="failed")]
    assert next(each.text for each in air.of(AutopilotText)) == "PreArm: Compass not calibrated"


def test_who_cannot_arm_in_time_says_why_in_the_autopilots_words() -> None:
    air = Air("ardupilot", mavlink={"patience_s": 3.0})
    air.flight.why_not_armed = lambda: "PreArm: Compass not calibrated"
    air.end(30.0)
    assert why(air) == ("not armed in 3 s", "PreArm: Compass not calibrated")
    assert not air.setpoints()


def test_an_autopilot_that_ends_in_a_climb_is_told_to_be_silent() -> None:
    """The last known altitude does not count: it may be outdated."""
    air = Air("ardupilot", mavlink={"patience_s": 12.0})
    air.run(30.0, lambda: air.flight.position()[2] > 1.0)
    air.tap.dumb = True
    air.end(60.0)
    doing, because = why(air)
    assert doing == "not at the altitude of take-off in 12 s"
    assert "no message from its autopilot" in because


def test_without_a_position_nothing_is_armed() -> None:
    air = Air("ardupilot", ready_s=60.0, mavlink={"patience_s": 3.0})
    air.end(30.0)
    assert why(air) == ("not ready in 3 s", "its position is unknown")
    assert not air.commands(ARM)


def test_without_an_autopilot_there_is_a_line() -> None:
    air = Air("ardupilot", mavlink={"patience_s": 3.0})
    air.tap.dumb = True
    air.end(30.0)
    doing, because = why(air)
    assert doing == "not heard in 3 s"
    assert "vehicle.address" in because


@pytest.mark.parametrize(("kind", "autopilot"), [(1, 3), (2, 18), (11, 12)])
def test_what_does_not_hover_or_is_another_autopilot_is_refused(kind: int, autopilot: int) -> None:
    air = Air("ardupilot")
    air.tap.alter = altered("HEARTBEAT", type=lambda _: kind, autopilot=lambda _: autopilot)
    air.end(10.0)
    assert why(air)[0] == "not flown"
    assert not air.heard("COMMAND_LONG")


def test_an_unarmed_scenario_arms_nothing_until_somebody_arms_it() -> None:
    air = Air("px4", armed=False, mavlink={"patience_s": 9.0})
    air.run(15.0)
    assert air.flies.is_ready
    assert not air.client.failure
    assert not air.commands(ARM)
    assert not air.commands(SET_MODE)
    armed = scenario()
    air.world.act(
        "client",
        lambda now_ns: air.client.change(armed, frozenset({"armed"}), now_ns=now_ns),
    )
    air.fly(20.0)


def test_a_vehicle_that_flies_in_guided_is_not_taken_off_again() -> None:
    """It starts where it is, relative to the autopilot's origin if the scenario says so."""
    air = Air("ardupilot", duration=5.0, mavlink={"origin": "autopilot"})
    in_the_air(air, FlightMode.GUIDED)
    air.fly()
    assert not air.commands(ARM)
    assert not air.commands(TAKE_OFF)
    assert not air.commands(SET_MODE)
    assert air.rows()["estimate"][0, 2, 0] == pytest.approx(4.0, abs=0.2)


def in_the_air(air: Air, mode: FlightMode) -> None:
    """Let the vehicle fly at 4 m before the client connects."""
    flight = air.flight
    for _ in range(300):
        flight.tick()
    flight.enter(flight.flavour.number(FlightMode.GUIDED))
    flight.arm()
    flight.take_off(4.0)
    for _ in range(3000):
        flight.tick()
    flight.enter(flight.flavour.number(mode))
    air.autopilot._began_ns = -flight.now_ns


def test_a_vehicle_that_somebody_else_flies_is_left_to_him() -> None:
    air = Air("ardupilot", mavlink={"patience_s": 1.0})
    in_the_air(air, FlightMode.RETURN)
    air.end(30.0)
    assert "in the air" in why(air)[1]
    assert not air.commands(SET_MODE)


def test_a_pilot_who_takes_over_in_the_climb_has_it(flavour: FlavourName) -> None:
    air = Air(flavour)
    air.run(30.0, lambda: air.flight.armed and air.flight.position()[2] > 0.5)
    air.take_over()
    asked = len(air.commands(SET_MODE))
    air.end(10.0)
    assert "taken over" in why(air)[1]
    assert len(air.commands(SET_MODE)) == asked
    assert air.close() == 0
    assert air.flight.mode is FlightMode.PILOT


def operator_holds(air: Air) -> int:
    """Let an operator choose the mode that holds; returns how often we have requested a mode."""
    air.flight.enter(air.flight.flavour.number(FlightMode.HOLD))
    return len(air.commands(SET_MODE))


@pytest.mark.parametrize("altitude", [0.5, 1.2])
def test_an_operator_who_holds_in_the_climb_has_it(flavour: FlavourName, altitude: float) -> None:
    air = Air(flavour, mavlink={"takeoff_m": 3.0})
    air.run(30.0, lambda: air.flight.armed and air.flight.position()[2] > altitude)
    asked = operator_holds(air)
    air.end(10.0)
    assert "taken over" in why(air)[1]
    assert len(air.commands(SET_MODE)) == asked
    assert air.close() == 0
    assert air.flight.mode is FlightMode.HOLD


def test_an_operator_who_holds_as_soon_as_it_lifts_has_it() -> None:
    """No heartbeat has told the mode that climbs."""
    air = Air("px4", mavlink={"takeoff_m": 3.0})
    air.run(30.0, lambda: air.flight.mode is FlightMode.TAKEOFF)
    asked = operator_holds(air)
    air.end(10.0)
    assert "taken over" in why(air)[1]
    assert len(air.commands(SET_MODE)) == asked
    assert air.flight.mode is FlightMode.HOLD


def test_a_climb_that_takes_too_long_lands(flavour: FlavourName) -> None:
    air = Air(flavour, mavlink={"takeoff_m": 30.0, "patience_s": 6.0})
    air.end(90.0)
    assert not air.flight.armed
    assert why(air)[0] == "not at the altitude of take-off in 6 s"


@pytest.mark.parametrize("on_loss", ["land", "return"])
def test_an_operator_who_holds_during_a_landing_has_it(flavour: FlavourName, on_loss: str) -> None:
    air = flying(flavour, seconds=8.0, vehicle={"on_loss": on_loss})
    air.world.stop("server")
    down = FlightMode.RETURN if on_loss == "return" else FlightMode.LAND
    air.until(lambda: air.flight.mode is down, 30.0)
    air.run(1.2)
    asked = operator_holds(air)
    air.run(8.0)
    assert len(air.commands(SET_MODE)) == asked
    assert air.flight.mode is FlightMode.HOLD


def test_an_operator_who_holds_before_the_end_keeps_it(flavour: FlavourName) -> None:
    air = flying(flavour)
    operator_holds(air)
    air.run(8.0)
    assert air.close() == 0
    assert air.flight.mode is FlightMode.HOLD


def test_an_operator_who_holds_before_the_duration_ends_keeps_it(flavour: FlavourName) -> None:
    air = flying(flavour, duration=8.0)
    asked = operator_holds(air)
    air.until(lambda: air.client.finished, 15.0)
    assert len(air.commands(SET_MODE)) == asked
    assert air.flight.mode is FlightMode.HOLD


def test_a_take_off_that_does_not_climb_ends_in_a_landing() -> None:
    air = Air("ardupilot", mavlink={"patience_s": 2.0})
    air.end(60.0)
    assert why(air)[0] == "not at the altitude of take-off in 2 s"
    assert not air.flight.armed


def test_the_flight_must_not_begin_on_the_ground() -> None:
    """In space the altitude of take-off is that of the reference, unless given."""
    said = r"mavlink.takeoff_m: got 'auto' at altitude 0 m.* --mavlink.takeoff-m"
    with pytest.raises(ConfigError, match=said):
        vehicles.make(scenario(reference={"altitude_m": 0.0}), 1)
    vehicles.make(scenario(reference={"altitude_m": 0.0}, mavlink={"takeoff_m": 1.0}), 1)


# The failsafe


def test_who_arms_it_while_we_are_about_to_has_it() -> None:
    """The lost mode command is not repeated, because a pilot has armed meanwhile."""
    air = Air("ardupilot")
    air.flight.switch = lambda _: air.flight.refusal
    air.run(10.0, lambda: bool(air.commands(SET_MODE)))
    air.flight.enter(5)
    air.flight.arm()
    air.run(0.5)
    asked = len(air.commands(SET_MODE))
    air.end(10.0)
    assert "taken over: it is in LOITER" in why(air)[1]
    assert len(air.commands(SET_MODE)) == asked


def test_a_pilot_wins_at_once_and_whoever_is_given_back_hovers_and_flies_on() -> None:
    """Nothing is sent meanwhile. It flies on once the link has been good for a second."""
    air = flying("ardupilot")
    air.take_over()
    asked = len(air.commands(SET_MODE))
    air.run(0.3)
    assert air.mode is Mode.MANUAL
    air.quiet(3.0)
    assert len(air.commands(SET_MODE)) == asked
    assert air.flight.mode is FlightMode.PILOT
    assert modes(air)[-1] == ("manual", str(Reason.TAKEN))
    air.flight.enter(air.flight.flavour.number(FlightMode.GUIDED))
    back_ns = air.world.now_ns
    air.run(3.0)
    assert ("hover", str(Reason.RETURNED)) in modes(air)
    assert air.setpoints(back_ns)
    assert air.mode in (Mode.HOVER, Mode.TRACK)


def test_what_its_pilot_has_landed_follows_no_plan_on_the_ground() -> None:
    """Still armed, and given back in GUIDED; once the pilot has lifted it, it flies on."""
    air = flying("ardupilot")
    air.flight.enter(air.flight.flavour.number(FlightMode.LAND))
    air.until(lambda: not air.flight.flying, 30.0)
    air.take_over()
    air.run(1.5)
    assert air.flight.armed
    air.flight.enter(air.flight.flavour.number(FlightMode.GUIDED))
    back_ns = air.world.now_ns
    air.run(4.0)
    assert air.flight.armed
    assert air.mode is Mode.MANUAL
    assert not air.setpoints(back_ns)
    air.flight.take_off(2.0)
    air.until(lambda: air.mode is Mode.TRACK, 15.0)


def test_a_disarmed_vehicle_is_never_flown_again() -> None:
    air = flying("ardupilot")
    air.flight.disarm(force=True)
    air.run(0.5)
    assert modes(air)[-1] == ("manual", str(Reason.DISARMED))
    quiet_ns, arms = air.world.now_ns, len(air.commands(ARM))
    air.run(3.0)
    air.flight.number = air.flight.flavour.number(FlightMode.GUIDED)
    air.flight.armed = True
    air.run(2.0)
    assert not air.setpoints(quiet_ns)
    assert len(air.commands(ARM)) == arms
    assert modes(air)[-1] == ("manual", str(Reason.DISARMED))


def test_a_low_battery_lands_by_the_autopilots_own_landing() -> None:
    """BRAKE, then LAND, although the autopilot itself only warns."""
    air = flying("ardupilot")
    air.flight.quadrotor.discharge(0.1)
    air.run(60.0, lambda: not air.flight.armed)
    after = [mode for mode, reason in modes(air) if reason == str(Reason.BATTERY)]
    assert after == ["brake", "hover", "land"]
    assert air.flight.mode_name == "LAND"
    assert not air.flight.armed
    assert "Battery 1 is low" in [each.text for each in air.of(AutopilotText)]


def test_the_voltage_counts_as_well() -> None:
    """The voltage counts if its key is set; a drop of one second does not."""
    air = flying("ardupilot", mavlink={"battery_min_v": 5.0})
    weak = altered("SYS_STATUS", voltage_battery=lambda _: 4900)
    air.tap.alter = weak
    air.run(1.0)
    air.tap.alter = None
    air.run(3.0)
    assert air.mode is Mode.TRACK
    air.tap.alter = weak
    air.run(3.5)
    assert modes(air)[-1][1] == str(Reason.BATTERY)


def test_a_low_battery_is_not_taken_off_with() -> None:
    air = Air("ardupilot", mavlink={"patience_s": 4.0}, vehicle={"battery": 0.18})
    air.end(30.0)
    doing, because = why(air)
    assert doing == "not armed in 4 s"
    assert "mavlink.battery_min" in because
    assert not air.commands(ARM)


def test_the_autopilots_own_failsafe_is_left_alone() -> None:
    """The autopilot has lost its estimate and lands; the client only reports that."""
    air = flying("px4")
    air.flight.estimates = False
    lost_ns = air.world.now_ns
    air.lands(20.0)
    assert modes(air)[-2][0] == "manual" or modes(air)[-1][0] == "manual"
    assert all(
        each.command != SET_MODE for time_ns, each in air.heard("COMMAND_LONG") if time_ns > lost_ns
    )


def test_a_lost_estimate_lands_where_the_autopilot_does_not(flavour: FlavourName) -> None:
    """BRAKE, then the autopilot's landing; only flags report the lost estimate."""
    air = flying(flavour)
    air.flight.once = lambda _: False
    air.flight.estimates = False
    air.run(10.0, lambda: air.flight.mode is FlightMode.LAND)
    assert ("land", str(Reason.ASTRAY)) in modes(air)
    assert air.flight.mode is FlightMode.LAND


def test_a_silent_autopilot_makes_it_brake_and_hover(aloft: Air) -> None:
    """After mavlink.silence_s set-points fall to zero, until the autopilot answers again."""
    air = aloft
    air.tap.dumb = True
    silent_ns = air.world.now_ns
    air.run(3.0)
    rows = air.rows()
    braking = rows[rows["reason"] == Reason.MUTE]
    first = braking["step"][0] - air.rows()["step"][-1]
    after_s = 3.0 + float(first) * air.scenario.control.dt
    assert 0.45 <= after_s <= 0.65
    assert modes(air)[-2:] == [("brake", str(Reason.MUTE)), ("hover", str(Reason.MUTE))]
    last = [(each.vx, each.vy, each.vz) for _, each in air.setpoints(silent_ns)][-5:]
    assert last == [(0.0, 0.0, 0.0)] * 5
    air.tap.dumb = False
    air.run(4.0)
    assert air.mode is Mode.TRACK


# End of the client


def test_killed_we_repeat_nothing_and_the_autopilot_acts() -> None:
    """ArduCopter stops after its timeout and lands after its ground-station timeout."""
    air = flying("ardupilot")
    air.world.stop("client")
    killed_ns = air.world.now_ns
    air.run(4.0)
    assert not air.setpoints(killed_ns + 1)
    assert np.linalg.norm(air.flight.velocity()[:2]) < 0.5
    assert air.flight.mode is FlightMode.GUIDED
    air.lands()


def test_a_pilot_that_does_not_call_is_not_repeated_for_long() -> None:
    """If the client's loop stops calling, its port sends nothing after half a second."""
    air = flying("ardupilot")
    air.client._pilot.next_ns = None  # its loop has died
    air.client._begin = lambda _: None
    died_ns = air.world.now_ns
    air.run(3.0)
    times = [time_ns - died_ns for time_ns, _ in air.setpoints(died_ns)]
    assert 0.3 * SECOND < times[-1] <= 0.56 * SECOND
    assert air.heard("HEARTBEAT", died_ns + SECOND)


def test_who_ends_in_flight_says_land_three_times() -> None:
    """On Ctrl-C or SIGTERM in flight; on the ground nothing is sent."""
    air = flying("px4")
    before = len(air.commands(SET_MODE))
    air.world.act("client", air.client.close)
    air.world.stop("client")
    air.run(0.1)
    assert len(air.commands(SET_MODE)) == before + 3
    assert air.flight.mode is FlightMode.LAND
    air.lands()


def test_who_ends_on_the_ground_begins_nothing() -> None:
    air = Air("ardupilot")
    air.run(20.0, lambda: air.client._session.number is not None)
    assert air.close(5.0) == 0
    assert not air.flight.armed


# Other traffic


def test_others_are_not_the_autopilot(aloft: Air) -> None:
    air = aloft
    others = Codec(2, 1), Codec(255, 190), Codec(1, 100), Codec(245, 191)
    heartbeat = dialect.MAVLink_heartbeat_message(2, 3, 81, 9, 4, 3)
    lands = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    position = dialect.MAVLink_local_position_ned_message(5000, 99.0, 99.0, -99.0, 9.0, 9.0, 9.0)
    low = dialect.MAVLink_sys_status_message(0, 0, 0, 0, 1000, 0, 1, 0, 0, 0, 0, 0, 0)
    before = air.figures()["ignored"]["foreign"]
    for _ in range(50):
        air.tap.extra += [
            codec.encode(each) for codec in others for each in (heartbeat, lands, position, low)
        ]
        air.run(0.05)
    assert air.mode is Mode.TRACK
    assert air.figures()["ignored"]["foreign"] == before + 50 * 16
    own = Codec(1, 1)
    ack = dialect.MAVLink_command_ack_message(ARM, 4, target_system=255, target_component=190)
    air.tap.extra.append(own.encode(ack))
    air.run(0.1)
    assert air.figures()["ignored"]["for_others"] == 1
    assert not air.of(AutopilotRefused)


def late_heartbeat(air: Air, until: Callable[[], bool]) -> None:
    """Run until a condition holds; an old heartbeat arrives again 0.3 s later."""
    heartbeats: list[bytes] = []

    def note(message: Message) -> None:
        if message.get_type() == "HEARTBEAT":
            heartbeats.append(bytes(message.get_msgbuf()))

    air.tap.alter = note
    air.run(30.0, until)
    before = heartbeats[-1]
    air.run(0.3)
    air.tap.extra.append(before)


def test_a_late_heartbeat_does_not_take_the_vehicle_back_from_a_pilot() -> None:
    """It was sent before the pilot took over; one with a newer number has already arrived."""
    air = flying("ardupilot")
    end_ns = air.world.now_ns + SECOND
    air.world.at(end_ns - 1, air.take_over)
    late_heartbeat(air, lambda: air.world.now_ns >= end_ns)
    air.quiet(2.0)
    assert modes(air)[-1] == ("manual", str(Reason.TAKEN))
    assert air.of(AutopilotMode)[-1].mode == "LOITER"
    assert sum(each.mode == "LOITER" for each in air.of(AutopilotMode)) == 1


def test_an_autopilot_that_counts_anew_is_heard_after_a_pause() -> None:
    air = flying("ardupilot")
    (peer,) = air.autopilot._peers.values()
    air.tap.dumb = True
    air.run(2.0)
    air.tap.dumb = False
    peer.codec._mavlink.seq = (peer.codec._mavlink.seq - 120) % 256
    air.take_over()
    air.run(0.5)
    assert modes(air)[-1] == ("manual", str(Reason.TAKEN))


def test_stamps_that_cannot_be_are_dropped_and_counted(aloft: Air) -> None:
    """Duplicate, out of order, ahead, old, far and non-finite stamps; the state stays right."""
    air = aloft
    codec = Codec(1, 1)
    now_ms = air.flight.now_ns // 1_000_000

    def position(boot_ms: int, x: float = 50.0) -> bytes:
        message = dialect.MAVLink_local_position_ned_message(boot_ms, x, 0.0, -2.0, 0.0, 0.0, 0.0)
        return codec.encode(message)

    before = dict(air.figures()["dropped"])
    air.tap.extra += [
        position(now_ms - 2000),
        position(now_ms - 100),
        position(now_ms + 500),
        position(now_ms + 600_000),
        position(now_ms, float("nan")),
        position(now_ms, 1e9),
    ]
    air.run(0.2)
    after = air.figures()["dropped"]
    new = {name: count - before.get(name, 0) for name, count in after.items()}
    assert {name: count for name, count in new.items() if count} == {
        "old": 1,
        "late": 1,
        "impossible": 2,
        "not_finite": 1,
        "far": 1,
    }
    air.run(0.5)
    error = air.rows()["estimate"][-1, :, 0] - np.array(air.flight.position())
    assert np.abs(error).max() < 0.3


def test_a_bad_line_brings_it_into_the_air_as_well() -> None:
    """A fifth of the frames of either side is lost, a tenth duplicated, a tenth truncated."""
    air = Air("px4", duration=5.0)
    rng = np.random.default_rng(1)
    inner = air.tap.outbox

    def worse() -> list[Datagram]:
        sent = []
        for datagram, draw in ((each, rng.random()) for each in inner()):
            if draw >= 0.2:
                sent.append(datagram)
            if 0.2 <= draw < 0.3:
                sent.append(datagram)
            elif 0.3 <= draw < 0.4:
                cut = datagram.payload[: int(rng.integers(0, 30))]
                sent.append(datagram._replace(payload=cut))
        return sent

    air.tap.outbox = worse  # type: ignore[method-assign]
    air.fly(90.0)
    air.end()
    assert air.client.failure is None
    assert air.figures()["garbage_bytes"] > 0
    assert air.figures()["dropped"]["doubled"] > 10


def test_a_line_of_bytes_may_come_in_any_pieces() -> None:
    line = {"address": "tcp:127.0.0.1:5760"}
    air = Air("ardupilot", host="line", duration=3.0, vehicle=line)
    rng, inner, held = np.random.default_rng(2), air.tap.outbox, bytearray()

    def in_pieces() -> list[Datagram]:
        sent = inner()
        held.extend(b"".join(each.payload for each in sent))
        pieces = []
        while sent and len(held) > 20:
            size = int(rng.integers(1, 60))
            pieces.append(sent[0]._replace(payload=bytes(held[:size])))
            del held[:size]
        return pieces

    air.tap.outbox = in_pieces  # type: ignore[method-assign]
    air.fly()
    assert air.figures()["garbage_bytes"] == 0
    assert air.figures()["heard"] > 400


def test_setpoints_come_more_often_than_slow_steps() -> None:
    """The last velocity is repeated between steps of 0.1 s."""
    air = flying("ardupilot", control={"dt": 0.1, "horizon": 40})
    began_ns = air.world.now_ns
    air.run(2.0)
    assert 2 * 18 - 1 <= len(air.setpoints(began_ns)) <= 2 * 20 + 1


def test_a_stream_that_stops_is_asked_for_again(aloft: Air) -> None:
    air = aloft
    (peer,) = air.autopilot._peers.values()
    number = int(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    del peer.streams[number]
    air.run(5.0)
    assert number in peer.streams
    assert air.mode in (Mode.HOVER, Mode.TRACK)


def test_an_autopilot_that_never_speaks_again_is_left_to_its_own_failsafe() -> None:
    air = flying("ardupilot", vehicle={"land_after_s": 2.0})
    air.autopilot.script.silent = True
    silent_ns = air.world.now_ns
    down_s = air.run(60.0, lambda: not air.flight.armed)
    assert [after for after, _ in modes(air)][-3:] == ["brake", "hover", "land"]
    assert modes(air)[-1] == ("land", str(Reason.MUTE))
    assert not air.heard("HEARTBEAT", silent_ns + 8 * SECOND)
    assert not air.setpoints(silent_ns + 8 * SECOND)
    assert down_s < 30.0


def test_a_vehicle_that_drifts_over_its_fence_lands_when_its_link_is_lost() -> None:
    """Its accelerometers have failed, so the fence's corrections have no effect."""
    fence = {"low_m": [-9.0, -9.0, 0.5], "high_m": [8.0, 9.0, 9.0], "wind_mps": 0.5}
    air = flying("ardupilot", "drift@1", fence=fence, vehicle={"land_after_s": 2.0})
    air.until(lambda: air.flight.position()[0] > 8.2, 30.0)
    air.world.stop("server")
    lost_s = air.run(30.0, lambda: air.mode is Mode.LAND)
    assert [after for after, _ in modes(air)][-3:] == ["brake", "hover", "land"]
    # The timeout, braking from 3 m/s on all axes at 2 m/s², hovering, and landing.
    assert lost_s < 1.5 + 3.1 + 2.0 + 0.2
    assert air.setpoints()[-1][1].vx < -1.0
