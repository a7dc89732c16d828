"""Envelope of a scenario: networks and settings under which it flies, tested at random points.

A point is the scenario with other delays, losses, step, horizon and scheme, drawn from the seed and
the point's number. The outcome is judged from the scenario and the client's record alone. A vehicle
without a planned input since time s, with command u and velocity v at that time, must follow the
braking curve (a: brake_mps2, g: gain):
    |u(t)| ≤ |u| - a (t - s)                                            command
    |p(t) - p(s)| ≤ τ |v| + g (|u|²/2a + |u| Δt)                        distance flown
    |v(t)| ≤ |v| e^(-(t - s)/τ) + g |u| e^(-(t - s - |u|/a - Δt)/τ)     speed

With feedback aboard, the vehicle of a finished horizon is still guided to the point where the plan
itself would stop. That point is further ahead by the vehicle's lag behind the plan. Until the
horizon is dropped, only the second line applies, with the distance from the reference at s and 1 m
added.

The vehicle must always stay within a disc around the reference, enlarged by 1 m and the stopping
distance. It must be near the reference once it flies a plan based on an observation made under
earlier plans.
"""

import math
import shlex
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
import numpy as np

from skytether.figures.tables import to_csv
from skytether.lab.journal import digests
from skytether.shared.base.chance import stream
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array, Flags
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import flat, set_keys
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Rows
from skytether.shared.telemetry.summary import position_error
from skytether.sim import flight

DELAY_MAX_S = 3.0
"""Largest minimum delay of a direction [s]."""
LOSSES_MAX = (0.5, 0.99)
"""Largest loss of a direction; each value applies to half of the points."""
DT_MIN_S, DT_MAX_S = 0.005, 0.5
"""Shortest and longest control step [s]."""
HORIZON_MAX = 120
"""Longest horizon [steps]; the shortest is 1."""
NEAR_M = 1.0
"""Distance up to which a vehicle counts as on the reference [m]."""
SIGMAS = 6.0
"""White wind is assumed to stay within this number of standard deviations."""
ROUNDING = 1e-6
"""Rounding tolerance of a distance [m] or a speed [m/s]."""

Outcome = Literal[
    "flown", "interrupted", "hovering", "unanswered", "refused", "astray", "flyaway", "crashed"
]
"""Outcome of a point; docs/studies.md explains each."""
BAD: tuple[Outcome, ...] = ("crashed", "flyaway")
"""Forbidden outcomes, the worst first."""
WRONG: tuple[Outcome, ...] = (*BAD, "astray")
"""Outcomes that indicate a fault, the worst first."""


def draw(seed: int, number: int) -> dict[str, Any]:
    rng = stream(seed, "envelope", number)
    loss_max = float(rng.choice(LOSSES_MAX))
    keys: dict[str, Any] = {}
    for direction in ("uplink", "downlink"):
        is_constant = rng.choice(("constant", "poisson")) == "constant"
        least_s, loss = _short(rng.uniform(0.0, DELAY_MAX_S)), _short(rng.uniform(0.0, loss_max))
        delay = f"constant({least_s})" if is_constant else f"paper({least_s}, 0.02, 2.0)"
        keys[f"network.{direction}"] = f"{delay} & loss({loss})"
    keys["control.dt"] = _short(DT_MIN_S * (DT_MAX_S / DT_MIN_S) ** rng.random())
    keys["control.horizon"] = int((HORIZON_MAX + 1) ** rng.random())
    keys["control.feedback"] = bool(rng.integers(2))
    keys["vehicle.exhausted"] = "brake"
    keys["seed"] = int(rng.integers(2**32))
    return keys


def _short(value: float) -> float:
    return float(f"{value:.4g}")


class EnvelopePoint(msgspec.Struct, frozen=True):
    outcome: Outcome
    error_max: float | None = None
    """Largest distance from the reference after settling [m]; None if the flight ended before."""
    covered: float | None = None
    """Share of the steps with a planned input; None if no step was flown."""
    outside_m: float | None = None
    """Largest distance from the disc around the reference [m]; 0 within it."""
    line: str = ""
    """Reason why the point was refused, judged unsafe, or ended early."""


