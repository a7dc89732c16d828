"""Envelope of a scenario: points, verdicts, command."""

import csv
import re
import shlex
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from helpers import demo_with, refused_before_writing, without_painting
from skytether.__main__ import main
from skytether.cli import fly
from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.weather import Weather
from skytether.lab.envelope import (
    Envelope,
    EnvelopePoint,
    disc,
    draw,
    judge,
    settling_s,
    worst_first,
)
from skytether.lab.journal import StudyJournal
from skytether.netem.impairments.direction import impairments
from skytether.server.controller import Controller
from skytether.shared.base.chance import stream
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.scenario.registry import IMPAIRMENTS
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Rows, client_columns
from skytether.shell.commandline import command
from skytether.sim import flight

DEMO = Envelope("demo-committed", reading.load("demo-committed"))


# -- the points ----------------------------------------------------------------------------------


def test_points_lie_within_their_bounds_and_fill_them() -> None:
    """Delays to 3 s, losses to 0.99 and half of the points to 0.5, Δt and H log-uniform."""
    points = [draw(1, number) for number in range(2000)]
    column = {key: np.array([point[key] for point in points]) for key in points[0]}
    for direction in ("uplink", "downlink"):
        calls = [IMPAIRMENTS.calls(text)[0] for text in column[f"network.{direction}"]]
        delays = np.array([call.values[0] for call in calls])
        assert 0.0 <= delays.min() < 0.01
        assert 2.99 < delays.max() <= 3.0
        assert {call.name for call in calls} == {"constant", "paper"}
    paths = [
        [impairments(each) for each in column[f"network.{way}"]] for way in ("uplink", "downlink")
    ]
    up, down = (np.array([each.loss for each in way]) for way in paths)
    assert 0.97 < max(up.max(), down.max()) <= 0.99
    assert np.mean(np.maximum(up, down) <= 0.5) == pytest.approx(
        0.5 + 0.5 * 0.5**2 * 1.02, abs=0.04
    )
    assert 0.005 <= column["control.dt"].min() < 0.0052
    assert 0.48 < column["control.dt"].max() <= 0.5
    assert np.median(column["control.dt"]) == pytest.approx(0.05, rel=0.15)
    assert (column["control.horizon"].min(), column["control.horizon"].max()) == (1, 120)
    assert {*column["control.feedback"].tolist()} == {False, True}
    assert len({*column["seed"]}) == 2000
    delays = [[each.least_s for each in way] for way in paths]
    assert abs(np.corrcoef(delays)[0, 1]) < 0.1


def test_a_point_is_the_same_whatever_else_is_flown() -> None:
    assert draw(1, 5) == draw(1, 5)
    assert draw(1, 5) != draw(2, 5)
    scenario = DEMO.scenario_of(1)
    assert reading.to_table(scenario)["control"]["horizon"] == draw(1, 1)["control.horizon"]
    assert scenario.network.uplink == draw(1, 1)["network.uplink"]
    assert scenario.reference == DEMO.scenario.reference


def test_the_command_line_of_a_point_flies_that_point() -> None:
    plan = Envelope(
        "demo-committed", demo_with(duration=12.0, vehicle__steady_wind_mps=[0.1, -0.2])
    )
    line = shlex.split(plan.command(1))
    assert line[:4] == ["skytether", "fly", "demo-committed", "--virtual"]
    options = command.parse(fly.FlyOptions(), line[2:], "skytether fly", "")
    assert options.config == plan.scenario_of(1)
    assert "--reference.radius-m" not in line


# -- verdicts on artificial records --------------------------------------------------------------

SCENARIO = demo_with(
    duration=40.0, control__dt=0.05, vehicle__wind=0.0, network__uplink__loss=0.0, seed=1
)
DT, STEPS = 0.05, SCENARIO.steps
TIME_S = np.arange(STEPS) * DT
PATH = SCENARIO.make_reference()(TIME_S)
BRAKE = SCENARIO.vehicle.brake_mps2
YES, NO = np.ones(STEPS, np.bool_), np.zeros(STEPS, np.bool_)


def record(state: Array, inputs: Array, covered: Flags, age_s: float = 1.0) -> Rows:
    """Client's record with these states, inputs, and planned steps."""
    rows = np.zeros(len(state), client_columns(2))
    rows["step"], rows["state"], rows["input"] = np.arange(len(state)), state, inputs
    rows["covered"], rows["age_ns"] = covered, np.where(covered, round(age_s * 1e9), -1)
    return rows


