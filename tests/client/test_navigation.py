"""Navigation aboard: sensor, Kalman filter, and flights with both."""

from collections.abc import Iterable
from copy import deepcopy
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.stats import chi2

from by_hand import ByHand
from helpers import packaged
from skytether.client import filter as aboard
from skytether.client.filter import Kalman
from skytether.client.navigation import CARRIED_NS, Leaps, Navigation, sensing
from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.sensor import Sensor
from skytether.client.simulated.vehicle import simulated
from skytether.client.simulated.weather import Weather
from skytether.client.vehicle import Measurement, Vehicle
from skytether.server.schemes import committed
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.law.model import Array, white_acceleration
from skytether.shared.scenario.registry import VEHICLES, Entry
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Rows
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire.protocol import Message
from skytether.sim.batch import fly_batch
from skytether.sim.flight import fly

DT_NS = 50 * MILLISECOND_NS
NOISE = {"position_noise_m": 0.02, "velocity_noise_mps": 0.05}
POSITIONS = {"position_noise_m": 0.02, "position_every_s": 0.2, "velocity_every_s": "never"}


def scenario(name: str = "demo-committed", **changes: Any) -> Scenario:
    return packaged(name, changes)


def matrices(flown: Scenario) -> tuple[Array, Array, Array]:
    """F, the input's column and Q of the filter's state [p, v, w], computed independently."""
    model, dt = flown.terms().model, flown.control.dt
    q = flown.sensor.process_noise
    F, B, Q = np.eye(3), np.zeros(3), np.zeros((3, 3))
    F[:2, :2], F[:2, 2], B[:2] = model.A[0], model.B[0], model.B[0]
    root = q * white_acceleration(flown.tau_s[:1], dt)[0]
    Q[:2, :2], Q[2, 2] = root @ root.T, (aboard.DRIFT * q) ** 2 * dt
    return F, B, Q


def square(P: aboard.Spread) -> Array:
    return np.array([[P.pp, P.pv, P.pw], [P.pv, P.vv, P.vw], [P.pw, P.vw, P.ww]])


def wander(flown: Scenario, steps: int, seed: int) -> tuple[Array, Array]:
    """Inputs and true states of a vehicle that obeys the filter's model exactly.

    Returns:
        inputs [m/s], shape (steps, axes), and [p, v, w], shape (steps + 1, axes, 3).
    """
    rng, (F, B, Q) = np.random.default_rng(seed), matrices(flown)
    axes, root = flown.model.axes, np.linalg.cholesky(Q)
    inputs = rng.uniform(-1.0, 1.0, (steps, axes))
    states = [np.outer(0.1 * rng.standard_normal(axes), [0.0, 0.0, 1.0])]
    for u in inputs:
        states.append(states[-1] @ F.T + np.outer(u, B) + rng.standard_normal((axes, 3)) @ root.T)
    return inputs, np.array(states)


def follow(flown: Scenario, inputs: Array, states: Array) -> tuple[Array, Array]:
    """Measurements and estimates along a flight; each of the shape (steps + 1, axes, 2)."""
    sensor, known = Sensor(flown, np.random.default_rng(0)), Navigation(flown)
    measured, estimates = [], []
    pairs = zip([np.zeros(states.shape[1]), *inputs], states, strict=True)
    for step, (u, x) in enumerate(pairs):
        told = sensor.measure(x[:, :2].copy())
        had = [told] if told.position or told.velocity else []
        known.advance(had, u, now_ns=step * flown.dt_ns)
        measured.append(known.measured)
        estimates.append(known.estimate)
    return np.array(measured), np.array(estimates)


