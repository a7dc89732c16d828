"""The autopilot's position receiver: a fix that is lost, and a position that shifts in silence."""

import math
from typing import Any

import numpy as np
import pytest

from airborne import Air, altered, flying, modes
from bench.autopilots import MODELS
from skytether.autopilot.faults import SHIFT
from skytether.autopilot.flavours import FlavourName
from skytether.client.mavlink.receiver import LOST_NS
from skytether.client.slides import LAG_S, SLID_M, Slides
from skytether.shared.events.flight import StateLeapt
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.protocol import Mode

FENCE = {"low_m": [-8.0, -8.0, 0.5], "high_m": [8.0, 8.0, 9.0], "wind_mps": 0.5}
SLOW = {"axes": 3, "tau_s": [0.5, 0.5, 0.25], "u_max": [2.0]}
SECOND = 1_000_000_000


def tracking(flavour: FlavourName, **table: Any) -> Air:
    keys = {"fence": FENCE, "model": SLOW | MODELS[flavour], "duration": 90.0} | table
    return flying(flavour, seconds=5.0, **keys)


def place(air: Air) -> Any:
    return np.array(air.flight.position()[:2])


# A shift


def test_a_shift_of_the_receiver_moves_neither_figure_nor_fence(flavour: FlavourName) -> None:
    """The estimate slides by 3 m within 4 s, and the autopilot reports nothing."""
    air = tracking(flavour)
    began, air.flight.shift = place(air), SHIFT
    air.until(lambda: air.of(StateLeapt), 3.0)
    assert modes(air)[-1] == ("brake", str(Reason.LEAPT))
    air.run(8.0)
    assert modes(air)[-1] == ("hover", str(Reason.LEAPT))
    leapt = air.of(StateLeapt)[-1].by_m
    assert leapt == pytest.approx(SHIFT, abs=0.6)
    np.testing.assert_allclose(air.flies.port.autopilot.positions.origin, leapt)
    # The autopilot's own velocity errs meanwhile, and moves it by half of the shift.
    assert np.linalg.norm(place(air) - began) < 5.5
    air.change(vehicle__after_leap="old")
    air.until(lambda: air.mode is Mode.TRACK, 5.0)
    air.run(5.0)
    estimate = air.rows()["estimate"][-1, :2, 0]
    np.testing.assert_allclose(estimate, place(air), atol=0.7)


def test_who_has_decided_about_a_slide_is_not_asked_about_its_rest() -> None:
    air = tracking("ardupilot")
    air.flight.shift = SHIFT
    air.until(lambda: air.of(StateLeapt), 3.0)
    air.change(vehicle__after_leap="old")
    air.run(10.0)
    assert len(air.of(StateLeapt)) == 1
    assert air.mode is Mode.TRACK
    assert air.flies.port.autopilot.positions.origin == pytest.approx(SHIFT, abs=0.6)


def test_in_the_new_frame_a_shift_counts() -> None:
    air = tracking("ardupilot")
    air.flight.shift = SHIFT
    air.until(lambda: air.of(StateLeapt), 3.0)
    air.run(6.0)
    air.change(vehicle__after_leap="new")
    assert air.flies.port.autopilot.positions.origin == pytest.approx((0.0, 0.0, 0.0), abs=0.05)
    air.until(lambda: air.mode is Mode.TRACK, 5.0)


