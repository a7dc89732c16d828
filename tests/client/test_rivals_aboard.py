"""Second commanders of an autopilot, detected on the line or by the vehicle's motion."""

from typing import Any

import numpy as np
import pytest

from airborne import SECOND, Air, flying, modes, scenario
from bench.autopilots import MODELS
from skytether.autopilot.faults import COMMANDED
from skytether.autopilot.flavours import FlavourName
from skytether.autopilot.flight import Vector
from skytether.client.mavlink.obedience import Obedience
from skytether.client.mavlink.rivals import QUIET_NS, Rivals
from skytether.mavlink.codec import Codec, Message
from skytether.mavlink.dialect import dialect
from skytether.shared.events.aboard import SecondCommander, Strays
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.protocol import Mode

FENCE = {"low_m": [-8.0, -8.0, 0.5], "high_m": [8.0, 8.0, 9.0]}
STATION = Codec(255, 190)
SLOW = {"axes": 3, "tau_s": [0.5, 0.5, 0.25], "u_max": [2.0]}


def tracking(flavour: FlavourName = "ardupilot", **table: Any) -> Air:
    """Vehicle that has followed its plan for some seconds, within a fence."""
    return flying(flavour, seconds=5.0, **{"fence": FENCE, "model": SLOW | MODELS[flavour]} | table)


def velocity(target: int = 1) -> Message:
    return dialect.MAVLink_set_position_target_local_ned_message(
        1, target, 1, 1, 0b110111000111, 0, 0, 0, 3.0, 0, 0, 0, 0, 0, 0, 0
    )


def sticks(x: int) -> Message:
    return dialect.MAVLink_manual_control_message(1, x, 0, 500, 0, 0)


def channels(roll_us: int) -> Message:
    return dialect.MAVLink_rc_channels_override_message(1, 1, roll_us, 1500, 0, 1500, 0, 0, 0, 0)


def goto() -> Message:
    return dialect.MAVLink_command_long_message(1, 1, 192, 0, -1.0, 0, 0, 0, 0, 0, 0)


def say(air: Air, message: Message, seconds: float, every_s: float = 0.1) -> None:
    """Send another commander's message on the line repeatedly."""
    for _ in range(round(seconds / every_s)):
        air.tap.extra.append(STATION.encode(message))
        air.run(every_s)


# Detected by the motion of the vehicle


@pytest.mark.long
def test_a_commander_that_nobody_sees_is_noticed_and_the_vehicle_lands() -> None:
    """The other commander sends at 50 Hz and wins; braking fails, so the vehicle lands in a mode
    that ignores set-points.
    """
    air = tracking("ardupilot")
    began, began_ns = np.array(air.flight.position()), air.world.now_ns
    air.autopilot.script._commands = True
    noticed_s = air.run(5.0, lambda: bool(air.of(Strays)))
    assert noticed_s < 1.4
    assert modes(air)[-1] == ("brake", str(Reason.STRAYED))
    air.run(20.0, lambda: air.mode is Mode.LAND)
    assert (air.world.now_ns - began_ns) / SECOND < 4.5
    assert modes(air)[-1] == ("land", str(Reason.STRAYED))
    air.lands()
    assert np.linalg.norm(np.array(air.flight.position())[:2] - began[:2]) < 12.0


@pytest.mark.parametrize("commanded", [(0.4, 0.0, 0.0), (0.7, 0.0, 0.0), (0.0, 1.0, 0.0)])
def test_a_slow_commander_is_noticed_and_the_fence_holds(
    flavour: FlavourName, commanded: Vector
) -> None:
    """Once noticed, the vehicle is not flown again: it lands, within its fence."""
    air = tracking(flavour)
    air.autopilot.script.commanded, air.autopilot.script._commands = commanded, True
    air.until(lambda: air.mode is Mode.LAND, 8.0)
    assert modes(air)[-1] == ("land", str(Reason.STRAYED))
    noticed = modes(air).index(("brake", str(Reason.STRAYED)))
    assert "track" not in [after for after, _ in modes(air)[noticed:]]
    air.lands()
    places = air.truth.rows()["state"][:, :2, 0]
    assert np.abs(places).max() < 8.0


def test_a_vehicle_that_is_commanded_to_stand_and_moves_lands(flavour: FlavourName) -> None:
    air = tracking(flavour, vehicle={"land_after_s": 60.0})
    air.world.stop("server")
    air.until(lambda: air.mode is Mode.HOVER, 10.0)
    air.run(3.0)
    air.autopilot.script.commanded, air.autopilot.script._commands = (1.0, 0.0, 0.0), True
    air.until(lambda: air.mode is Mode.LAND, 8.0)
    assert modes(air)[-1] == ("land", str(Reason.STRAYED))


def test_who_disobeys_twice_within_a_minute_is_obedient_no_more() -> None:
    """Until somebody else has flown it."""
    obedience = Obedience(scenario(model=SLOW, fence=FENCE))
    now_ns = 0

    def fly(north_mps: float, seconds: float) -> bool:
        nonlocal now_ns
        for _ in range(round(seconds / 0.05)):
            now_ns += SECOND // 20
            obedience.step((0.0, 0.0, 0.0), (north_mps, 0.0, 0.0), now_ns=now_ns)
        return obedience.strays

    assert not fly(0.0, 1.0)
    assert fly(3.0, 1.0)
    assert fly(0.35, 3.0)
    assert not fly(0.0, 2.0)
    assert fly(3.0, 1.0)
    obedience.pause()
    assert fly(0.0, 100.0)
    obedience.begin()
    assert not fly(0.0, 1.0)
    assert fly(3.0, 1.0)
    assert not fly(0.0, 61.0)
    assert fly(3.0, 1.0)
    assert not fly(0.0, 1.0)