@pytest.mark.parametrize(("number", "least"), [("position", 1.2625), ("velocity", 5.0)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_ten_sigmas_of_noise_cannot_explain_is_a_leap(
    number: str, least: float, sign: float
) -> None:
    """Within a step of 50 ms: 1 m or 2 m/s, plus 50 m/s² over the step, plus 10 sigmas."""
    for axis in (0, 1):
        for far, leaps in ((least - 1e-9, False), (least + 1e-9, True)):
            known = Navigation(scenario(sensor=NOISE))
            x = {"position": [3.0, 3.0], "velocity": [0.0, 0.0]}
            leapt = []
            for step in range(3):
                measured = Measurement(step * DT_NS, **deepcopy(x))
                known.advance([measured], np.zeros(2), now_ns=step * DT_NS)
                leapt.append(known.leapt)
                before = x["velocity"][axis]
                x[number][axis] += sign * far if step == 0 else 0.0
                # The position moves with the mean velocity of the step.
                x["position"][axis] += 0.025 * (before + x["velocity"][axis])
            assert leapt == [False, leaps, False]


# -- the sensor --------------------------------------------------------------------------------


def test_a_sensor_without_imperfection_needs_no_filter() -> None:
    exact = {"position_every_s": 0.05, "velocity_every_s": 0.01, "position_bias_m": [0.0, 0.0]}
    for sensor in ({}, exact, {"filter": "none"}):
        assert sensing(scenario(sensor=sensor)).exact
    flight = fly(scenario(duration=10.0, settle=1.0))
    for column in ("measured", "estimate"):
        np.testing.assert_array_equal(flight.client[column], flight.client["state"])
    assert summarise(scenario(), "demo", flight.client).estimate_error_m is None


def test_a_position_without_a_velocity_leaps_too() -> None:
    leaps = Leaps(scenario())
    first = Measurement(0, [0.0, 0.0], [0.0, 0.0])
    assert not leaps.leaps(first, first.numbers())
    later = Measurement(DT_NS, [0.0, 9.0], None)
    assert leaps.leaps(later, later.numbers())


def test_a_delay_counts_whole_steps_rounded_up() -> None:
    step_s = DT_NS / SECOND_NS
    delays = [sensing(scenario(sensor={"delay_s": n * step_s})).delay for n in (0.0, 0.1, 1.0, 1.1)]
    assert delays == [0, 1, 1, 2]


def test_noise_and_bias_are_those_that_were_asked_for() -> None:
    bias = {"position_bias_m": [0.3, -0.1], "velocity_bias_mps": [0.0, 0.2]}
    sensor = Sensor(scenario(sensor=NOISE | bias), np.random.default_rng(1))
    measured = np.array([sensor.measure(np.ones((2, 2)))[1:] for _ in range(20_000)])
    np.testing.assert_allclose(measured.mean(axis=0), [[1.3, 0.9], [1.0, 1.2]], atol=0.002)
    np.testing.assert_allclose(measured.std(axis=0), [[0.02] * 2, [0.05] * 2], rtol=0.02)


@pytest.mark.parametrize(
    ("sensor", "positions", "velocities"),
    [
        ({"position_every_s": 0.2, "velocity_every_s": "never"}, [0, 4, 8, 12], []),
        ({"position_every_s": 0.12, "velocity_every_s": 0.25}, [0, 3, 5, 8, 10, 12], [0, 5, 10]),
        ({"delay_s": 0.08}, list(range(13)), list(range(13))),
    ],
    ids=["5 Hz", "between steps", "late"],
)
def test_measurements_come_when_they_are_due(
    sensor: dict[str, Any], positions: list[int], velocities: list[int]
) -> None:
    """At the first step after the due time; a delayed sensor reports the start until then."""
    told = Sensor(scenario(sensor=sensor), np.random.default_rng(0))
    known = [told.measure(np.full((2, 2), float(step))) for step in range(13)]
    assert [step for step, each in enumerate(known) if each.position] == positions
    assert [step for step, each in enumerate(known) if each.velocity] == velocities
    for step in positions:
        assert known[step].position == [float(max(step - told.delay, 0))] * 2
        assert known[step].stamp_ns == max(step - told.delay, 0) * DT_NS


def test_a_vehicle_tells_what_it_has_measured_when_it_is_asked() -> None:
    """Measurements are stamped by the client's clock; those of missed steps come once each."""
    flown = scenario(sensor=POSITIONS | {"delay_s": 0.1})
    flies, began_ns = simulated(flown, 1), 10**12
    first = flies.measurements(now_ns=began_ns)
    assert [(each.stamp_ns, each.velocity) for each in first] == [(began_ns, None)]
    assert not flies.measurements(now_ns=began_ns)
    later = flies.measurements(now_ns=began_ns + 20 * DT_NS)
    assert [each.stamp_ns for each in later] == [
        began_ns + (step - 2) * DT_NS for step in (4, 8, 12, 16, 20)
    ]


class Plane(Vehicle):
    """Vehicle of a user: it measures now and then, and has no known true state."""

    def __init__(self, every: int) -> None:
        self.every = every
        self.asked = 0
        self.flown: list[list[float]] = []

    def fly(self, velocity: Array) -> None:
        self.flown.append(velocity.tolist())

    def measurements(self, *, now_ns: int) -> list[Measurement]:
        self.asked += 1
        return (
            [Measurement(now_ns, [0.5, 0.25], [0.0, 0.0])] if self.asked % self.every == 1 else []
        )


def test_a_vehicle_of_one_s_own_is_flown_by_what_it_tells() -> None:
    flies = Plane(3)
    server = ByHand(scenario(), flies)
    server.wake()
    server.welcome()
    for _ in range(6):
        server.wake()
    rows = server.rows()
    np.testing.assert_array_equal(rows["state"], rows["estimate"])
    assert np.isnan(rows["measured"]).all(axis=(1, 2)).tolist() == [False, True, True] * 2
    assert (rows["estimate"] == [[0.5, 0.0], [0.25, 0.0]]).all()
    assert flies.flown == [[0.0, 0.0]] * 6
    assert server.client.changeable == {"armed", "link.leader", "vehicle.after_leap"}


# -- the filter --------------------------------------------------------------------------------


def test_the_gains_settle_where_the_riccati_equation_says() -> None:
    flown = scenario(sensor=NOISE)
    kalman, (F, _, Q) = Kalman(flown, 0), matrices(flown)
    H, R = np.eye(2, 3), np.diag([0.02, 0.05]) ** 2
    nothing = Measurement(0, [0.0, 0.0], [0.0, 0.0])
    kalman.begin(nothing, nothing.numbers())
    for _ in range(2000):
        kalman.advance(np.zeros(2))
        kalman.take(nothing, nothing.numbers())
    before = solve_discrete_are(F.T, H.T, Q, R)
    gain = before @ H.T @ np.linalg.inv(H @ before @ H.T + R)
    after = (np.eye(3) - gain @ H) @ before
    np.testing.assert_allclose(square(aboard.Spread(*kalman.P[0])), after, rtol=1e-8)


@pytest.mark.parametrize("sensor", [NOISE, POSITIONS, NOISE | {"delay_s": 0.2}])
@pytest.mark.parametrize("tau_s", [[0.84], [0.84, 0.3]])
def test_it_is_the_kalman_filter_of_its_equations(
    sensor: dict[str, Any], tau_s: list[float]
) -> None:
    flown = scenario(sensor=sensor, model={"tau_s": tau_s})
    inputs, states = wander(flown, 60, seed=1)
    measured, estimates = follow(flown, inputs, states)
    delay = Sensor(flown, np.random.default_rng(0)).delay
    inputs = np.concatenate([np.zeros((delay, 2)), inputs])
    for axis in range(2):
        one = scenario(sensor=sensor, model={"tau_s": [tau_s[axis % len(tau_s)]]})
        F, B, Q = matrices(one)
        first = measured[0, axis]
        spread = [0.02, 1.0 if np.isnan(first[1]) else 0.05, aboard.BEGIN_MPS[1]]
        x, P = np.array([*np.nan_to_num(first), 0.0]), np.diag(spread) ** 2
        for step in range(61):
            if step:
                x, P = F @ x + B * inputs[step - 1, axis], F @ P @ F.T + Q
                z = measured[step, axis]
                H = np.eye(2, 3)[~np.isnan(z)]
                R = np.diag([0.02, 0.05])[~np.isnan(z)][:, ~np.isnan(z)] ** 2
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
                x, P = x + K @ (z[~np.isnan(z)] - H @ x), (np.eye(3) - K @ H) @ P
            now = x
            for u in inputs[step : step + delay, axis]:
                now = F @ now + B * u
            np.testing.assert_allclose(estimates[step, axis], now[:2], rtol=0, atol=1e-10)


def test_it_is_as_wrong_as_it_says() -> None:
    """Consistency: the error weighted with P⁻¹ is χ² with three degrees of freedom on average."""
    for sensor in (NOISE, POSITIONS):
        flown, errors = scenario(sensor=sensor), []
        for seed in range(60):
            inputs, states = wander(flown, 80, seed)
            kalman, known = Kalman(flown, 0), Sensor(flown, np.random.default_rng([seed, 1]))
            first = known.measure(states[0, :, :2].copy())
            kalman.begin(first, first.numbers())
            for u, x in zip(inputs, states[1:], strict=True):
                kalman.advance(u)
                measured = known.measure(x[:, :2].copy())
                kalman.take(measured, measured.numbers())
            spread = square(aboard.Spread(*kalman.P[0]))
            errors += [e @ np.linalg.solve(spread, e) for e in kalman.x - states[-1]]
        n = len(errors)
        assert chi2.ppf(0.001, 3 * n) < sum(errors) < chi2.ppf(0.999, 3 * n)


def test_late_measurements_are_rolled_on_by_what_was_flown_since() -> None:
    """Exact to a millimetre in still air; without the delay in the filter, decimetres off."""
    late = {"delay_s": 0.3, "velocity_every_s": 0.2}
    flown = scenario(vehicle={"wind": 0.0})
    plant = FirstOrderPlant(flown, Weather(flown, np.random.default_rng(0)))
    inputs = np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, (20, 2)), 10, axis=0)
    states = [plant.state()]
    for u in inputs:
        plant.advance(u)
        states.append(plant.state())
    off = {}
    for name in ("kalman", "none"):
        known_by = scenario(sensor=late | {"filter": name}, vehicle={"wind": 0.0})
        off[name] = np.abs(follow(known_by, inputs, np.array(states))[1] - states).max(axis=(0, 1))
    assert off["kalman"].max() < 0.001
    assert off["none"].min() > 0.1


