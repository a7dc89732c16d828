"""Behaviour of real autopilots, repeated by the scripted ones, and the client's messages."""

from collections.abc import Callable

import pytest

from airborne import SET_MODE, Air, altered, modes
from skytether.autopilot.flavours import FlightMode
from skytether.mavlink.codec import Codec
from skytether.mavlink.dialect import dialect
from skytether.netem.proxy import Proxy
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.events.aboard import (
    AutopilotElsewhere,
    AutopilotMoved,
    AutopilotRefused,
    AutopilotText,
    ClockSilent,
    NotTakenOff,
    ParametersRead,
    PositionsDropped,
    TextsOmitted,
)
from skytether.shared.events.ground import AutopilotWaits, ServerHeard, ServerSilent, Welcomed
from skytether.shared.telemetry.record import Reason


@pytest.fixture(scope="module")
def aloft() -> Air:
    """Vehicle in the air; each test that takes it leaves it flying a plan."""
    air = Air("px4", duration=60.0)
    air.fly()
    air.run(3.0)
    return air


# Clock


@pytest.mark.long
@pytest.mark.parametrize("ppm", [-20_000.0, 20_000.0])
def test_a_clock_that_runs_up_to_2_percent_wrong_is_followed(ppm: float) -> None:
    """PX4's own simulator runs 0.86 % slow; its positions are used throughout."""
    air = Air("px4", autopilot_ppm=ppm, duration=25.0)
    air.fly()
    air.end()
    figures = air.figures()
    assert sum(figures["dropped"].values()) < 10, figures
    assert figures["drift_ppm"] == pytest.approx(-ppm, rel=0.03)
    assert not [mode for mode in modes(air) if mode[0] == "brake"]


def test_a_simulator_that_runs_faster_than_time_is_not_flown_and_its_speed_is_told() -> None:
    air = Air(autopilot_ppm=4e6, mavlink={"patience_s": 5.0})
    air.until(lambda: air.of(NotTakenOff), 20.0)
    (failed,) = air.of(NotTakenOff)
    assert "speed is 5" in failed.why
    assert not air.flight.armed


def test_positions_that_cannot_be_used_are_not_called_silence(aloft: Air) -> None:
    air = aloft
    air.tap.alter = altered("LOCAL_POSITION_NED", time_boot_ms=lambda ms: ms + 60_000)
    air.run(2.0)
    assert ("brake", str(Reason.UNUSABLE)) in modes(air)
    (dropped,) = air.of(PositionsDropped)
    assert "future" in dropped.why
    air.tap.alter = None
    air.run(5.0)
    assert modes(air)[-1][0] == "track"


# Consecutive flights


def test_it_is_flown_again_in_one_power_up() -> None:
    """After a landing PX4 is in OFFBOARD, and without set-points it refuses to arm there."""
    air = Air("px4", duration=2.0)
    air.fly()
    air.end()
    air.events.clear()
    air.restart(remembers=False)
    air.fly()
    assert not air.of(AutopilotRefused)


def test_px4_says_why_it_is_not_armed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its text is logged without tabs, and is the reason given at the end."""
    air = Air("px4", mavlink={"patience_s": 4.0})
    words = "Arming denied: Resolve system health failures first"
    monkeypatch.setattr(air.flight, "why_not_armed", lambda: f"{words}\t")
    air.run(30.0, lambda: bool(air.of(NotTakenOff)))
    assert words in [each.text for each in air.of(AutopilotText)]
    assert [each.why for each in air.of(NotTakenOff)] == [words]


def test_the_altitude_of_take_off_is_above_the_ground_it_stands_on() -> None:
    """PX4's height estimate had drifted by 1.3 m since home was set, and it climbed to 3.7 m."""
    air = Air("px4", duration=5.0)
    drifted = {"altitude": lambda mm: mm - 1300, "z": lambda _: 1.3}
    air.tap.alter = altered("HOME_POSITION", **drifted)
    air.fly()
    assert air.flight.position()[2] == pytest.approx(2.0, abs=0.3)


