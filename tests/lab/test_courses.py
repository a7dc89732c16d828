"""Inputs prescribed by a message: by independent equations, and by the server's copy."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from fuzz.torture.courses import FollowedCourse, PlannedCourse
from skytether.client.compensator import Compensator
from skytether.client.followers import Constants, Follower, HorizonFollower, SplineFollower
from skytether.server.planning.scheme import Foresight
from skytether.server.schemes import trajectory
from skytether.server.schemes.committed import Replay
from skytether.server.schemes.trajectory import Guidance
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario import reading
from skytether.shared.scenario.gain import regulator
from skytether.shared.scenario.whole import Scenario
from skytether.shared.wire.protocol import FEEDBACK, KNOTS_MAX, Horizon, Trajectory
from skytether.sim.flight import fly

AXES, AGE_MAX, H = 2, 30, 20
FLIGHT = 60
"""Number of steps flown by one message, which ends and is then braked."""
STAGES = 3000


def terms(scheme: str, exhausted: str, rng: np.random.Generator) -> Terms:
    table = {
        "model": {"tau_s": rng.uniform(0.2, 2.0, AXES).tolist(), "gain": [0.8, 1.1]},
        "control": {"dt": 0.1, "horizon": H, "scheme": scheme},
        "vehicle": {"exhausted": exhausted, "brake_mps2": float(rng.uniform(0.5, 4.0))},
        "network": {"uplink": "loss(0.1)", "downlink": "loss(0.1)"},
        "link": {"age_max_s": 0.1 * AGE_MAX},
    }
    return reading.check(table, "test").terms()


@pytest.mark.parametrize("scheme", ["trajectory", "committed"])
def test_what_is_flown_is_what_the_equations_say(scheme: str) -> None:
    """Messages, states, wind, and the steps at which the vehicle is awake are random."""
    rng, away, compared = np.random.default_rng(1), 0.0, 0
    while compared < STAGES:
        flown = terms(scheme, ("brake", "hold")[rng.integers(2)], rng)
        along = rng.uniform(0.0, (3.0, 3.0, 0.9), (AXES, 3))
        aboard = Compensator(flown, along)
        step, age = int(rng.integers(9, 40)), int(rng.integers(3, 9))
        course: FollowedCourse | PlannedCourse
        if scheme == "trajectory":
            count = int(rng.integers(1, KNOTS_MAX + 1))
            knots = rng.normal(0.0, 3.0, (AXES, count, 2)).astype(np.float32)
            sent = Trajectory(1, 1, step, 0, age, int(rng.integers(1, 12)), knots)
            aboard.offer(sent, step - 2, step - age)
            course = FollowedCourse(sent, AGE_MAX - age + 1, flown, along)
        else:
            inputs = rng.normal(0.0, 1.5, (AXES, H)).astype(np.float32)
            feedback = rng.normal(0.0, 1.0, (AXES, FEEDBACK * int(rng.integers(2))))
            horizon = Horizon(1, 1, step, 0, 0, inputs, feedback.astype(np.float32))
            aboard.offer(horizon, step - 2, step - age)
            course = PlannedCourse(horizon, min(H, AGE_MAX - age + 1), flown)
        for k in range(step - 2, step + FLIGHT):
            if rng.random() < 0.1:  # the vehicle was asleep
                continue
            state, found = rng.normal(0.0, 2.0, (AXES, 2)), rng.normal(0.0, 0.3, AXES)
            before = rng.uniform(np.negative(flown.u_max), flown.u_max)
            u, _ = aboard.choose(k, state, found, before)
            wanted = course.prescribed(k - step) + course.feedback(k - step, state, found)
            anew = np.clip(wanted, np.negative(flown.u_max), flown.u_max)
            anew = course.lag * before + (1.0 - course.lag) * anew
            away = max(away, float(np.abs(anew - u).max()))
            compared += 1
    assert away < 1e-9


# -- in flight -------------------------------------------------------------------------------


def kept_at_the_server(scheme: Any, found: Foresight, row: int, i: int) -> tuple[Array, Array, int]:
    """Server's copy of the newest message: numbers, feedback, and steps between knots."""
    memory = scheme._memory
    if isinstance(scheme, Guidance):
        slot = (memory.sent.delivery["sent"][row] - 1) % trajectory.RING
        count = memory.trajectories["count"][row, slot]
        knots = memory.knots[row, slot, :, : 2 * count]
        return (
            knots.reshape(len(knots), count, 2).copy(),
            np.zeros(0),
            memory.trajectories["spacing"][row, slot],
        )
    slot = memory.sent.plans["step"][row].argmax()
    return memory.inputs[row, slot].copy(), found.feedback[i].astype(float), 0