def slides(moves: list[tuple[float, float]], speed_mps: float = 0.0) -> list[float]:
    """Displacements that are found in a position that moves at a speed, read by a receiver.

    Args:
        moves: errors of the position [m], and from which time on [s].
        speed_mps: speed of vehicle and receiver, north.
    """
    found, sought = list[float](), Slides()
    for k in range(150):
        time_s = 0.2 * k
        wrong = sum(error for since_s, error in moves if time_s >= since_s) - sum(found)
        slide = sought.slid((speed_mps * time_s + wrong, 0.0), (speed_mps, 0.0), k * SECOND // 5)
        if slide is not None:
            found.append(slide.by_m[0])
    return found


def test_what_slides_less_than_the_least_distance_in_five_seconds_is_not_seen() -> None:
    assert slides([(10.0, SLID_M - 0.1)], speed_mps=3.0) == []
    assert sum(slides([(10.0, SLID_M + 0.1)], speed_mps=3.0)) == pytest.approx(SLID_M + 0.1)
    steps = [(10.0 + k, 0.25) for k in range(8)]
    assert slides(steps) == []
    assert sum(slides([(10.0 + 0.5 * k, 0.25) for k in range(12)])) == pytest.approx(3.0, abs=0.3)


def test_a_fix_that_is_reported_late_is_no_slide() -> None:
    """A vehicle that turns round within a second at 4 m/s, its fixes 0.3 s late."""
    late_s, sought = LAG_S, Slides()

    def at(time_s: float) -> tuple[float, float]:
        """Position and velocity, north."""
        return 4.0 * math.cos(time_s), -4.0 * math.sin(time_s)

    for k in range(300):
        time_s = 0.1 * k
        velocity = at(time_s - late_s)[1], 0.0
        assert sought.slid((at(time_s)[0], 0.0), velocity, k * SECOND // 10) is None


def test_positions_that_do_not_arrive_do_not_slide() -> None:
    """The newest one stands, while the fixes go on with the vehicle."""
    air = tracking("ardupilot", mavlink={"silence_s": 3.0})
    air.tap.alter = lambda message: b"" if message.get_type() == "LOCAL_POSITION_NED" else None
    air.run(2.8)
    air.tap.alter = None
    air.run(5.0)
    assert not air.of(StateLeapt)


WEATHER: dict[str, dict[str, Any]] = {
    "calm": {},
    "wind": {"steady_wind_mps": [6.0, -3.0, 0.0]},
    "turbulence": {"steady_wind_mps": [4.0, 0.0, 0.0], "turbulence_mps": 8.0},
}


@pytest.mark.long
@pytest.mark.parametrize("weather", WEATHER)
@pytest.mark.parametrize("wrong", [1.0, 0.75, 1.25])
def test_neither_wind_nor_a_wrong_gain_is_a_slide(
    flavour: FlavourName, weather: str, wrong: float
) -> None:
    model = {"axes": 3, "tau_s": [0.5], "u_max": [3.0]} | MODELS[flavour]
    gains: Any = model.get("gain", [1.0] * 3)
    model["gain"] = [wrong * gain for gain in gains]
    reference = {"period_s": 15.0}
    air = Air(flavour, duration=60.0, model=model, vehicle=WEATHER[weather], reference=reference)
    air.fly(90.0)
    air.run(58.0)
    assert not air.of(StateLeapt)


# A lost fix


def test_a_lost_fix_lands_the_vehicle_before_its_autopilot_notices(flavour: FlavourName) -> None:
    """The autopilot's own flag comes after 5.8 and 7.9 s, when it has drifted away."""
    air = tracking(flavour)
    began, air.flight.fixes = place(air), False
    noticed_s = air.until(lambda: air.mode is Mode.BRAKE, 3.0)
    assert noticed_s < 1.8
    assert modes(air)[-1] == ("brake", str(Reason.ASTRAY))
    air.until(lambda: air.mode is Mode.LAND, 3.0)
    air.lands()
    assert np.linalg.norm(place(air) - began) < 3.0
    assert np.abs(place(air)).max() < 8.0


@pytest.mark.parametrize(
    "fault",
    [
        {"fix_type": lambda _: 2},
        {"h_acc": lambda _: 20_000},
        {"time_usec": lambda _: 9_000_000},
    ],
    ids=["two axes", "inaccurate", "stale"],
)
def test_a_fix_that_cannot_be_used_is_none(fault: dict[str, Any]) -> None:
    air = tracking("ardupilot")
    air.tap.alter = altered("GPS_RAW_INT", **fault)
    air.until(lambda: air.mode is Mode.BRAKE, 3.0)
    assert modes(air)[-1] == ("brake", str(Reason.ASTRAY))


def test_a_gap_between_fixes_is_no_loss() -> None:
    air = tracking("ardupilot")
    air.flight.fixes = False
    air.run(LOST_NS / SECOND - 0.3)
    air.flight.fixes = True
    air.run(3.0)
    assert air.mode is Mode.TRACK


def test_an_autopilot_that_was_silent_has_not_lost_its_fix() -> None:
    """It brakes for the silence, and flies on when it is over."""
    air = tracking("ardupilot")
    air.tap.dumb = True
    air.run(3.0)
    air.tap.dumb = False
    air.until(lambda: air.mode is Mode.TRACK, 5.0)
    assert str(Reason.ASTRAY) not in [why for _, why in modes(air)]


def test_a_vehicle_that_never_had_a_fix_flies_by_another_source() -> None:
    air = Air("ardupilot", duration=60.0)
    air.tap.alter = altered("GPS_RAW_INT", fix_type=lambda _: 0)
    air.fly()
    air.run(5.0)
    assert air.mode is Mode.TRACK
    assert not air.of(StateLeapt)