def test_wind_that_stays_and_a_wrong_gain_leave_no_offset(monkeypatch: Any) -> None:
    """By positions alone, at 5 Hz; without w in the filter an offset remains."""
    vehicle = {"wind": 0.02, "steady_wind_mps": [0.3, -0.2], "gain": 0.8}
    flown = scenario(sensor=POSITIONS, vehicle=vehicle)
    plant = FirstOrderPlant(flown, Weather(flown, np.random.default_rng(0)))
    states = [plant.state()]
    inputs = np.full((1600, 2), 0.5)
    for u in inputs:
        plant.advance(u)
        states.append(plant.state())

    def offset() -> Array:
        estimates = follow(flown, inputs, np.array(states))[1]
        found: Array = np.abs((estimates - states)[400:].mean(axis=0)).max(axis=0)
        return found

    assert (offset() < [0.005, 0.02]).all()
    monkeypatch.setattr(aboard, "BEGIN_MPS", (1.0, 0.0))
    monkeypatch.setattr(aboard, "DRIFT", 0.0)
    assert (offset() > [0.01, 0.05]).all()


# -- flights -----------------------------------------------------------------------------------


ALONE = {
    "feedback": False,
    "horizon": 40,
    "input_weight": 0.01,
    "input_reference": False,
    "trigger": "cost_gap(2) | silence(1)",
}
"""Committed inputs without feedback, at tight weights: noise acts only through the server."""


