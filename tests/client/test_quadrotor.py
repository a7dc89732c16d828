"""Quadrotor: its rigid body compared with rotorpy's, its control loops, wind and battery."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skytether
from skytether.client.simulated.quadrotor import ALTITUDE_M, QuadrotorPlant
from skytether.quadrotor.air import Air, blow
from skytether.quadrotor.body import STATES, STEP_S, drive
from skytether.quadrotor.frames import CRAZYFLIE, FRAMES, GRAVITY, KG15, Frame
from skytether.quadrotor.loops import ARDUPILOT, PX4, Gains, mix
from skytether.quadrotor.loops import CRAZYFLIE as FIRMWARE
from skytether.quadrotor.quadrotor import Quadrotor
from skytether.shared.base.kernel import F1, F2, kernel
from skytether.shared.law.model import Array
from skytether.shared.scenario.reading import check

MS = 1_000_000
TURNED = np.array([1.0, -1.0, -1.0])
"""Signs between our body axes and rotorpy's, which are forward, left and up."""
COMMANDS = {
    "hover": (1788.0, 1788.0, 1788.0, 1788.0),
    "climb": (2100.0, 2100.0, 2100.0, 2100.0),
    "tumble": (1900.0, 1700.0, 1850.0, 1750.0),
    "stop": (0.0, 0.0, 0.0, 0.0),
}
ROTORPY = {
    "hover": [
        *(0.309909092, 0.195431361, -0.145454167),
        *(0.776141149, 0.358032778, -0.337762643),
        *(0.068845761, 0.037879140, -0.107024264, 0.991146427),
        *(0.250863967, 0.112701001, -0.363840604),
    ],
    "climb": [
        *(0.322443786, 0.186074536, 0.171127316),
        *(0.845610307, 0.296918559, 1.051416752),
        *(0.067557147, 0.037625517, -0.104943835, 0.991467167),
        *(0.239574049, 0.111271745, -0.346847857),
    ],
    "tumble": [
        *(-0.026503575, 0.422564975, -0.535219122),
        *(-0.180142301, 1.295356692, -3.585425808),
        *(-0.319314457, -0.538624584, -0.021047476, -0.779409288),
        *(-9.835147530, -19.878773689, -0.291087150),
    ],
    "stop": [
        *(0.274995611, 0.230780649, -1.121405312),
        *(0.604920882, 0.648062446, -4.331636840),
        *(0.076987631, 0.039264725, -0.120262811, 0.988973226),
        *(0.326574326, 0.119194039, -0.478576700),
    ],
}
"""Position [m], velocity [m/s], quaternion (x, y, z, w) and rates [rad/s] from rotorpy 3.0."""
WIND = np.array([1.0, -2.0, 0.5])
UNEVEN = CRAZYFLIE._replace(body_drag=0.005, arm_y_m=0.04)
"""Frame with all kinds of drag, and arms of two lengths."""


def flown(frame: Frame, command: tuple[float, ...]) -> Array:
    """States after half a second with constant commands, from a general initial motion."""
    x = np.zeros(STATES)
    x[3:6], x[6], x[10:13], x[13:] = (0.5, -0.3, 0.2), 1.0, (0.3, -0.2, 0.5), 1700.0
    drive(frame, x, np.array(command), WIND, 250)
    return x


def as_rotorpy(x: Array) -> Array:
    """Position, velocity, quaternion (x, y, z, w) and rates of states, in rotorpy's axes."""
    w, i, j, k = x[6:10]
    return np.concatenate([TURNED * x[:3], TURNED * x[3:6], [i, -j, -k, w], TURNED * x[10:13]])