def flown_mismatches(flown: Scenario) -> tuple[int, int]:
    """Number of steps flown by a plan, and of inputs that differ from the prescribed ones.

    The prescribed input follows from the server's copy of the message, the state and disturbance
    estimated aboard, and the rate limit.
    """
    kept: dict[int, tuple[Array, Array, int]] = {}
    winds: dict[int, Array] = {}
    terms, along = flown.terms(), regulator(flown)
    follows = terms.splines
    scheme = Guidance if follows else Replay
    remember, choose = scheme.remember, Compensator.choose

    def spy(self: Any, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        remember(self, rows, step, found, event)
        for i in event.nonzero()[0].tolist():
            kept[int(step[i])] = kept_at_the_server(self, found, int(rows[i]), i)

    def look(
        self: Compensator, step: int, state: Any, disturbance: Any, before: Any
    ) -> tuple[list[float], list[float]]:
        winds[step] = disturbance.copy()
        return choose(self, step, state, disturbance, before)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scheme, "remember", spy)
        patch.setattr(Compensator, "choose", look)
        client = fly(flown).client
    steps, differ, followers = 0, 0, dict[int, Follower]()
    constants = Constants.of(terms, along)
    change = flown.vehicle.slew_mps2 * terms.dt_s
    for before, row in pairwise(client):
        step, made = int(row["step"]), int(row["in_force"])
        if not row["covered"]:
            continue
        if made not in followers:
            numbers, feedback, spacing = kept[made]
            observed = step - int(row["age_ns"]) // terms.dt_ns
            last = observed + terms.age_max - made + 1
            if follows:
                followers[made] = SplineFollower(constants, numbers, spacing, last)
            else:
                length, back = min(numbers.shape[1], last), feedback if terms.feedback else None
                followers[made] = HorizonFollower(constants, numbers, length, back)
        last_flown = before["input"]
        wanted, _ = followers[made].input_at(step - made, row["estimate"], winds[step], last_flown)
        near = np.clip(wanted, last_flown - change, last_flown + change)
        differ += (np.clip(near, np.negative(terms.u_max), terms.u_max) != row["input"]).any()
        steps += 1
    return steps, differ


def demo(scheme: str, duration_s: float, seed: int) -> Scenario:
    """The demo in unknown wind, with a gain that differs from the model's."""
    table = reading.to_table(reading.load("demo")) | {"duration": duration_s, "seed": seed}
    trigger = "expected_gap(0.05)" if scheme == "trajectory" else "cost_gap(3)"
    table["control"] |= {"scheme": scheme, "trigger": f"{trigger} | silence(1)"}
    table["control"]["change_weight"] = 0.05
    table["vehicle"] |= {"gain": [0.9], "steady_wind_mps": [0.2, -0.1], "wind": 0.1}
    return reading.check(table, "demo")


@pytest.mark.parametrize("scheme", ["trajectory", "committed"])
def test_what_is_flown_follows_from_what_the_server_keeps(scheme: str) -> None:
    steps, differ = flown_mismatches(demo(scheme, 30.0, 1))
    assert steps > 400
    assert differ == 0