@pytest.mark.long
def test_the_filter_keeps_noise_from_being_sent_and_flown() -> None:
    """Without the filter the cost gap sends three times as many packets."""
    quiet, with_filter, without = (
        fly(scenario(sensor=sensor, control=ALONE, duration=30.0, seed=3))
        for sensor in ({}, NOISE, NOISE | {"filter": "none"})
    )
    shares = [float(flight.server["event"].mean()) for flight in (quiet, with_filter, without)]
    assert shares[1] < 0.1 + 0.02
    assert shares[1] < 1.5 * shares[0]
    assert shares[2] > 3.0 * shares[1]
    noise = without.client["measured"] - without.client["state"]
    np.testing.assert_allclose(noise.std(axis=(0, 1)), [0.02, 0.05], rtol=0.1)
    np.testing.assert_array_equal(without.client["measured"], without.client["estimate"])
    flown = scenario(sensor=NOISE, control=ALONE, duration=30.0, seed=3)
    error = summarise(flown, "demo", with_filter.client).estimate_error_m
    assert 0.007 < error < 0.011


@pytest.mark.long
def test_the_server_does_not_learn_noise_for_wind(monkeypatch: Any) -> None:
    """An observer that follows each velocity at once sends a twelfth more."""
    flown = scenario(sensor=NOISE, control=ALONE, duration=30.0)

    def share() -> float:
        flights = fly_batch(flown, range(1, 7))
        return float(np.mean([flight.server["event"].mean() for flight in flights]))

    with_it = share()
    monkeypatch.setattr(committed, "FOLLOW_S", 1e-6)
    assert share() > 1.05 * with_it