def rotorpy(frame: Frame, command: tuple[float, ...]) -> Array:
    """States of rotorpy's vehicle with the same body, by its own integrator to 1e-10."""
    multirotor = pytest.importorskip("rotorpy.vehicles.multirotor")
    place = {
        f"r{k + 1}": np.array([x * frame.arm_x_m, -y * frame.arm_y_m, 0.0])
        for k, (x, y) in enumerate([(1, 1), (-1, -1), (1, -1), (-1, 1)])
    }
    vehicle = multirotor.Multirotor(
        {
            "mass": frame.mass_kg,
            "Ixx": frame.roll_inertia,
            "Iyy": frame.pitch_inertia,
            "Izz": frame.yaw_inertia,
            "Ixy": 0.0,
            "Ixz": 0.0,
            "Iyz": 0.0,
            "num_rotors": 4,
            "rotor_pos": place,
            # Clockwise from above is about the downward axis, opposite to rotorpy's upward axis.
            "rotor_directions": np.array([-1, -1, 1, 1]),
            "c_Dx": frame.body_drag,
            "c_Dy": frame.body_drag,
            "c_Dz": frame.body_drag,
            "k_eta": frame.thrust,
            "k_m": frame.torque,
            "k_d": frame.rotor_drag,
            "k_z": frame.inflow_drag,
            "tau_m": frame.rotor_lag_s,
            "rotor_speed_min": 0.0,
            "rotor_speed_max": frame.rotor_max,
        },
        integrator_kwargs={"method": "RK45", "rtol": 1e-10, "atol": 1e-12},
    )
    state = {
        "x": np.zeros(3),
        "v": TURNED * np.array([0.5, -0.3, 0.2]),
        "q": np.array([0.0, 0.0, 0.0, 1.0]),
        "w": TURNED * np.array([0.3, -0.2, 0.5]),
        "wind": TURNED * WIND,
        "rotor_speeds": np.full(4, 1700.0),
    }
    state = vehicle.step(state, {"cmd_motor_speeds": np.array(command)}, 0.5)
    return np.concatenate([state["x"], state["v"], state["q"], state["w"]])


@pytest.mark.parametrize("name", COMMANDS)
def test_the_body_moves_as_rotorpy_s(name: str) -> None:
    """Half a second with the same rotor speeds, in wind: within 1e-7 of all states."""
    ours = as_rotorpy(flown(UNEVEN, COMMANDS[name]))
    np.testing.assert_allclose(ours, ROTORPY[name], rtol=0, atol=1e-7)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("name", COMMANDS)
def test_the_body_moves_as_rotorpy_s_where_that_is_installed(name: str, frame: str) -> None:
    """With any frame; `pip install --no-deps rotorpy` installs it."""
    command = tuple(np.minimum(COMMANDS[name], FRAMES[frame].rotor_max))
    theirs, ours = rotorpy(FRAMES[frame], command), as_rotorpy(flown(FRAMES[frame], command))
    np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6)


def test_what_rotorpy_gave_is_what_it_gives() -> None:
    for name, command in COMMANDS.items():
        np.testing.assert_allclose(rotorpy(UNEVEN, command), ROTORPY[name], rtol=0, atol=1e-8)


def quadrotor(
    frame: Frame = KG15, gains: Gains = ARDUPILOT, seed: int = 0, **more: Any
) -> Quadrotor:
    rng = np.random.default_rng(seed)
    return Quadrotor(frame, gains, rng, position=np.array([0.0, 0.0, 5.0]), **more)


def response(flown_: Quadrotor, velocity: tuple[float, ...], seconds: float = 4.0) -> Array:
    """Positions and velocities every 10 ms, after a second of hover; shape (n, 6)."""
    flown_.advance(np.zeros(3), 1000 * MS)
    rows = []
    for _ in range(round(100 * seconds)):
        flown_.advance(np.array(velocity), 10 * MS)
        rows.append(np.concatenate([flown_.position(), flown_.velocity()]))
    return np.array(rows)


FLOWN = [(KG15, ARDUPILOT), (FRAMES["sih"], PX4), (CRAZYFLIE, FIRMWARE)]


