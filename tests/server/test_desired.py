"""References at the server: pages, preview, predictions, a live point."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.problems import from_python
from helpers import packaged
from skytether.server.controller import BLOCK
from skytether.server.planning.desired import EMPTY, PAGE, PAGES, Desired, _extrapolated
from skytether.server.planning.moving_setpoint import MEMORY_S, REST_S, LivePoint
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.law.model import Array, Indices
from skytether.shared.scenario import points, targets
from skytether.shared.scenario.reading import check, to_table
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import desired as desired_positions
from skytether.shared.telemetry.summary import summarise
from skytether.sim.flight import fly

H = 15


def scenario(**reference: Any) -> Scenario:
    table = {"shape": "circle", "radius_m": 1.5, "period_s": 7.0} | reference
    return check({"control": {"horizon": H}, "reference": table}, "test")


SCENARIO = scenario()
DT_S = SCENARIO.control.dt


def make(
    flown: Scenario = SCENARIO, references: Callable[[int], Reference] | None = None
) -> Desired:
    return Desired(flown, flown.terms(), BLOCK, BLOCK, references)


def window(desired: Desired, steps: Indices, ahead: Indices, rows: Indices | None = None) -> Array:
    """Desired states at k + d … k + d + H of each vehicle; shape (n, H + 1, axes, 2)."""
    rows = np.arange(len(steps)) if rows is None else rows
    states, place, first = desired.window(rows, steps, ahead)
    windows = [
        states[place[i], :, first[i] : first[i] + H + 1].transpose(1, 0, 2)
        for i in range(len(steps))
    ]
    return np.array(windows)


def truth(start: int, sample: Reference | None = None) -> Array:
    """Desired states from a step on; shape (H + 1, axes, 2)."""
    return (sample or SCENARIO.make_reference())((start + np.arange(H + 1)) * DT_S)


@settings(max_examples=25)
@given(st.lists(st.lists(st.integers(0, 9 * PAGE), min_size=1, max_size=4), min_size=1, max_size=5))
def test_the_reference_looked_up_is_the_reference(calls: list[list[int]]) -> None:
    desired = make()
    for steps in calls:
        found = window(desired, np.array(steps), np.zeros(len(steps), dtype=np.int64))
        np.testing.assert_array_equal(found, [truth(step) for step in steps])


LATE_S = (0.27, 0.1)
"""Dead times of a model [s]; the first is no multiple of the step."""


def late(**reference: Any) -> Scenario:
    table = to_table(scenario(**reference))
    table["model"]["dead_time_s"] = LATE_S
    return check(table, "test")


def test_a_vehicle_with_dead_time_is_planned_along_the_reference_that_much_later() -> None:
    flown, steps, ahead = late(), np.array([3, 900]), np.array([2, 0])
    desired, sample = make(flown), flown.make_reference()
    found = window(desired, steps, ahead)
    times_s = (steps[:, None] + ahead[:, None] + np.arange(H + 1)) * DT_S
    for axis, late_s in enumerate(LATE_S):
        np.testing.assert_array_equal(found[:, :, axis], sample(times_s + late_s)[:, :, axis])
        then = sample(steps * DT_S + late_s)[:, axis]
        np.testing.assert_array_equal(desired.due(np.arange(2), steps)[:, axis], then)
    now = desired.now(np.arange(2), steps)
    np.testing.assert_array_equal(now, sample(steps * DT_S))


@pytest.mark.parametrize("preview_s", [0.0, 0.2, 0.5])
def test_a_dead_time_lets_nobody_see_further_ahead(preview_s: float) -> None:
    """Beyond the preview the server predicts, also within the dead time."""
    flown = late(preview=preview_s)
    desired, sample, step = make(flown), flown.make_reference(), 40
    (found,) = window(desired, np.array([step]), np.array([2]))
    for axis, late_s in enumerate(LATE_S):
        seen_s = min(late_s, preview_s)
        whole = int((preview_s - seen_s) / DT_S + 1e-9)
        for stage, state in enumerate(found[:, axis]):
            steps = min(2 + stage, whole)
            p, v = sample(np.array(step * DT_S + steps * DT_S + seen_s))[axis]
            after_s = (2 + stage - steps) * DT_S + late_s - seen_s
            np.testing.assert_allclose(state, [p + after_s * v, v], rtol=0.0, atol=1e-12)


def test_a_live_point_is_led_on_over_the_dead_time() -> None:
    live = {"shape": "live", "points_m": [[1.0, 2.0]], "velocity_mps": [0.5, -1.0]}
    desired = make(late(**live))
    desired.tick(0)
    due = desired.due(np.arange(1), np.array([7]))[0]
    expected = [[1.0 + 0.5 * LATE_S[0], 0.5], [2.0 - LATE_S[1], -1.0]]
    np.testing.assert_allclose(due, expected, rtol=0.0, atol=1e-12)


def test_the_reference_is_right_for_vehicles_that_are_hours_apart() -> None:
    """Also if pages replace others, or compete for the same place."""
    assert BLOCK < PAGES  # one block fits, and one place is left EMPTY
    desired, rng, pages = make(), np.random.default_rng(1), set()
    for _ in range(8):
        steps, ahead = rng.integers(0, 86_400 / DT_S, BLOCK), rng.integers(0, H + 1, BLOCK)
        steps[0] = PAGES * PAGE + steps[1]  # the place of another
        expected = [truth(start) for start in (steps + ahead).tolist()]
        np.testing.assert_array_equal(window(desired, steps, ahead), expected)
        pages |= set(((steps + ahead) // PAGE).tolist())
        assert EMPTY in desired._keys
    assert len(pages) > 2 * PAGES


def test_the_reference_is_computed_once_for_a_page_of_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked, sample = [], SCENARIO.make_reference()

    def make_reference(_: Scenario) -> Callable[[Array], Array]:
        def reference(times: Array) -> Array:
            asked.append(times)
            return sample(times)

        return reference

    monkeypatch.setattr(Scenario, "make_reference", make_reference)
    desired, now = make(), np.array([0, 0])
    for step in range(PAGE):
        window(desired, np.array([step]), now)
    assert len(asked) == 1
    window(desired, np.array([PAGE]), now)
    window(desired, np.array([0, PAGE]), now)
    assert [times.shape for times in asked] == [(PAGE + H + 1,), (PAGE + H + 1,)]


# -- preview -----------------------------------------------------------------------------------


@settings(max_examples=20)
@given(
    shape=st.sampled_from(["circle", "square", "target"]),
    preview=st.sampled_from(["none", 0.3, 1.0, 2.0]),
    steps=st.lists(st.integers(0, 3 * PAGE), min_size=1, max_size=4),
    ahead=st.integers(0, 20),
)
def test_a_window_is_true_as_far_as_the_preview_reaches(
    shape: str, preview: float | str, steps: list[int], ahead: int
) -> None:
    """To the last bit; beyond, the last visible state is extrapolated."""
    flown = scenario(shape=shape, preview=preview)
    desired, sample = make(flown), flown.make_reference()
    reach = 0 if isinstance(preview, str) else round(preview / DT_S)
    found = window(desired, np.array(steps), np.full(len(steps), ahead))
    np.testing.assert_array_equal(
        desired.now(np.arange(len(steps)), np.array(steps)), sample(np.array(steps) * DT_S)
    )
    for k, states in zip(steps, found, strict=True):
        expected = truth(k + ahead, sample)
        last = sample(np.array((k + reach) * DT_S))
        for stage in range(H + 1):
            beyond_s = (ahead + stage - reach) * DT_S
            if beyond_s > 1e-9:
                led = last.copy()
                led[:, 0] += beyond_s * last[:, 1]
                if shape == "target":
                    np.testing.assert_array_less(np.abs(states[stage, :, 0]), 1.5)
                    far = np.abs(led[:, 0]) > 1.5  # no target here passes more than one wall
                    led[far, 0] = 3.0 * np.sign(led[far, 0]) - led[far, 0]
                    led[far, 1] *= -1.0
                np.testing.assert_allclose(states[stage], led, rtol=0, atol=1e-12)
            else:
                np.testing.assert_array_equal(states[stage], expected[stage])


def test_a_preview_longer_than_any_window_is_a_full_one() -> None:
    rows, ahead = np.array([5, 70, 200]), np.array([0, 7, 20])
    np.testing.assert_array_equal(
        window(make(scenario(preview=3600.0)), rows, ahead), window(make(), rows, ahead)
    )


def test_a_table_is_previewed_too(tmp_path: Any) -> None:
    path = tmp_path / "path.csv"
    path.write_text("t,x,y\n0,0,0\n1,1,0\n2,1,1\n")
    flown = scenario(shape="csv", file=str(path), preview=0.2)
    (before,) = window(make(flown), np.array([15]), np.array([0]))
    np.testing.assert_allclose(before[:, 1], 0.0)  # straight
    (seen,) = window(make(flown), np.array([16]), np.array([0]))
    np.testing.assert_allclose(seen[:4], truth(16, flown.make_reference())[:4])
    np.testing.assert_allclose(seen[5:, 1, 1], 1.0)  # the corner at 20 is visible


TURN = 60
"""Step from which on the two targets of `turning` differ."""


def turning(scale: float) -> Reference:
    def sample(t: Array) -> Array:
        t = np.asarray(t, dtype=np.float64)
        after = np.maximum(t - TURN * DT_S, 0.0)
        position = np.stack([0.3 * t + scale * after, 0.0 * t], axis=-1)
        velocity = np.stack([0.3 + scale * (after > 0.0), 0.0 * t], axis=-1)
        return np.stack([position, velocity], axis=-1)

    return sample


def flights_that_turn(preview: float | str, monkeypatch: pytest.MonkeyPatch) -> list[Record]:
    """Two flights of one seed, after targets that differ from TURN on."""
    flown = replaced("target-committed", {"duration": 6.0, "settle": 0.0}, preview=preview)
    flights = []
    for scale in (0.5, -0.5):
        monkeypatch.setattr(Scenario, "make_reference", lambda *_, scale=scale: turning(scale))
        flights.append(fly(flown))
    return flights


def replaced(name: str, changes: dict[str, Any], **reference: Any) -> Scenario:
    return packaged(name, changes, reference=reference)


def first_difference(flights: list[Record]) -> int:
    one, other = (flight.server for flight in flights)
    n = min(len(one), len(other))
    unlike = [
        (one[name][:n] != other[name][:n]).reshape(n, -1).any(axis=1)
        for name in ("planned", "input", "cost_gap", "event")
    ]
    return int(one["step"][:n][np.any(unlike, axis=0)][0])


@pytest.mark.parametrize(("preview", "reach"), [("none", 0), (0.5, 10)])
def test_a_server_never_sees_ahead(
    preview: float | str, reach: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # At TURN itself the state is the same with and without the turn.
    assert first_difference(flights_that_turn(preview, monkeypatch)) == TURN + 1 - reach


def test_a_server_that_sees_all_plans_for_what_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert first_difference(flights_that_turn("all", monkeypatch)) < TURN - 40


# -- prediction --------------------------------------------------------------------------------


@pytest.mark.long
def test_a_prediction_that_turns_round_at_the_bounds_is_better() -> None:
    """By the gain in docs/schemes.md; an acceleration estimated from the past is far worse."""
    ahead_s, times = 2.0, np.arange(1.0, 300.0, 0.5)
    errors: dict[str, list[Array]] = {"turns": [], "goes on": [], "accelerates": []}
    for seed in range(1, 41):
        rng = stream(seed, "target")
        sample = targets.target(rng, 2, agility=0.3, speed_mps=1.0, radius_m=10.0)
        now, past, then = (sample(times + shift) for shift in (0.0, -1.0, ahead_s))
        p, v, old = now[..., 0], now[..., 1], past[..., 1]
        error = p + ahead_s * v - then[..., 0]
        errors["goes on"].append(error)
        errors["accelerates"].append(error + 0.5 * ahead_s**2 * (v - old))
        lead = np.vectorize(lambda p, v: from_python(_extrapolated)(p, v, ahead_s, 10.0)[0])
        errors["turns"].append(lead(p, v) - then[..., 0])
    rms = {name: float(np.sqrt(np.mean(np.square(each)))) for name, each in errors.items()}
    assert rms["goes on"] == pytest.approx(0.55, abs=0.02)
    assert rms["turns"] == pytest.approx(0.44, abs=0.02)
    assert rms["accelerates"] > 0.9


@pytest.mark.parametrize(
    ("p", "v", "after_s", "expected"),
    [
        (1.0, 0.5, 2.0, (2.0, 0.5)),
        (1.0, 1.0, 2.0, (1.0, -1.0)),
        (-1.0, -1.0, 2.0, (-1.0, 1.0)),
        (0.0, 1.0, 7.0, (-1.0, 1.0)),
        (0.0, -1.0, 7.0, (1.0, -1.0)),
        (0.0, 3.0, 8.0, (0.0, 3.0)),
    ],
)
def test_a_prediction_goes_to_and_fro_between_walls(
    p: float, v: float, after_s: float, expected: tuple[float, float]
) -> None:
    """Reflected at walls at 2 m, any number of times; straight without walls."""
    assert from_python(_extrapolated)(p, v, after_s, 2.0) == expected
    assert from_python(_extrapolated)(p, v, after_s, np.inf) == (p + v * after_s, v)


# -- references of several vehicles ------------------------------------------------------------


def straight(vehicle: int) -> Reference:
    return points.timed_path(np.array([0.0, 1e4]), np.array([[0.0, 0.0], [1e2 * vehicle, -1e3]]))


@pytest.mark.parametrize("preview", ["all", 0.5])
def test_each_vehicle_has_a_trajectory_of_its_own(preview: float | str) -> None:
    desired = make(scenario(preview=preview), references=straight)
    rows = np.arange(BLOCK)
    for row in rows.tolist():
        desired.assign(row, BLOCK - row)
    for k in (0, PAGE - 3, 5 * PAGE, 5 * PAGE - 1):
        steps, ahead = np.full(BLOCK, k), rows % 5
        found = window(desired, steps, ahead)
        for row in rows.tolist():
            expected = truth(k + row % 5, straight(BLOCK - row))
            np.testing.assert_allclose(found[row], expected, rtol=0, atol=1e-9)
        assert EMPTY in desired._keys


def test_a_row_that_another_vehicle_takes_has_its_trajectory() -> None:
    desired, at = make(references=straight), np.array([10])
    for vehicle in (3, 8, 3):
        desired.assign(0, vehicle)
        found = desired.now(np.array([0]), at)
        np.testing.assert_array_equal(found[0], straight(vehicle)(at * DT_S)[0])


# -- a live point ------------------------------------------------------------------------------


def live(**reference: Any) -> Scenario:
    return scenario(**{"shape": "live", "points_m": [[1.0, 2.0]]} | reference)


def test_a_live_point_is_carried_on_by_its_velocity() -> None:
    desired = make(live(preview="all"))
    desired.tick(5 * SECOND_NS)
    steps, ahead = np.array([0, 900]), np.array([0, 4])
    at_rest = window(desired, steps, ahead)
    np.testing.assert_array_equal(at_rest[..., 0], np.broadcast_to([1.0, 2.0], (2, H + 1, 2)))
    np.testing.assert_array_equal(at_rest[..., 1], 0.0)
    desired.move(np.array([3.0, 0.0]), np.array([0.5, -1.0]), 6 * SECOND_NS)
    desired.tick(8 * SECOND_NS)
    np.testing.assert_allclose(desired.now(np.arange(2), steps), [[[4.0, 0.5], [-2.0, -1.0]]] * 2)
    found = window(desired, steps, ahead)
    for states, d in zip(found, ahead.tolist(), strict=True):
        after_s = (d + np.arange(H + 1)) * DT_S
        np.testing.assert_allclose(states[:, 0, 0], 4.0 + 0.5 * after_s)
        np.testing.assert_allclose(states[:, 1, 0], -2.0 - after_s)
        np.testing.assert_allclose(states[:, :, 1], np.broadcast_to([0.5, -1.0], (H + 1, 2)))


def test_only_a_live_point_can_be_moved() -> None:
    desired = make()
    desired.move(np.array([3.0, 0.0]), None, SECOND_NS)
    desired.tick(SECOND_NS)
    np.testing.assert_array_equal(desired.now(np.array([0]), np.array([7]))[0], truth(7)[0])


def point(velocity: Array | None = None) -> LivePoint:
    """Point at the origin, for vehicles that fly 2 m/s."""
    return LivePoint(np.zeros(2), velocity, np.full(2, 2.0))


def led(hz: int, velocity: float, until_s: float = 2.0) -> LivePoint:
    """Point moved along x at a rate and velocity, until some time."""
    moved = point()
    for i in range(1, round(until_s * hz) + 1):
        moved.move(np.array([velocity * i / hz, 0.0]), None, seconds_to_ns(i / hz))
    return moved


@pytest.mark.parametrize("hz", [2, 50])
def test_moves_tell_the_velocity(hz: int) -> None:
    state = led(hz, 0.7).at(seconds_to_ns(2.1))
    np.testing.assert_allclose(state, [[0.7 * 2.1, 0.7], [0.0, 0.0]], atol=1e-3)


def test_a_point_that_is_not_moved_any_more_rests_where_it_was_moved_to() -> None:
    """It is extrapolated for REST_S; the next move gives no velocity."""
    moved = led(10, 0.7)
    assert moved.at(seconds_to_ns(2.0 + REST_S))[0, 0] == pytest.approx(0.7 * (2.0 + REST_S), 1e-3)
    np.testing.assert_allclose(moved.at(seconds_to_ns(2.01 + REST_S)), [[1.4, 0.0], [0.0, 0.0]])
    moved.move(np.array([9.0, 9.0]), None, seconds_to_ns(60.0))
    np.testing.assert_allclose(moved.at(seconds_to_ns(60.5)), [[9.0, 0.0], [9.0, 0.0]])


def test_a_point_whose_velocity_is_told_goes_on() -> None:
    moved = point(np.array([1.0, 0.0]))
    np.testing.assert_allclose(moved.at(100 * SECOND_NS)[:, 0], [0.0, 0.0])
    np.testing.assert_allclose(moved.at(160 * SECOND_NS), [[60.0, 1.0], [0.0, 0.0]])


def test_a_leap_makes_no_velocity_that_no_vehicle_can_fly() -> None:
    """Two moves at once, or a kilometre in an instant; a clock set back gives no velocity."""
    moved = led(10, 0.5)
    moved.move(np.array([1000.0, 0.0]), None, seconds_to_ns(2.001))
    assert moved.at(seconds_to_ns(2.001))[0].tolist() == [1000.0, 2.0]
    moved = led(10, 0.5)
    for now_s in (2.0, 1.5):
        moved.move(np.array([8.0, 0.0]), None, seconds_to_ns(now_s))
        np.testing.assert_allclose(moved.at(seconds_to_ns(1.0)), [[8.0, 0.5], [0.0, 0.0]], 1e-3)


def test_a_mean_of_velocities_bears_moves_that_are_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of 1 cm at 50 moves a second; the difference of two moves alone would be useless."""

    def spread() -> float:
        rng, moved, velocities = np.random.default_rng(1), point(), []
        for i in range(1, 500):
            along = 0.5 * i / 50 + 0.01 * rng.standard_normal()
            moved.move(np.array([along, 0.0]), None, seconds_to_ns(i / 50))
            velocities.append(moved.at(seconds_to_ns(i / 50))[0, 1])
        return float(np.std(velocities[50:]))

    assert MEMORY_S == 0.2
    assert spread() < 0.07
    monkeypatch.setattr("skytether.server.planning.moving_setpoint.MEMORY_S", 1e-6)
    assert spread() > 0.5