def test_a_vehicle_with_positions_alone_is_flown_through_steady_wind() -> None:
    """At 5 Hz and 0.1 s late: the server estimates the wind from the filter's states."""
    flown = scenario(
        sensor=POSITIONS | {"delay_s": 0.1},
        vehicle={"steady_wind_mps": [0.3, 0.0]},
        control={"feedback": False},
        duration=40.0,
        settle=10.0,
    )
    flight = fly(flown)
    rmse = summarise(flown, "demo", flight.client, flight.server).rmse_xy
    assert rmse < 0.12
    measured = flight.client["measured"]
    assert np.isnan(measured[:, :, 1]).all()
    assert np.isfinite(measured[:, :, 0]).all(axis=1).sum() == flown.steps // 4


def test_noisy_observations_are_all_plausible() -> None:
    loud = {"position_noise_m": 0.1, "velocity_noise_mps": 0.25}
    for name in ("kalman", "none"):
        flight = fly(scenario(sensor=loud | {"filter": name}, duration=10.0, settle=1.0))
        assert not flight.figures["server"]["dropped"]


def test_the_same_seed_has_the_same_noise_and_vehicles_have_their_own() -> None:
    one, again = (fly(scenario(sensor=NOISE, duration=6.0, settle=1.0)) for _ in range(2))
    assert one.trace_hash() == again.trace_hash()
    two = fly(scenario(sensor=NOISE, duration=6.0, settle=1.0), vehicles=2).client
    noise = [
        (rows["measured"] - rows["state"])[:100]
        for rows in (two[two["vehicle"] == 1], two[two["vehicle"] == 2])
    ]
    np.testing.assert_allclose(noise[0], (one.client["measured"] - one.client["state"])[:100])
    assert np.abs(noise[0] - noise[1]).mean() > 0.01


def steps_of(flown: Scenario, awake: Iterable[int]) -> tuple[Rows, list[Message]]:
    """Record of a vehicle awake at some steps with an input of 0.5 m/s, and its messages."""
    server, said = ByHand(flown), []
    server.wake()
    server.welcome()
    began_ns = server.now_ns
    for step in (0, 1, *awake):
        if step == 2:
            server.horizon(1, 0.5, observed=0)
        server.now_ns = began_ns + step * flown.dt_ns
        said += server.wake()
    return server.rows(), said


def test_the_filter_goes_on_through_a_sleep() -> None:
    vehicle = {"wind": 0.0, "exhausted": "hold", "report": "always"}
    flown = scenario(sensor=POSITIONS, vehicle=vehicle)
    awake, _ = steps_of(flown, range(2, 16))
    asleep, told = steps_of(flown, (2, 14, 15))
    assert asleep["step"].tolist() == [0, 1, 2, 14, 15]
    np.testing.assert_array_equal(asleep["estimate"], awake["estimate"][asleep["step"]])
    np.testing.assert_array_equal(
        [each.state for each in told], asleep["estimate"].astype(np.float32)
    )
    assert asleep["state"][-1, 0, 1] > 0.2
    assert np.abs(asleep["estimate"] - asleep["state"]).max() < 0.15


# -- time stamps of the vehicle --------------------------------------------------------------------


def test_a_measurement_between_two_steps_is_carried_to_the_step() -> None:
    """By eq. (1), exactly; a measurement at the step itself is used unchanged, and one older than
    CARRIED_NS is predicted over that time only.
    """
    flown, u = scenario(), np.array([1.0, -0.5])
    tau, position, velocity = flown.tau_s, [1.0, 2.0], [0.3, 0.4]
    known = Navigation(flown)
    known.advance([Measurement(0, [0.0, 0.0], [0.0, 0.0])], u, now_ns=0)
    for age_ns in (0, 1, 17_000_000, DT_NS - 1, CARRIED_NS, 3 * CARRIED_NS):
        measured = Measurement(DT_NS - age_ns, position, velocity)
        carried = known._carried(measured, DT_NS, u.tolist())
        assert (carried is measured) == (age_ns == 0)
        age, v = min(age_ns, CARRIED_NS) / SECOND_NS, np.array(velocity)
        left = np.exp(-age / tau)
        np.testing.assert_allclose(carried.velocity, u + (v - u) * left, rtol=1e-12)
        moved = u * age + (v - u) * tau * (1.0 - left)
        np.testing.assert_allclose(carried.position, position + moved, rtol=1e-12)