def along(command: Callable[[int, Array], Any], covered: Flags = YES) -> Rows:
    """Record of a vehicle that flies a command, a function of step and state, without wind."""
    plant = FirstOrderPlant(SCENARIO, Weather(SCENARIO, stream(1, "test")))
    states, inputs = [], []
    for step in range(STEPS):
        states.append(plant.state())
        inputs.append(np.asarray(command(step, states[-1]), dtype=np.float64))
        plant.advance(inputs[-1])
    return record(np.array(states), np.array(inputs), covered)


def chase(step: int, state: Array) -> Array:
    """Command that brings the vehicle to the reference, within its bounds."""
    wanted = PATH[step, :, 1] + 2.0 * (PATH[step, :, 0] - state[:, 0])
    return np.clip(wanted, -1.6, 1.6)


def ramp(speed_mps: float, since_s: float, brake: float = BRAKE) -> Array:
    return np.array([max(0.0, speed_mps - brake * since_s), 0.0])


def until(*ends: int) -> Flags:
    """Flags that are true at first and change at each of these steps."""
    return np.array([sum(step >= end for end in ends) % 2 == 0 for step in range(STEPS)])


def test_a_flight_near_the_reference_is_flown() -> None:
    """Only the error after settling counts; the vehicle started 1.5 m away."""
    rows = record(PATH, PATH[..., 1], YES)
    assert judge(SCENARIO, rows) == EnvelopePoint("flown", 0.0, 1.0, pytest.approx(0.0))
    late = rows.copy()
    late["state"][settling_s(SCENARIO) - 1.0 > TIME_S, 0, 0] += 1.5
    assert judge(SCENARIO, late).outcome == "flown"
    assert judge(SCENARIO, late).error_max == 0.0


def test_what_never_got_a_plan_and_stood_still_is_hovering() -> None:
    verdict = judge(SCENARIO, along(lambda *_: [0.0, 0.0], NO))
    assert verdict == EnvelopePoint("hovering", None, 0.0, 0.0)


def test_a_flight_that_brakes_along_the_curve_is_hovering() -> None:
    """Planned for 20 s, then braked from 1.6 m/s to rest."""
    covered = until(400)

    def command(step: int, state: Array) -> Array:
        return chase(step, state) if step < 400 else ramp(1.6, (step - 399) * DT)

    verdict = judge(SCENARIO, along(command, covered))
    assert (verdict.outcome, verdict.covered, verdict.line) == ("hovering", 0.5, "")
    assert verdict.error_max is not None
    assert verdict.error_max > 1.0


def test_a_flight_with_plans_again_at_its_end_is_interrupted() -> None:
    """Braked from 10 s to 25 s, then planned again."""

    def command(step: int, state: Array) -> Array:
        return ramp(1.0, (step - 199) * DT) if 200 <= step < 500 else chase(step, state)

    assert judge(SCENARIO, along(command, until(200, 500))).outcome == "interrupted"


def test_a_flight_whose_plans_came_too_late_to_settle_is_interrupted() -> None:
    """Five seconds before the end."""
    rows = along(lambda step, state: chase(step, state) if step >= 700 else [0.0, 0.0], ~until(700))
    verdict = judge(SCENARIO, rows)
    assert (verdict.outcome, verdict.error_max, verdict.covered) == ("interrupted", None, 0.125)


def test_a_flight_beside_the_reference_is_astray() -> None:
    """Planned at all times, always 1.5 m off."""
    rows = record(PATH, PATH[..., 1], YES)
    rows["state"][:, 1, 0] += 1.5
    verdict = judge(SCENARIO, rows)
    assert (verdict.outcome, verdict.error_max) == ("astray", pytest.approx(1.5))


def test_a_flight_without_a_step_is_unanswered() -> None:
    assert judge(SCENARIO, np.zeros(0, client_columns(2))) == EnvelopePoint("unanswered")


def held(step: int, state: Array) -> Array:
    """Command that is held from 20 s on, without a plan."""
    return chase(step, state) if step < 400 else np.array([0.3, 0.0])


def slack(step: int, state: Array) -> Array:
    """Command that falls at half the rate."""
    return chase(step, state) if step < 400 else ramp(1.6, (step - 400) * DT, 0.5 * BRAKE)