@pytest.mark.parametrize(("frame", "gains"), FLOWN)
def test_it_hovers(frame: Frame, gains: Gains) -> None:
    flown_ = quadrotor(frame, gains)
    rows = response(flown_, (0.0, 0.0, 0.0), 10.0)
    assert np.abs(rows - [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]).max() < 1e-3
    pushed = frame.thrust * (flown_._quad.x[13:] ** 2).sum()
    assert pushed == pytest.approx(frame.mass_kg * GRAVITY, rel=1e-6)


@pytest.mark.parametrize(
    ("frame", "gains", "half_s", "most"),
    [
        (KG15, ARDUPILOT, 0.60, 1.04),
        (FRAMES["sih"], PX4, 0.60, 0.90),
        (CRAZYFLIE, FIRMWARE, 0.31, 1.12),
    ],
)
@pytest.mark.parametrize("axis", [0, 1])
def test_a_step_of_1_mps_is_as_documented(
    frame: Frame, gains: Gains, half_s: float, most: float, axis: int
) -> None:
    """Time to half the step, and overshoot, as in docs/vehicles.md, in both directions."""
    velocity = np.eye(3)[axis]
    rows = response(quadrotor(frame, gains), tuple(velocity))
    values = rows[:, 3 + axis]
    assert (np.argmax(values >= 0.5) + 1) * 0.01 == pytest.approx(half_s, abs=0.02)
    assert most - 0.1 < values.max() < most
    assert np.abs(rows[:, 3 + 1 - axis]).max() < 1e-6
    assert np.abs(rows[:, 2] - 5.0).max() < 0.05