@dataclass(frozen=True, slots=True)
class Envelope:
    name: str
    scenario: Scenario

    def settings(self) -> dict[str, Any]:
        files, table = digests([self.scenario]), reading.to_table(self.scenario)
        return {"name": self.name, "files": files, "scenario": table}

    def keys(self, number: int) -> dict[str, Any]:
        keys = draw(self.scenario.seed, number)
        if self.scenario.terms().splines:  # a trajectory requires feedback aboard
            keys["control.feedback"] = True
        return keys

    def _table(self, number: int) -> dict[str, Any]:
        table = reading.to_table(self.scenario)
        set_keys(self.keys(number), table)
        return table

    def scenario_of(self, number: int) -> Scenario:
        return reading.check(self._table(number), self.name)

    def fly(self, number: int) -> EnvelopePoint:
        """Fly a point in virtual time, and judge it; called in a worker."""
        try:
            scenario = self.scenario_of(number)
        except ConfigError as error:
            return EnvelopePoint("refused", line=str(error))
        try:
            flown = flight.fly(scenario)
            verdict = judge(scenario, flown.client)
        except Exception as error:  # an exception of any kind is the outcome of the point
            return EnvelopePoint("crashed", line=f"{type(error).__name__}: {error}")
        line = verdict.line or (str(flown.failure) if flown.failure else "")
        return msgspec.structs.replace(verdict, line=line)

    def command(self, number: int) -> str:
        before = dict(flat(reading.to_table(reading.load(self.name))))
        now = flat(self._table(number))
        changed = ((key, value) for key, value in now if value != before.get(key))
        flags = [word for key, value in changed for word in _flag(key, value)]
        return shlex.join(["skytether", "fly", self.name, "--virtual", *flags])

    def csv(self, points: Iterable[EnvelopePoint]) -> str:
        rows = [
            [number, *self.keys(number).values(), *msgspec.structs.astuple(point)]
            for number, point in enumerate(points)
        ]
        return to_csv(["number", *self.keys(0), *EnvelopePoint.__struct_fields__], rows)


def _flag(key: str, value: Any) -> Iterator[str]:
    section, _, name = key.replace("_", "-").rpartition(".")
    path = f"{section}." if section else ""
    if isinstance(value, bool):
        yield f"--{path}{name}" if value else f"--{path}no-{name}"
    else:
        yield f"--{path}{name}"
        yield from map(str, value if isinstance(value, list | tuple) else [value])


def worst_first(points: Iterable[EnvelopePoint]) -> list[tuple[int, EnvelopePoint]]:
    """Points with a WRONG outcome, with their numbers: crashes, flyaways by distance, then astray
    ones.
    """
    wrong = [(number, point) for number, point in enumerate(points) if point.outcome in WRONG]

    def rank(numbered: tuple[int, EnvelopePoint]) -> tuple[int, float, float]:
        _, point = numbered
        outcome = WRONG.index(point.outcome)
        return outcome, -(point.outside_m or 0.0), -(point.error_max or 0.0)

    return sorted(wrong, key=rank)


def settling_s(scenario: Scenario) -> float:
    """Time that a vehicle may take to reach the reference from anywhere in its disc [s].

    Twice the time across the disc at full speed, because the reference moves meanwhile, plus five
    time constants.
    """
    _, radius_m = disc(scenario)
    across_s = 2.0 * radius_m / float(scenario.u_max.min())
    return 2.0 * across_s + 5.0 * float(scenario.true_tau_s.max())


def disc(scenario: Scenario) -> tuple[Array, float]:
    """Centre [m; shape (axes,)] and radius [m] of a disc or ball around reference and start."""
    times_s = np.arange(scenario.steps) * scenario.control.dt
    points = scenario.make_reference()(times_s)[..., 0]
    if scenario.vehicle.start_m:
        points = np.vstack([points, scenario.vehicle.start_m])
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def judge(scenario: Scenario, client: Rows) -> EnvelopePoint:
    """Outcome of a flight, from the rows of its only vehicle, one for every step."""
    if not len(client):
        return EnvelopePoint("unanswered")
    covered = client["covered"]
    error_m = np.linalg.norm(position_error(scenario, client), axis=1)
    centre, radius_m = disc(scenario)
    outside_m = np.linalg.norm(client["state"][..., 0] - centre, axis=1) - radius_m
    time_s = client["step"] * scenario.control.dt
    first_s = time_s[covered].min(initial=math.inf)
    settled_m = error_m[time_s >= first_s + settling_s(scenario)]
    error_max = float(settled_m.max()) if len(settled_m) else None
    figures = (error_max, float(covered.mean()), max(0.0, float(outside_m.max())))
    faults = list(_faults(scenario, client, error_m, outside_m, radius_m))
    if faults:
        return EnvelopePoint("flyaway", *figures, min(faults)[1])
    if error_max is not None and error_max < NEAR_M:
        return EnvelopePoint("flown", *figures)
    if not covered[-1]:
        return EnvelopePoint("hovering", *figures)
    if error_max is None or not covered[time_s >= first_s].all():
        return EnvelopePoint("interrupted", *figures)
    return EnvelopePoint("astray", *figures)