WEATHER: dict[str, dict[str, Any]] = {
    "calm": {},
    "wind": {"steady_wind_mps": [6.0, -3.0, 0.0]},
    "turbulence": {"steady_wind_mps": [4.0, 0.0, 0.0], "turbulence_mps": 8.0},
}


def unlike(flavour: FlavourName, slower: float, stronger: float) -> dict[str, Any]:
    """Keys of a model that differs from the vehicle."""
    model = {"axes": 3, "tau_s": [0.5], "gain": 1.0, "u_max": [3.0]} | MODELS[flavour]
    gain = model["gain"] if isinstance(model["gain"], list) else [model["gain"]] * 3
    return model | {
        "tau_s": [slower * each for each in model["tau_s"]],
        "gain": [stronger * each for each in gain],
    }


@pytest.mark.long
@pytest.mark.parametrize("weather", WEATHER)
@pytest.mark.parametrize("wrong", [(1.0, 1.0), (1.3, 0.8), (0.7, 1.2)])
def test_neither_wind_nor_a_wrong_model_is_taken_for_a_commander(
    flavour: FlavourName, weather: str, wrong: tuple[float, float]
) -> None:
    air = Air(
        flavour,
        duration=60.0,
        model=unlike(flavour, *wrong),
        vehicle=WEATHER[weather],
        reference={"period_s": 15.0},
    )
    air.fly(90.0)
    air.run(16.0)
    air.tap.deaf = False
    air.world.stop("server")
    air.run(8.0)
    assert not air.of(Strays)
    assert str(Reason.STRAYED) not in [why for _, why in modes(air)]


# Detected on the line


def repeated(message: Message, every_ns: int = SECOND // 10) -> Rivals:
    """Detector that has heard another commander's message twice."""
    rivals = Rivals()
    for now_ns in (SECOND, SECOND + every_ns):
        rivals.hear(message, 1, now_ns=now_ns)
    return rivals


@pytest.mark.parametrize("message", [velocity(), sticks(400), channels(1700)])
def test_two_set_points_within_a_second_are_a_second_commander(message: Message) -> None:
    rivals = repeated(message, every_ns=SECOND)
    assert rivals.newest[2] == message.get_type()
    assert rivals.are_there(now_ns=2 * SECOND + QUIET_NS)
    assert not rivals.are_there(now_ns=2 * SECOND + QUIET_NS + 1)
    assert not repeated(message, every_ns=SECOND + 1).are_there(now_ns=3 * SECOND)


def item(current: int) -> Message:
    return dialect.MAVLink_mission_item_int_message(1, 1, 0, 6, 16, current, 1, *[0] * 7)


@pytest.mark.parametrize(
    ("message", "moves"), [(goto(), True), (item(1), False), (item(2), True), (item(3), True)]
)
def test_a_command_to_go_somewhere_counts_at_once(message: Message, *, moves: bool) -> None:
    rivals = Rivals()
    rivals.hear(message, 1, now_ns=SECOND)
    assert rivals.are_there(now_ns=SECOND) == moves


@pytest.mark.parametrize(
    "message",
    [
        velocity(target=2),
        sticks(50),
        channels(1550),
        channels(65535),
        dialect.MAVLink_param_request_list_message(1, 1),
    ],
)
def test_what_others_say_that_moves_nothing_is_no_command(message: Message) -> None:
    assert not repeated(message).are_there(now_ns=SECOND + SECOND // 10)


def test_set_points_of_others_are_noticed_within_a_second() -> None:
    air, message = tracking(), velocity()
    say(air, message, 0.5)
    (event,) = air.of(SecondCommander)
    assert (event.system, event.component, event.said) == (255, 190, message.get_type())
    assert modes(air)[-1] == ("brake", str(Reason.RIVAL))
    say(air, message, 3.0)
    assert modes(air)[-1] == ("land", str(Reason.RIVAL))


def test_a_vehicle_may_yield_to_a_second_commander_as_to_a_pilot() -> None:
    """Nothing is sent meanwhile; three seconds after the last foreign set-point it hovers."""
    air = tracking(mavlink={"second_commander": "yield"})
    say(air, velocity(), 0.5)
    assert modes(air)[-1] == ("manual", str(Reason.TAKEN))
    quiet_ns = air.world.now_ns
    say(air, velocity(), 3.0)
    assert not air.setpoints(quiet_ns)
    air.run(3.5)
    assert ("hover", str(Reason.RETURNED)) in modes(air)
    air.run(3.0)
    assert air.mode is Mode.TRACK


def test_a_vehicle_that_yields_sends_nothing_while_it_is_led_away() -> None:
    """No foreign message is on the line, but the vehicle moves despite a command to stand."""
    air = tracking("ardupilot", mavlink={"second_commander": "yield"})
    air.autopilot.script._commands = True
    air.run(3.0, lambda: bool(air.of(Strays)))
    assert modes(air)[-1] == ("manual", str(Reason.TAKEN))
    air.run(0.3)
    air.quiet(2.0)
    assert air.flight.velocity()[0] == pytest.approx(COMMANDED[0], abs=1.0)