@pytest.mark.parametrize(("frame", "gains"), FLOWN)
def test_a_hard_turn_costs_little_height_and_yaw_comes_back(frame: Frame, gains: Gains) -> None:
    flown_ = quadrotor(frame, gains)
    flown_._quad.x[6:10] = np.cos(0.5), 0.0, 0.0, np.sin(0.5)  # nose 57° to the east
    lowest = 5.0
    for k in range(8):
        rows = response(flown_, (3.0 * (-1) ** k, 2.0 * (-1) ** (k // 2), 0.0), 1.0)
        lowest = min(lowest, rows[:, 2].min())
    assert lowest > 4.0
    assert abs(flown_.attitude().yaw) < 0.1


def test_the_wind_moves_it_and_the_loops_bring_it_to_rest() -> None:
    """In 5 m/s from the south the vehicle tilts against the wind and comes to rest."""
    flown_ = quadrotor()
    flown_.blow((5.0,), 0.0)
    rows = response(flown_, (0.0, 0.0, 0.0), 12.0)
    assert rows[:, 0].max() > 0.1
    np.testing.assert_allclose(rows[-1, 3:], 0.0, rtol=0, atol=5e-3)
    assert flown_.attitude().pitch > 0.05
    # Rotor drag in hover balances the tangent of the tilt; drag grows with the rotors' speed.
    drag = 4 * KG15.rotor_drag * KG15.hover * 5.0 / (KG15.mass_kg * GRAVITY)
    assert np.tan(flown_.attitude().pitch) == pytest.approx(drag, rel=0.05)


@pytest.mark.parametrize(("integral_max", "drifts_mps"), [(PX4.integral_max, 0.0), (5.0, 0.52)])
def test_px4_stands_in_a_wind_that_drags_with_6_newtons(
    integral_max: float, drifts_mps: float
) -> None:
    """Its tilt suffices; an integral bounded at 5 m/s², unlike PX4's, lets it drift."""
    flown_ = quadrotor(FRAMES["sih"], PX4._replace(integral_max=integral_max))
    flown_.blow((6.0,), 0.0)
    rows = response(flown_, (0.0, 0.0, 0.0), 40.0)
    assert rows[-1, 3] == pytest.approx(drifts_mps, abs=0.02)
    assert flown_.attitude().pitch < 0.8 * PX4.tilt_max


@pytest.mark.long
@pytest.mark.parametrize(
    ("frame", "gains", "least_mps", "most_mps"),
    [(KG15, ARDUPILOT, 0.06, 0.11), (FRAMES["sih"], PX4, 0.30, 0.42)],
)
def test_turbulence_moves_it_as_documented(
    frame: Frame, gains: Gains, least_mps: float, most_mps: float
) -> None:
    flown_ = quadrotor(frame, gains)
    flown_.blow((6.0,), 6.0)
    rows = response(flown_, (0.0, 0.0, 0.0), 600.0)[6000:]
    moved = rows[:, 3:5].std(axis=0)
    assert np.all((least_mps < moved) & (moved < most_mps))


def test_no_integral_grows_without_end() -> None:
    flown_ = quadrotor(FRAMES["sih"], PX4)
    flown_.blow((60.0,), 0.0)
    response(flown_, (0.0, 0.0, 0.0), 60.0)
    assert np.abs(flown_._quad.integral).max() == PX4.integral_max


@settings(max_examples=30)
@given(st.lists(st.integers(0, 30 * MS), min_size=1, max_size=12))
def test_time_may_pass_in_any_pieces(pieces: list[int]) -> None:
    whole, parts = quadrotor(), quadrotor()
    for each in (whole, parts):
        each.blow((3.0, 1.0), 6.0)
    velocity = np.array([1.0, -0.5, 0.2])
    for piece in pieces:
        parts.advance(velocity, piece)
    whole.advance(velocity, sum(pieces))
    np.testing.assert_array_equal(whole._quad.x, parts._quad.x)


@kernel
def blown(air: Air, drawn: F2, height: float, out: F2) -> None:
    """Velocities of the air step by step, one row each."""
    for k in range(len(drawn)):
        blow(air, drawn[k], height, out[k])


def test_turbulence_is_dryden_s() -> None:
    """Strengths and lengths of MIL-F-8785C, in a wind to the north-east, over 2000 s."""
    height_m, speed, slope, steady = 50.0, 60.0, np.sqrt(0.5), 4.0
    air = Air(np.array([slope, slope, 0.0]) * steady, np.array([speed]), np.zeros(5))
    drawn, out = np.random.default_rng(3).standard_normal((1_000_000, 3)), np.zeros((1_000_000, 3))
    blown(air, drawn, height_m, out)
    feet = height_m / 0.3048
    c = 0.177 + 0.000823 * feet
    along = slope * (out[:, 0] + out[:, 1]) - steady
    across, up = slope * (out[:, 1] - out[:, 0]), out[:, 2]
    for values, strength, length_m, rest in (
        (along, 0.1 * speed / c**0.4, height_m / c**1.2, np.exp(-1.0)),
        (across, 0.1 * speed / c**0.4, height_m / c**1.2, 0.5 * np.exp(-1.0)),
        (up, 0.1 * speed, height_m, 0.5 * np.exp(-1.0)),
    ):
        assert values.std() == pytest.approx(strength, rel=0.06)
        lag = round(length_m / speed / STEP_S)
        correlation = np.mean(values[lag:] * values[:-lag]) / values.var()
        assert correlation == pytest.approx(rest, abs=0.06)


@kernel
def mixed(frame: Frame, thrust: float, torque: F1, rotor_max: float, command: F1) -> None:
    mix(frame, thrust, torque, rotor_max, command)


@settings(max_examples=50)
@given(st.floats(0.0, 60.0), st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.floats(100.0, 1100.0))
def test_no_rotor_is_asked_for_more_than_it_has(
    thrust: float, torque: tuple[float, ...], rotor_max: float
) -> None:
    """Within the rotors' limits the result is exact, except for a limited yaw torque."""
    command = np.zeros(4)
    mixed(KG15, thrust, np.array(torque), rotor_max, command)
    assert (command >= 0.0).all()
    assert (command <= rotor_max * (1.0 + 1e-12)).all()
    force = KG15.thrust * command**2
    if (command > 0.0).all() and (command < 0.999 * rotor_max).all() and force.sum() >= thrust:
        assert force.sum() == pytest.approx(thrust, abs=1e-9)
        roll = KG15.arm_y_m * (-force[0] + force[1] + force[2] - force[3])
        pitch = KG15.arm_x_m * (force[0] - force[1] + force[2] - force[3])
        assert (roll, pitch) == pytest.approx(torque[:2], abs=1e-9)


def test_the_battery_sags_and_ends() -> None:
    """A Crazyflie hovers for 7 minutes; in full climb a 1.5 kg frame has less voltage."""
    flown_ = quadrotor(CRAZYFLIE, FIRMWARE)
    charges = []
    while flown_.position()[2] > 4.5:
        flown_.advance(np.zeros(3), 5000 * MS)
        charges.append(flown_.battery().charge)
    assert 5 * len(charges) == pytest.approx(7 * 60, abs=20)
    assert (np.diff(charges) <= 0.0).all()
    climbing = quadrotor()
    rested = climbing.battery().voltage
    climbing.advance(np.zeros(3), 1000 * MS)
    hovering = climbing.battery().voltage
    climbing.advance(np.array([0.0, 0.0, 8.0]), 400 * MS)
    assert climbing.battery().voltage < hovering <= rested


def test_an_empty_battery_cannot_keep_it_up() -> None:
    """The rotors' largest speed falls with the voltage."""
    flown_ = quadrotor(charge=0.01)
    flown_.discharge(0.0)
    flown_.advance(np.zeros(3), 20_000 * MS)
    assert flown_.position()[2] < 4.0


def test_an_endless_battery_stays_full() -> None:
    flown_ = quadrotor(charge="endless")
    flown_.advance(np.zeros(3), 20_000 * MS)
    assert flown_.battery().charge == 1.0
    assert flown_.battery().voltage < 4.2 * KG15.cells


def test_it_stands_on_the_ground_and_leaves_it() -> None:
    flown_ = Quadrotor(
        KG15, ARDUPILOT, np.random.default_rng(0), position=np.zeros(3), ground_m=0.0, hovers=False
    )
    flown_.blow((8.0, 0.0, 0.0), 6.0)
    flown_.advance(np.zeros(3), 3000 * MS)
    assert flown_.stands()
    np.testing.assert_array_equal(flown_.position(), 0.0)
    flown_.on = True
    flown_.advance(np.array([0.0, 0.0, 1.0]), 3000 * MS)
    assert flown_.position()[2] > 1.0
    assert not flown_.stands()


def test_a_plant_in_the_plane_keeps_its_altitude() -> None:
    command = np.array([1.0, -0.5, 0.5])
    for axes in (2, 3):
        scenario = check(
            {
                "model": {"axes": axes},
                "vehicle": {"kind": "quadrotor", "start_m": [1.0, 2.0, 3.0][:axes]},
            },
            "test",
        )
        plant = QuadrotorPlant(scenario, np.random.default_rng(0), 1)
        assert plant.state().tolist() == [[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]][:axes]
        for _ in range(100):
            plant.advance(command[:axes])
        np.testing.assert_allclose(plant.state()[:, 1], command[:axes], rtol=0, atol=0.05)
        if axes == 2:
            assert plant._quadrotor.position()[2] == pytest.approx(ALTITUDE_M, abs=0.02)


def test_a_quadrotor_flies_a_scenario() -> None:
    keys = {"vehicle.kind": "quadrotor", "vehicle.turbulence_mps": 6.0, "duration": 20.0}
    calm = skytether.fly("demo", **keys)
    windy = skytether.fly("demo", **keys, **{"vehicle.steady_wind_mps": [4.0, 0.0]})
    assert calm.summary.rmse_xy < 0.1
    assert windy.summary.rmse_xy < 0.2
    assert windy.summary.rmse_xy != calm.summary.rmse_xy