def _faults(
    scenario: Scenario, client: Rows, error_m: Array, outside_m: Array, radius_m: float
) -> Iterator[tuple[int, str]]:
    """First step that breaks each safety rule, and a sentence about it."""
    vehicle, dt, covered = scenario.vehicle, scenario.control.dt, client["covered"]
    tau_s, brake = float(scenario.true_tau_s.max()), vehicle.brake_mps2
    gain, late_s = float(scenario.true_gain.max()), float(scenario.true_dead_time_s.max())
    top_mps = float(np.linalg.norm(scenario.u_max))
    time_s = client["step"] * dt
    position, velocity = client["state"][..., 0], client["state"][..., 1]
    speed, command = np.linalg.norm(velocity, axis=1), np.linalg.norm(client["input"], axis=1)
    # A finished horizon is still in force: feedback guides the vehicle to where the plan stops.
    guided = ~covered & (client["age_ns"] >= 0) & scenario.control.feedback
    blind = ~covered & ~guided
    begun = _begun(covered, guided)
    since_s = time_s - time_s[begun]
    age_s = client["age_ns"] / SECOND_NS
    # Wind cannot be compensated before it has been observed.
    pushed_m, pushed_mps = _wind(scenario, np.where(covered, np.maximum(0.0, age_s), since_s))
    # With dead time, commands from before `begun` act later: the largest possible one is assumed.
    on_its_way = np.where(late_s > 0.0, top_mps, command[begun])
    stopping_s = on_its_way / brake + dt + late_s

    def stop_m(v: Array | float, u: Array | float) -> Array | float:
        ramp_m = u**2 / (2.0 * brake) + u * (dt + late_s)
        return tau_s * v + gain * ramp_m

    def left(passed_s: Array) -> Array:
        return np.exp(-np.maximum(0.0, passed_s) / tau_s)

    travelled_m = np.linalg.norm(position - position[begun], axis=1)
    # Lag behind the plan, which ends on the reference.
    behind_m = guided * (NEAR_M + error_m[begun])
    curve_mps = speed[begun] * left(since_s)
    curve_mps += gain * on_its_way * left(since_s - stopping_s)
    # Time for which the vehicle had flown plans, at the observation from which the plan in force
    # was made.
    seen_s = np.where(age_s >= 0.0, since_s - age_s, -1.0)
    rules: tuple[tuple[str, Flags, Array, Any], ...] = (
        (
            "its command is {:.3g} m/s without a plan, while braking allows {:.3g} m/s",
            blind,
            command,
            np.maximum(0.0, command[begun] - brake * since_s),
        ),
        (
            "it went {:.3g} m without a plan, while braking takes at most {:.3g} m",
            ~covered,
            travelled_m,
            stop_m(speed[begun], on_its_way) + pushed_m + behind_m,
        ),
        (
            "its speed is {:.3g} m/s without a plan, while braking allows {:.3g} m/s",
            blind,
            speed,
            curve_mps + pushed_mps,
        ),
        (
            "it is {:.3g} m outside the disc around the reference; stopping takes at most {:.3g} m",
            np.ones_like(covered),
            outside_m,
            NEAR_M + stop_m(top_mps * max(1.0, gain), top_mps) + pushed_m,
        ),
        (
            "it is {:.3g} m from the reference; a vehicle at rest would be at most {:.3g} m away",
            covered & (seen_s >= settling_s(scenario)),
            error_m,
            NEAR_M + radius_m + pushed_m,
        ),
    )
    lost = ~np.isfinite(client["state"]).all(axis=(1, 2))
    if lost.any():
        step = int(lost.argmax())
        yield step, f"at {time_s[step]:.2f} s its state is not finite"
    for message, rows, value, most in rules:
        broken = rows & (value > most + ROUNDING)
        if broken.any():
            step = int(broken.argmax())
            yield step, f"at {time_s[step]:.2f} s {message.format(value[step], most[step])}"


def _begun(covered: Flags, guided: Flags) -> Any:
    """Row at which the present stretch of one kind began; shape (steps,).

    A stretch is covered by planned inputs, or follows the feedback alone, or neither.
    """
    rows, kind = np.arange(len(covered)), covered + 2 * guided
    changed = np.concatenate([[True], kind[1:] != kind[:-1]])
    return np.maximum.accumulate(np.where(changed, rows, 0))


def _wind(scenario: Scenario, blind_s: Array) -> tuple[Array, float]:
    """Distance [m] and speed [m/s] that wind may cause within `blind_s`, the time without a
    correction [s].
    """
    vehicle, tau_s = scenario.vehicle, float(scenario.true_tau_s.max())
    blown_mps = float(np.linalg.norm(vehicle.steady_wind_mps)) + tau_s * vehicle.gust_mps2
    white = SIGMAS * vehicle.wind * tau_s
    return blown_mps * blind_s + white * np.sqrt(blind_s), blown_mps + white / math.sqrt(tau_s)