def test_an_autopilot_that_has_taken_the_vehicle_from_a_client_that_stalled_keeps_it() -> None:
    """The client stalls for 3 s. The first set-point would put PX4 back into OFFBOARD."""
    air = Air("px4", duration=60.0)
    air.fly()
    air.run(4.0)
    air.world.freeze("client")
    air.tap.dumb = True
    air.run(3.0)
    assert air.flight.mode is FlightMode.LAND
    air.tap.dumb = False
    thawed_ns = air.world.now_ns
    air.world.thaw("client")
    air.run(2.0)
    assert not air.setpoints(thawed_ns)
    assert air.flight.mode is FlightMode.LAND
    assert modes(air)[-1] == ("manual", str(Reason.TAKEN))


# Messages of a bench check


def test_the_session_of_a_vehicle_that_is_not_armed_is_told() -> None:
    air = Air(armed=False)
    air.run(8.0)
    assert len(air.of(Welcomed)) == 1
    assert air.of(AutopilotWaits)[-1].waits_for == "armed = true"
    assert not air.of(ServerSilent)


def test_a_link_that_is_cut_on_the_ground_is_told_and_that_it_is_back() -> None:
    air = Air(armed=False)
    air.run(8.0)
    air.world.stop("netem")
    air.run(12.0)
    assert len(air.of(ServerSilent)) == 1
    air.world.restart("netem", Proxy(air.scenario, server=("server", 0), flows=1))
    air.run(3.0)
    (heard,) = air.of(ServerHeard)
    assert heard.silent_s == pytest.approx(12.0, abs=2.0)


@pytest.mark.long
def test_a_lossy_link_is_no_silence_on_the_ground() -> None:
    ways = "constant(0.5) & loss(0.2)"
    air = Air(armed=False, network={"uplink": ways, "downlink": ways})
    air.run(120.0)
    assert len(air.of(Welcomed)) == 1
    assert not air.of(ServerSilent)


def test_an_autopilot_that_asks_for_our_time_is_no_untimely_answer(aloft: Air) -> None:
    """PX4 asks ten times a second."""
    before = aloft.figures()["dropped"]["untimely"]
    for stamp_ns in range(1, 11):
        request = dialect.MAVLink_timesync_message(0, stamp_ns)
        aloft.tap.extra.append(Codec(1, 1).encode(request))
        aloft.run(0.1)
    assert aloft.figures()["dropped"]["untimely"] == before
    aloft.tap.extra.append(Codec(1, 1).encode(dialect.MAVLink_timesync_message(7, 7)))
    aloft.run(0.1)
    assert aloft.figures()["dropped"]["untimely"] == before + 1


def test_an_autopilot_that_answers_timesync_no_more_is_told_once(aloft: Air) -> None:
    air = aloft
    air.tap.alter = lambda message: b"" if message.get_type() == "TIMESYNC" else None
    air.run(12.5)
    air.tap.alter = None
    (silent,) = air.of(ClockSilent)
    assert 10.0 < silent.silent_s < 12.0
    assert modes(air)[-1][0] == "track"


def test_an_autopilot_that_does_not_answer_timesync_is_told_and_given_up() -> None:
    """Otherwise the client would wait for ever, without a message."""
    air = Air(mavlink={"patience_s": 5.0})
    air.tap.alter = lambda message: b"" if message.get_type() == "TIMESYNC" else None
    air.run(20.0, lambda: bool(air.of(NotTakenOff)))
    assert "TIMESYNC" in air.of(AutopilotWaits)[-1].waits_for
    (failed,) = air.of(NotTakenOff)
    assert "TIMESYNC" in failed.why
    assert air.client.finished


def test_what_is_waited_for_is_the_autopilot_before_it_is_the_server() -> None:
    air = Air()
    air.tap.dumb = True
    air.run(5.0)
    (waits,) = air.of(AutopilotWaits)
    assert "heartbeat" in waits.waits_for