def test_a_live_flight_is_judged_by_where_the_server_knew_the_point() -> None:
    """A point on a straight line is followed closely; without the server its place is unknown."""
    changes = {"duration": 12.0, "settle": 8.0}
    flown = replaced(
        "target-committed", changes, shape="live", points_m=[[0.0, 0.0]], velocity_mps=[0.3, -0.2]
    )
    flight = fly(flown)
    rows = flight.server
    known = rows["reference"][-1]
    np.testing.assert_allclose(known[:, 1], [0.3, -0.2])
    np.testing.assert_allclose(known[:, 0], known[:, 1] * rows["step"][-1] * DT_S, rtol=0.2)
    result = summarise(flown, "test", flight.client, rows)
    assert result.rmse_xy < 0.1
    nobody = summarise(flown, "test", flight.client)
    assert (nobody.rmse_xy, nobody.error_max) == (None, None)


def test_the_desired_position_of_a_live_flight_is_held_where_the_server_has_no_row() -> None:
    """Rows are joined by vehicle and step; before the first of them the initial point counts."""
    flown = live()
    client = np.zeros(5, [("vehicle", "<u2"), ("step", "<i8")])
    client["vehicle"], client["step"] = 2, np.arange(5)
    rows = np.zeros(4, [("vehicle", "<u2"), ("step", "<i8"), ("reference", "<f8", (2, 2))])
    rows["vehicle"], rows["step"] = [2, 1, 2, 2], [1, 2, 3, 3]
    rows["reference"][:, :, 0] = [[1, 1], [7, 7], [3, 3], [4, 4]]
    found = desired_positions(flown, client, rows)
    np.testing.assert_array_equal(found[:, 0], [1.0, 1.0, 1.0, 4.0, 4.0])
    assert np.isnan(desired_positions(flown, client, rows[1:2])).all()


def test_the_record_tells_what_was_known_of_the_reference() -> None:
    flown = replaced("target-committed", {"duration": 3.0, "settle": 0.0}, preview="none")
    rows = fly(flown).server
    known = flown.make_reference()(rows["step"] * DT_S)
    np.testing.assert_array_equal(rows["reference"], known)
