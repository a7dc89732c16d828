"""Floors: lower bounds of the tracking error over a network, and flights without any packets.

An input depends on an observation and on a plan, and both have an age when the input takes effect.
Disturbances during this age are not compensated. For white accelerations their variance is known in
closed form, and the record contains the ages. So each flight has a floor: no planner, solver or
weight can have a smaller error with the same packet timing.

The floor holds for packets sent at every step, periodically, or at fixed times. It does not hold
for event triggers: they send when the error is large, so age and error are correlated, and some
flights are below the floor.

The other baseline is a flight without a network, with reference and regulator aboard, which is
possible if the reference is known before the flight.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace

from skytether.client.clamp import clamped
from skytether.client.followers import Constants, SplineFollower
from skytether.client.navigation import Navigation
from skytether.client.simulated.vehicle import simulated
from skytether.lab.engine.budgets import Plan
from skytether.lab.engine.contenders import BESIDE, REGULATED
from skytether.lab.engine.journal import digests
from skytether.shared.law.model import Array, white_acceleration
from skytether.shared.scenario import reading
from skytether.shared.scenario.gain import regulator
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import PACKET_COLUMNS, UPLINK, Reason, Rows, client_columns
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.shared.wire.protocol import NO_HORIZON, Mode
from skytether.sim.batch import fly_batch

UNKNOWN = ("target", "live")
"""Shapes of a reference that only the server knows during the flight."""


def wind_floor_m(scenario: Scenario, client: Rows) -> float:
    """Floor of RMSE xy [m], from `settle` on, in white wind for plans flown without feedback
    aboard.

    An input cannot compensate wind after the observation that it was planned from. With feedback
    aboard the vehicle compensates wind itself, so this floor does not apply. Steps without a plan
    count as if there were no wind; gusts are not included.

    `client` has the rows of one vehicle.
    """
    before = _inputs(scenario, client)
    ages_s = (before["age_ns"] * 1e-9 + scenario.control.dt)[before["age_ns"] >= 0]
    ages_s, counts = np.unique(ages_s, return_counts=True)
    roots = [white_acceleration(scenario.true_tau_s[:2], float(age_s)) for age_s in ages_s]
    variances = [scenario.vehicle.wind**2 * float((root[:, 0, 0] ** 2).sum()) for root in roots]
    return _root(np.dot(counts, variances), len(before))


def target_floor_m(scenario: Scenario, client: Rows) -> float:
    """Floor of RMSE xy [m], from `settle` on, for a target that only the server knows.

    The vehicle cannot know the target's motion after its plan was made: white acceleration of the
    strength `reference.agility`, except within `reference.preview`. The target's bounds are
    ignored. Steps without a plan count as if the target had been at rest.

    `client` has the rows of one vehicle.
    """
    before, preview = _inputs(scenario, client), scenario.reference.preview
    if preview == "all":
        return 0.0
    seen_s = 0.0 if preview == "none" else preview
    planned = before[before["in_force"] != NO_HORIZON]
    ages_s = (planned["step"] + 1 - planned["in_force"]) * scenario.control.dt - seen_s
    variances = 2.0 * scenario.reference.agility**2 * np.maximum(ages_s, 0.0) ** 3 / 3.0
    return _root(variances.sum(), len(before))


def _inputs(scenario: Scenario, client: Rows) -> Rows:
    """Rows of the steps whose inputs determine the states from `settle` on."""
    return client[:-1][client["step"][1:] * scenario.control.dt >= scenario.settled_s]


def _root(total: float, count: int) -> float:
    return math.sqrt(total / count) if count else 0.0


def fly_aboard(scenario: Scenario) -> Rows:
    """Fly with the reference aboard, without a network; returns the client's part of the record.

    At each step the vehicle follows a spline of the reference (`shared.law.spline.follow`). Clamp,
    wind and noise are those of a networked flight with this seed.

    Raises ValueError if only the server knows the reference.
    """
    if scenario.reference.shape in UNKNOWN:
        shape = scenario.reference.shape
        raise ValueError(f"reference.shape: {shape!r} is known to the server only")
    terms, vehicle = scenario.terms(), scenario.vehicle
    constants = Constants.of(terms, regulator(scenario))
    flies, navigation = simulated(scenario, 1), Navigation(scenario)
    desired = _due(scenario)
    change_max = math.inf if terms.exhausted == "hold" else vehicle.slew_mps2 * terms.dt_s
    rows = np.zeros(scenario.steps, client_columns(terms.axes))
    rows["step"] = np.arange(scenario.steps)
    rows["covered"], rows["mode"], rows["reason"] = True, Mode.TRACK, Reason.BEGUN
    rows["in_force"] = rows["age_ns"] = NO_HORIZON
    u: Array = np.zeros(terms.axes)
    for k, row in enumerate(rows):
        now_ns = k * terms.dt_ns
        navigation.advance(flies.measurements(now_ns=now_ns), u, now_ns=now_ns)
        spline = SplineFollower(constants, desired[k : k + 2].swapaxes(0, 1), 1, 1)
        wanted, without_feedback = spline.input_at(
            0, navigation.predicted, navigation.disturbance, u
        ).tolist()
        flown = clamped(
            wanted, u.tolist(), terms.u_max, change_max, without_feedback=without_feedback
        )
        assert flown is not None
        u = np.array(flown)
        row["state"], row["measured"] = flies.truth(), navigation.measured
        row["estimate"], row["input"] = navigation.predicted, u
        flies.fly(u)
    return rows


def _due(scenario: Scenario) -> Array:
    """Desired states at the times when inputs take effect, after each axis' dead time [m, m/s];
    shape (steps + 1, axes, 2).
    """
    sample, times_s = scenario.make_reference(), np.arange(scenario.steps + 1) * scenario.control.dt
    late_s = scenario.terms().dead_time_s
    return np.stack([sample(times_s + late)[:, axis] for axis, late in enumerate(late_s)], axis=1)


def summarise_aboard(scenario: Scenario) -> Summary:
    """Summary of `fly_aboard`, with no packets; called in a worker."""
    packets = np.empty(0, PACKET_COLUMNS)
    summary = summarise(scenario, "aboard", fly_aboard(scenario), netem=packets)
    return replace(summary, event_ratio=0.0)


# -- baselines of a case ---------------------------------------------------------------------------

PERIODS = (1, 3, 10, 30)
"""Numbers of steps between two packets for which the floor is computed."""
RUNS = 4


class Floor(msgspec.Struct, frozen=True):
    """Floor of the RMSE for packets that are sent at fixed times, at one rate."""

    packets_per_s: float
    rmse_m: float


@dataclass(frozen=True, slots=True)
class Baselines:
    """Baselines that a comparison shows beside the contenders of a case."""

    floor: Sequence[Floor] = ()
    """Lower bound of the RMSE at several packet rates: for all contenders if only the server sees
    the target; in wind, only for contenders without feedback aboard.
    """
    aboard: Sequence[Summary] = ()
    """Flights with the reference aboard and no packets; none if only the server knows the
    reference.
    """


class Work:
    """Flights for the baselines of a case, and their settings."""

    def __init__(self, plan: Plan) -> None:
        scenario, aboard = plan.tuned(BESIDE), plan.tuned(REGULATED)
        self.regular = {
            period: replace(
                scenario, control=replace(scenario.control, trigger=f"periodic({period})")
            )
            for period in PERIODS
        }
        first, runs = scenario.seed, 0 if _is_unknown(scenario) else plan.runs
        self.aboard = {seed: replace(aboard, seed=seed) for seed in range(first, first + runs)}
        self._tables = scenario, aboard

    def settings(self) -> dict[str, Any]:
        return {
            "files": digests(self._tables),
            "runs": RUNS,
            "scenarios": [reading.to_table(each) for each in self._tables],
        }


def _is_unknown(scenario: Scenario) -> bool:
    return scenario.reference.shape in UNKNOWN


def floor_of(scenario: Scenario) -> Floor:
    """Floor of a scenario, computed from the ages in a few flights; called in a worker."""
    flights = fly_batch(scenario, range(scenario.seed, scenario.seed + RUNS))
    floor_m = target_floor_m if _is_unknown(scenario) else wind_floor_m
    packets = sum(int((flight.netem["direction"] == UPLINK).sum()) for flight in flights)
    floors = [floor_m(scenario, flight.client) for flight in flights]
    return Floor(packets / RUNS / scenario.duration, float(np.mean(floors)))