class Restless(Vehicle):
    """Simulated vehicle, measured every 30 ms regardless of the steps."""

    def __init__(self, flown: Scenario, number: int) -> None:
        fine = msgspec.structs.replace(flown.control, dt=0.005)
        self._flies = simulated(msgspec.structs.replace(flown, control=fine), number)
        self._next_ns = 0

    def fly(self, velocity: Array) -> None:
        self._flies.fly(velocity)

    def measurements(self, *, now_ns: int) -> list[Measurement]:
        told = []
        for each in self._flies.measurements(now_ns=now_ns):
            if each.stamp_ns >= self._next_ns:
                self._next_ns = each.stamp_ns + 30 * MILLISECOND_NS
                told.append(each)
        return told

    def truth(self) -> Array:
        return self._flies.truth()


def test_a_vehicle_that_measures_when_it_likes_flies_as_one_that_keeps_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """If stamps are ignored, old measurements count as present ones."""
    monkeypatch.setitem(VEHICLES, "restless", Entry(Restless, (), ""))
    flown = scenario(duration=10.0, settle=5.0, vehicle={"wind": 0.0, "steady_wind_mps": []})
    flown = msgspec.structs.replace(
        flown, vehicle=msgspec.structs.replace(flown.vehicle, kind="restless")
    )
    off_m = []
    for carried in (Navigation._carried, lambda _, measured, *__: measured):
        monkeypatch.setattr(Navigation, "_carried", carried)
        flight = fly(flown).client
        off_m.append(np.abs(flight["estimate"] - flight["state"])[20:, :, 0].max())
    assert off_m[0] < 0.002
    assert off_m[1] > 0.01


def test_a_flight_begins_where_the_vehicle_was_measured_last() -> None:
    """Earlier motion, here a climb of a second, does not count as a disturbance."""
    flown = scenario("autopilot")
    measured = [
        Measurement(n * SECOND_NS // 50, [0.0, 0.0, 4.0 + n / 50], [0.0, 0.0, 2.0 - n / 25])
        for n in range(51)
    ]
    known, still = Navigation(flown), np.zeros(3)
    begin_ns = measured[-1].stamp_ns
    known.advance([Measurement(1, None, [9.0, 9.0, 9.0]), *measured], still, now_ns=begin_ns)
    np.testing.assert_allclose(known.estimate, [(0.0, 0.0), (0.0, 0.0), (5.0, 0.0)])
    later = Measurement(begin_ns + DT_NS, [0.0, 0.0, 5.0], [0.0, 0.0, 0.0])
    known.advance([later], still, now_ns=later.stamp_ns)
    np.testing.assert_allclose(known.predicted, known.estimate, atol=1e-9)


def test_what_is_measured_in_whole_numbers_is_a_number_like_any_other() -> None:
    """A vehicle of the user may report [3, 0]; kernels need floats."""
    whole: list[float] = [3, 0]
    known = Navigation(scenario(sensor=NOISE))
    for step in range(2):
        now_ns = step * DT_NS
        known.advance([Measurement(now_ns, whole, [0, 0])], np.zeros(2), now_ns=now_ns)
    assert known.measured.dtype == np.float64
    np.testing.assert_allclose(known.estimate, [[3.0, 0.0], [0.0, 0.0]], atol=1e-9)


def test_a_vehicle_without_a_position_is_not_known() -> None:
    known = Navigation(scenario())
    known.advance([Measurement(0, None, [1.0, 0.0])], np.zeros(2), now_ns=0)
    assert not known.is_known
    known.advance([Measurement(DT_NS, [1.0, 2.0], [0.0, 0.0])], np.zeros(2), now_ns=DT_NS)
    assert known.is_known
    assert known.estimate.tolist() == [[1.0, 0.0], [2.0, 0.0]]