def restarted(step: int, state: Array) -> Array:
    """Command that brakes, but restarts each second after the plan has run out."""
    return chase(step, state) if step < 400 else ramp(1.6, step * DT % 1.0)


UNPLANNED = until(400)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (along(held, UNPLANNED), "at 20.05 s its command is 0.3 m/s without a plan, while"),
        (along(slack, UNPLANNED), "at 20.05 s its command is 1.55 m/s without a plan, while"),
        (along(restarted, UNPLANNED), "at 21.00 s its command is 1.6 m/s without a plan, while"),
    ],
    ids=["held", "too slow", "begun anew"],
)
def test_a_command_that_does_not_brake_without_a_plan_is_a_flyaway(rows: Rows, said: str) -> None:
    verdict = judge(SCENARIO, rows)
    assert verdict.outcome == "flyaway"
    assert verdict.line.startswith(said)


@pytest.mark.parametrize(
    ("feedback", "is_held", "behind_m", "away_m", "outcome"),
    [
        (True, True, 0.0, 0.9, "hovering"),
        (True, True, 0.0, 1.2, "flyaway"),
        (True, True, 0.5, 1.4, "hovering"),
        (True, True, 0.5, 1.7, "flyaway"),
        (True, False, 0.0, 0.9, "flyaway"),
        (True, False, 0.5, 0.9, "flyaway"),
        (False, True, 0.0, 0.9, "flyaway"),
    ],
)
def test_feedback_may_lead_back_after_a_horizon_s_end(
    *, feedback: bool, is_held: bool, behind_m: float, away_m: float, outcome: str
) -> None:
    """Feedback of a finished horizon may move the vehicle by a metre plus its lag."""
    state = PATH.copy()
    state[:, 0, 0] -= behind_m
    rest = state[400, :, 0].copy()
    state[400:] = np.stack([rest, 0.0 * rest], axis=-1)
    state[500:, 0, 0] += away_m
    inputs = np.where(UNPLANNED[:, None], PATH[..., 1], [0.3, 0.0])
    rows = record(state, inputs, UNPLANNED)
    rows["age_ns"][400:] = round(3e9) if is_held else -1
    table = reading.to_table(SCENARIO)
    table["control"]["feedback"] = feedback
    assert judge(reading.check(table, "test"), rows).outcome == outcome


@pytest.mark.parametrize(
    ("moves_mps", "has_mps", "said"),
    [
        (0.5, 0.0, "m without a plan, while braking takes at most 0.311 m"),
        (
            0.0,
            0.5,
            "at 20.05 s its speed is 0.5 m/s without a plan, while braking allows 0.471 m/s",
        ),
    ],
)
def test_a_vehicle_that_moves_though_its_command_is_none_is_a_flyaway(
    moves_mps: float, has_mps: float, said: str
) -> None:
    state = PATH.copy()
    state[400:, :, 0] = PATH[400, :, 0] + moves_mps * (TIME_S[400:, None] - 20.0) * [1.0, 0.0]
    state[400:, :, 1] = [has_mps, 0.0]
    state[400, :, 1] = [0.5 if has_mps else 0.37, 0.0]
    verdict = judge(SCENARIO, record(state, PATH[..., 1] * UNPLANNED[:, None], UNPLANNED))
    assert verdict.outcome == "flyaway"
    assert said in verdict.line


def test_a_vehicle_that_plans_lead_away_is_a_flyaway() -> None:
    """Beyond the disc of 2 m radius by more than 1 m and the stopping distance from full speed."""
    centre, radius_m = disc(SCENARIO)
    assert centre == pytest.approx([0.0, 0.0], abs=1e-3)
    assert radius_m == pytest.approx(2.0, abs=1e-3)
    verdict = judge(SCENARIO, along(lambda *_: [1.0, 0.0]))
    assert verdict.outcome == "flyaway"
    assert "4.29 m" in verdict.line


def swinging(step: int) -> Array:
    """State that oscillates about the reference with growing amplitude."""
    swing = np.array([0.1 * TIME_S[step] * np.sin(TIME_S[step]), 0.0])
    return PATH[step] + np.stack([swing, 0.0 * swing], -1)