def test_a_line_that_is_cut_is_told_in_the_climb() -> None:
    """Nothing arrives from the autopilot for 8 s of the 60 s that the climb may take."""
    air = Air()
    air.until(lambda: air.flight.armed, 30.0)
    air.tap.dumb = True
    air.run(8.0)
    assert "it is silent" in air.of(AutopilotWaits)[-1].waits_for


def test_a_vehicle_found_armed_waits_for_a_person_once_it_is_disarmed() -> None:
    air = Air("ardupilot")
    air.run(1.5)
    air.flight.enter(5)
    air.flight.arm()
    air.run(6.0)
    assert "it is armed, in LOITER" in air.of(AutopilotWaits)[-1].waits_for
    assert not air.commands(SET_MODE)
    air.flight.disarm()
    air.run(6.0)
    assert air.of(AutopilotWaits)[-1].waits_for == "armed = true"


# Another address


def test_an_autopilot_that_restarts_on_the_ground_is_taken_from_its_new_address() -> None:
    """`udp:` line: another source port after 4 s of silence, with a complete new set-up."""
    air = Air(armed=False, vehicle={"address": "udp:0.0.0.0:14540"})
    air.run(6.0)
    assert len(air.of(ParametersRead)) == 1
    beat = heartbeats(air, from_port=2)
    beat()
    assert not air.of(AutopilotMoved)
    air.tap.dumb = True
    air.run(4.0)
    beat()
    (event,) = air.of(AutopilotMoved)
    assert event.after.endswith(":2")
    assert air.client._port._connection.peer[1] == 2
    assert not air.client._flies.is_ready


def test_in_flight_another_address_is_not_taken_and_what_comes_from_it_is_told() -> None:
    air = Air(duration=60.0, vehicle={"address": "udp:0.0.0.0:14540"})
    air.fly()
    air.tap.dumb = True
    air.run(4.0)
    heartbeats(air, from_port=2)()
    heartbeats(air, from_port=2)()
    assert not air.of(AutopilotMoved)
    (event,) = air.of(AutopilotElsewhere)
    assert event.came_from.endswith(":2")
    assert "HEARTBEAT of system 1" in event.content


def heartbeats(air: Air, from_port: int) -> Callable[[], None]:
    """Function that sends the client a heartbeat of the autopilot from another port."""
    codec = Codec(1, 1)

    def beat() -> None:
        message = dialect.MAVLink_heartbeat_message(2, 3, 1, 4, 3, 3)
        datagram = Datagram(codec.encode(message), ("autopilot", from_port), 1)
        air.client.receive(datagram, now_ns=air.client._port.now_ns)
        air.events += [(air.world.now_ns, "client", event) for event in air.client.events()]

    return beat


# Messages


def test_a_stream_that_is_being_set_is_not_refused() -> None:
    air = Air()
    codec = Codec(1, 1)
    for result in (dialect.MAV_RESULT_IN_PROGRESS, dialect.MAV_RESULT_DENIED):
        air.run(3.0)
        air.tap.extra.append(codec.encode(dialect.MAVLink_command_ack_message(511, result)))
    air.run(1.0)
    assert [each.answer for each in air.of(AutopilotRefused)] == ["denied"]


def test_texts_at_400_a_second_do_not_fill_the_log() -> None:
    air = Air(armed=False)
    air.run(3.0)
    codec = Codec(1, 1)
    before = len(air.of(AutopilotText))
    for k in range(2000):
        message = dialect.MAVLink_statustext_message(6, f"text {k}".encode())
        air.tap.extra.append(codec.encode(message))
        if k % 40 == 0:
            air.run(0.1)
    air.run(3.0)
    logged = len(air.of(AutopilotText)) - before
    omitted = sum(each.count for each in air.of(TextsOmitted))
    assert logged + omitted == 2000
    assert logged + len(air.of(TextsOmitted)) < 40