def test_a_growing_swing_under_plans_is_a_flyaway() -> None:
    """Further away than a vehicle at rest in the middle, under plans based on new observations."""
    state = np.array([swinging(step) for step in range(STEPS)])
    verdict = judge(SCENARIO, record(state, PATH[..., 1], YES))
    assert verdict.outcome == "flyaway"
    assert " 3 m " in verdict.line
    # Without any new observation the same motion is no fault of the loop.
    blind = judge(SCENARIO, record(state, PATH[..., 1], YES, age_s=60.0))
    assert blind.outcome == "astray"


def test_a_state_that_is_no_number_is_a_flyaway() -> None:
    rows = record(PATH, PATH[..., 1], YES)
    rows["state"][-1, 0, 0] = np.nan
    verdict = judge(SCENARIO, rows)
    assert verdict.outcome == "flyaway"
    assert "39.95 s" in verdict.line


def test_wind_may_carry_a_vehicle_that_brakes() -> None:
    windy = demo_with(duration=40.0, vehicle__steady_wind_mps=[0.1, 0.0], vehicle__wind=0.0)
    state = np.zeros((STEPS, 2, 2))
    state[:, 0, 0], state[:, 0, 1] = 0.1 * TIME_S, 0.1
    rows = record(state, np.zeros((STEPS, 2)), NO)
    rows["state"][0, 0, 1] = 0.0
    assert judge(windy, rows).outcome == "hovering"
    assert judge(SCENARIO, rows).outcome == "flyaway"
    rows["state"][:, 0, 0] *= 1.2
    assert judge(windy, rows).outcome == "flyaway"


# -- real flights --------------------------------------------------------------------------------

BLIND = {
    "control__feedback": False,
    "control__horizon": 40,
    "control__input_weight": 0.01,
    "control__input_reference": False,
}
"""Committed inputs without feedback, at tight weights."""


def test_a_vehicle_that_does_not_brake_is_caught_and_one_that_does_is_not() -> None:
    """Four of five horizons of 2 s are lost, so they run out; the last input is held, or braked."""

    def outcome(exhausted: str) -> str:
        keys = {"vehicle__exhausted": exhausted, "network__uplink__loss": 0.8} | BLIND
        scenario = demo_with(**keys, duration=40.0)
        return judge(scenario, flight.fly(scenario).client).outcome

    assert outcome("hold") == "flyaway"
    assert outcome("brake") in ("interrupted", "hovering")


def test_horizons_that_come_late_are_a_flyaway_where_nothing_guards_against_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The round trip is two thirds longer than the delay that horizons are planned for."""
    monkeypatch.setattr(Controller, "able", _able_whatever_the_delay)
    monkeypatch.setattr(
        "skytether.server.schemes.committed.committed_max", lambda terms: terms.horizon
    )
    monkeypatch.setattr(
        "skytether.client.compensator.Compensator._comes_too_late", lambda *_: False
    )
    table = reading.to_table(reading.load("demo-committed"))
    for direction, delay_s in (("uplink", 0.05), ("downlink", 1.4)):
        set_keys({f"network.{direction}": f"constant({delay_s}) & loss(0.1)"}, table)
    set_keys({key.replace("__", "."): value for key, value in BLIND.items()}, table)
    set_keys({"duration": 40.0, "control.dt": 0.02, "control.horizon": 20}, table)
    scenario = msgspec.convert(table, Scenario)  # unchecked: the check would refuse it
    verdict = judge(scenario, flight.fly(scenario).client)
    assert verdict.outcome == "flyaway"
    assert verdict.outside_m is not None
    assert verdict.outside_m > 5.0


def _able_whatever_the_delay(
    controller: Controller, rows: Indices, step: Indices
) -> tuple[Indices, Indices]:
    """Replacement for the controller's check: vehicles with a new step, and their steps."""
    able: Flags = (step > controller.last_step[rows]) & (controller.observed_step[rows] >= 0)
    return rows[able], step[able]


@pytest.mark.parametrize("numbers", [range(9), pytest.param(range(9, 40), marks=pytest.mark.long)])
def test_no_point_of_the_demo_flies_away(numbers: range) -> None:
    points = [DEMO.fly(number) for number in numbers]
    assert [number for number, point in worst_first(points) if point.line] == []
    outcomes = [point.outcome for point in points]
    assert {"flown", "hovering", "refused"} <= {*outcomes}


def test_a_refused_point_has_the_line_that_a_user_would_read() -> None:
    point = DEMO.fly(0)
    assert point.outcome == "refused"
    assert point.line.startswith(
        "demo-committed: control.dt: got 0.005685, expected more, for the delay of "
    )


def test_a_point_that_raises_has_crashed(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: Scenario) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(flight, "fly", fail)
    assert DEMO.fly(1) == EnvelopePoint("crashed", line="ZeroDivisionError: division by zero")


def test_the_worst_come_first() -> None:
    points = [
        EnvelopePoint("astray", 1.2),
        EnvelopePoint("flyaway", None, 0.0, 3.0),
        EnvelopePoint("flown", 0.1),
        EnvelopePoint("flyaway", None, 0.0, 50.0),
        EnvelopePoint("crashed"),
        EnvelopePoint("astray", 2.2),
    ]
    assert [number for number, _ in worst_first(points)] == [4, 3, 1, 5, 0]


# -- the command ---------------------------------------------------------------------------------

SHORT = ["envelope", "demo-committed", "--duration", "2", "--settle", "0", "--workers", "1"]


@pytest.mark.usefixtures("here")
def test_more_points_go_on_where_fewer_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    once, twice = tmp_path / "once", tmp_path / "twice"
    with without_painting():
        main([*SHORT, "--runs", "3", "--out", str(once)])
        main([*SHORT, "--runs", "2", "--out", str(twice)])
    kept = (twice / "journal.jsonl").read_bytes()
    assert len((twice / "points.csv").read_text().splitlines()) == 3
    capsys.readouterr()
    main([*SHORT, "--runs", "3", "--out", str(twice)])
    assert (twice / "journal.jsonl").read_bytes().startswith(kept)
    assert (twice / "points.csv").read_bytes() == (once / "points.csv").read_bytes()
    assert (twice / "envelope.png").read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader((once / "points.csv").read_text().splitlines()))
    assert [int(row["number"]) for row in rows] == list(range(3))
    assert [float(row["control.dt"]) for row in rows] == [
        draw(1, number)["control.dt"] for number in range(3)
    ]
    refused = sum(row["outcome"] == "refused" for row in rows)
    assert re.search(rf"refused +│ +{refused} │", capsys.readouterr().out)


@pytest.mark.usefixtures("unpainted")
def test_a_flyaway_ends_the_command_with_one_and_a_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = Envelope("demo-committed", demo_with(duration=2.0, settle=0.0))
    lost = EnvelopePoint("flyaway", None, 0.0, 42.0, "at 1.50 s it is commanded 1.60 m/s")
    with closing(StudyJournal(tmp_path, plan.settings(), EnvelopePoint)) as journal:
        journal.add("1", EnvelopePoint("astray", 1.25, 1.0, 0.0))
        journal.add("0", lost)
    assert main([*SHORT, "--runs", "2", "--out", str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert f"flyaway: {lost.line}\n    {plan.command(0)}\nastray: 1.25 m from the" in said.out
    assert said.err == "envelope: 1 of 2 points flew away or crashed\n"


def test_another_seed_does_not_go_on_in_the_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    StudyJournal(tmp_path, DEMO.settings(), EnvelopePoint).close()
    assert (
        main(["envelope", "demo-committed", "--seed", "2", "--runs", "1", "--out", str(tmp_path)])
        == 2
    )
    said = "seed: got 2, expected 1 to continue there; or choose another --out"
    assert capsys.readouterr().err == f"envelope: {tmp_path}: {said}\n"


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["--runs", "0"], "--runs: got 0, expected 1 to 1000000"),
        (["--workers", "0"], "--workers: got 0, expected 1 to 1024"),
    ],
)
def test_an_impossible_envelope_is_refused(
    argv: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = refused_before_writing(["envelope", "demo-committed", *argv], tmp_path, capsys)
    assert told == f"envelope: {line}"


def test_points_with_trajectories_are_flown_with_feedback() -> None:
    along = demo_with(
        control__scheme="trajectory",
        control__trigger="expected_gap(0.05) | silence(1)",
        duration=15.0,
    )
    plan = Envelope("demo", along)
    for number in range(20):
        assert plan.keys(number) == DEMO.keys(number) | {"control.feedback": True}
    assert plan.fly(0).outcome != "refused"
