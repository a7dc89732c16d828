"""Margins: stability of a loop over a bad network, and how far the vehicle may differ.

While no bound is active the loop is linear for a given timing (`lab.linear`), and with triggers
that use only the clock the timing depends on the network alone: so it is taken from flights in
virtual time. With h(n) the mean of p² n steps after a push of strength 1, over pushes and timings,

    variance of p  =  strength² · Σ h(n)              under white wind or noise, once it is settled
    growth         =  lim h(n+1) / h(n)               of the second moment, at each step

and the loop is stable in the mean square where the growth is below 1. The vehicle that is pushed
may differ from the model that the server plans with.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from scipy import stats

from skytether.lab.linear import WIND, Loop, Timing
from skytether.lab.loops import make_loops, no_packets, respond, timing_of
from skytether.lab.sweep import interval
from skytether.shared.law.model import Array
from skytether.shared.scenario import policies
from skytether.shared.scenario.schema import ReferenceConfig, Scenario, SensorConfig
from skytether.sim.flight import fly_batch

FLIGHT_S = 80.0
"""Length of the flights that timings are taken from [s]."""
SETTLE_S = 5.0
"""Time after which a flight's session and delay bound are stationary [s]."""
FOLLOWED_S = 24.0
"""Time for which a push is followed [s]: six time constants of a typical disturbance observer."""
PUSHES = 64
"""Number of pushes of each source simulated at once."""
WIND_ALONE = 0.1
"""Wind for which the error is computed if a scenario has neither wind nor noise."""
CLOCK_ONLY = ("always", "periodic", "silence", "budget")
"""Policies that do not look at the state."""
RATE_RUNS = 4
"""Number of flights from which the rate of a trigger is measured."""


class Margin(msgspec.Struct, frozen=True, kw_only=True):
    """Results for a loop whose vehicle equals, or differs from, the model."""

    vehicle: str
    """Name of the vehicle in a table."""
    growth: float
    """Growth of the second moment per step."""
    growth_ci95: float | None
    """Half-width of the growth's 95 % interval over timings; None for a single timing."""
    stable: bool
    """Whether the upper end of the growth's interval is below 1."""
    rms_m: tuple[float, ...] | None
    """Root mean square of the position's deviation, of each axis [m]; None if unstable."""
    rms_ci95_m: tuple[float, ...] | None
    """Half-width of the 95 % interval of `rms_m`; None if unstable, or for a single timing."""
    rms_input_mps: tuple[float, ...] | None
    """Root mean square of the input's deviation, of each axis [m/s]; None if unstable."""

    def saturated(self, u_max: Sequence[float]) -> float | None:
        """Share of the steps at which a normally distributed input would exceed its bound."""
        if self.rms_input_mps is None:
            return None
        beyond = [
            math.erfc(bound / (rms * math.sqrt(2.0))) if rms else 0.0
            for bound, rms in zip(u_max, self.rms_input_mps, strict=True)
        ]
        return 1.0 - math.prod(1.0 - share for share in beyond)


class Differing(NamedTuple):
    """Differences of a vehicle from the model."""

    tau: float = 1.0
    """Time constants over those of the model."""
    gain: float = 1.0
    """Gains of the velocity loop over those of the model."""
    dead_time_s: float = 0.0
    """Dead time minus that of the model [s]."""

    def is_of(self, scenario: Scenario) -> bool:
        """Whether such a vehicle exists: its dead time must not be negative."""
        return min(scenario.terms().dead_time_s) + self.dead_time_s >= 0.0

    def of(self, scenario: Scenario) -> Scenario:
        """Scenario with such a vehicle."""
        terms = scenario.terms()
        vehicle = replace(
            scenario.vehicle,
            tau_s=tuple(self.tau * tau_s for tau_s in scenario.model.tau_s),
            gain=tuple(self.gain * gain for gain in terms.gain),
            dead_time_s=tuple(self.dead_time_s + late_s for late_s in terms.dead_time_s),
        )
        return replace(scenario, vehicle=vehicle)


AS_IT_IS = "as the scenario has it"
VEHICLES: dict[str, Differing] = {
    "the model": Differing(),
    "twice as quick": Differing(tau=0.5),
    "half as quick": Differing(tau=2.0),
    "gain 0.7": Differing(gain=0.7),
    "gain 1.3": Differing(gain=1.3),
    "dead time 0.2 s less": Differing(dead_time_s=-0.2),
    "dead time 0.1 s less": Differing(dead_time_s=-0.1),
    "dead time 0.1 s more": Differing(dead_time_s=0.1),
    "dead time 0.2 s more": Differing(dead_time_s=0.2),
    "dead time 0.3 s more": Differing(dead_time_s=0.3),
}
"""Vehicles for which margins are computed besides the scenario's own, if they exist."""


def looks_at_state(scenario: Scenario) -> bool:
    """Whether the trigger looks at the state, so that the loop is not linear."""
    trigger, splines = policies.parse(scenario.control.trigger), scenario.terms().splines
    return not splines and any(each.name not in CLOCK_ONLY for each in policies.policies(trigger))


def equivalent_period(
    scenario: Scenario, *, stopped: Callable[[], bool] = lambda: False
) -> Scenario:
    """Scenario with the policy `periodic`, at the measured rate of its own trigger."""
    seeds = range(scenario.seed, scenario.seed + RATE_RUNS)
    flights = fly_batch(scenario, seeds, stopped=stopped)
    events = np.concatenate([flight.server["event"] for flight in flights])
    period = max(1, round(1.0 / max(events.mean(), 1.0 / policies.PERIOD_MAX)))
    return replace(scenario, control=replace(scenario.control, trigger=f"periodic({period})"))


def hovering(scenario: Scenario) -> Scenario:
    """Scenario with a hover point in place of its reference."""
    point = (0.0,) * scenario.model.axes
    return replace(scenario, reference=ReferenceConfig(shape="hover", points_m=(point,)))


def calm(scenario: Scenario) -> Scenario:
    """Scenario for measuring timings: the vehicle equals the model, and is at rest.

    The omitted parts do not affect packet timing, with one exception: reports that depend on the
    state are replaced by reports at every step.
    """
    vehicle = replace(
        scenario.vehicle,
        report="always",
        tau_s=(),
        gain=(),
        dead_time_s=(),
        start_m=(),
        wind=0.0,
        steady_wind_mps=(),
        gust_mps2=0.0,
    )
    duration = max(FLIGHT_S, 10 * scenario.control.horizon * scenario.control.dt)
    still = replace(hovering(scenario), vehicle=vehicle, sensor=SensorConfig())
    return replace(still, duration=duration, settle=0.0)


def timings(
    scenario: Scenario, runs: int, *, stopped: Callable[[], bool] = lambda: False
) -> list[Timing]:
    """Timings of a number of flights, with seeds that count up from the scenario's."""
    flown = calm(scenario)
    if flown.terms().splines:  # the vehicle flies the reference aboard, whatever arrives
        return [no_packets(flown.steps)] * runs
    seeds = range(flown.seed, flown.seed + runs)
    return [timing_of(flight) for flight in fly_batch(flown, seeds, stopped=stopped)]


@lru_cache(maxsize=4)
def _known_timings(still: Scenario, runs: int) -> list[Timing]:
    """Timings, see `timings`, of a scenario that is calm already."""
    return timings(still, runs)


def growth_of(scenario: Scenario, runs: int, pushes: int) -> tuple[float, float | None]:
    """Growth of a scenario along some timings, and half-width of its 95 % interval.

    Args:
        pushes: see PUSHES.
    """
    given = _known_timings(calm(scenario), runs)
    known = _responses_of_axes(scenario, given, pushes)
    return max((each.growth() for each in known.values()), key=lambda pair: pair[0])


def margin(scenario: Scenario, vehicle: str, given: Sequence[Timing]) -> Margin:
    """Margin of a scenario along some timings.

    Args:
        vehicle: name of the scenario's vehicle.
    """
    known = _responses_of_axes(scenario, given, PUSHES)
    growth, half = max((each.growth() for each in known.values()), key=lambda pair: pair[0])
    stable = growth + (half or 0.0) < 1.0
    settled = [known[kind].rms(scenario) for kind in _kinds(scenario) if stable]
    return Margin(
        vehicle=vehicle,
        growth=growth,
        growth_ci95=half,
        stable=stable,
        rms_m=tuple(each[0] for each in settled) if stable else None,
        rms_ci95_m=tuple(each[1] for each in settled) if stable and len(given) > 1 else None,
        rms_input_mps=tuple(each[2] for each in settled) if stable else None,
    )


def _kinds(scenario: Scenario) -> list[tuple[float, ...]]:
    """Time constant, gain and dead time of the model and of the vehicle, of each axis.

    Equal axes share one entry.
    """
    terms, true = scenario.terms(), (scenario.true_tau_s, scenario.true_gain)
    numbers = (terms.tau_s, terms.gain, terms.dead_time_s, *true, scenario.true_dead_time_s)
    return list(zip(*numbers, strict=True))


def _responses_of_axes(
    scenario: Scenario, given: Sequence[Timing], pushes: int
) -> "dict[tuple[float, ...], Responses]":
    """Responses of each distinct kind of axis."""
    steps = max(len(timing.in_force) for timing in given)
    loops = dict(zip(_kinds(scenario), make_loops(scenario, steps), strict=True))
    return {kind: responses(scenario, loop, given, pushes) for kind, loop in loops.items()}


class Responses(NamedTuple):
    """Mean squares of position and input by number of steps after a push of strength 1."""

    squares: Array
    """Shape (timings, 2, sources, window)."""

    def growth(self) -> tuple[float, float | None]:
        """Growth of the second moment, and half-width of its 95 % interval (jackknife)."""
        h = self.squares[:, 0, :WIND].sum(axis=1)
        n, mean = len(h), _growth(h.mean(axis=0))
        if n < 2:
            return mean, None
        others = np.array([_growth(np.delete(h, i, axis=0).mean(axis=0)) for i in range(n)])
        error = math.sqrt((n - 1) * others.var())
        return mean, float(stats.t.ppf(0.975, n - 1)) * error

    def rms(self, scenario: Scenario) -> tuple[float, float, float]:
        """Root mean square of the position, half of its 95 % interval, and that of the input."""
        wind, noises = strengths(scenario)
        sources = np.array([wind, wind, *noises])[: self.squares.shape[2]]
        each = np.einsum("tqsn,s->tq", self.squares, sources**2)
        # Beyond the simulated window, the response is extrapolated with its decay.
        growth, _ = self.growth()
        each += np.einsum("tqs,s->tq", self.squares[..., -1], sources**2) * growth / (1.0 - growth)
        variance, half = interval(each[:, 0].tolist())
        rms = math.sqrt(variance or 0.0)
        rms_input = math.sqrt(each[:, 1].mean())
        return rms, 0.5 * half / rms if half and rms else 0.0, rms_input


def _growth(h: Array) -> float:
    """Growth per step in the later part of a response, by least squares of its logarithm.

    Averaging over quarters of the response removes most of slow oscillations.
    """
    width = max(1, len(h) // 4)
    means = np.convolve(h, np.full(width, 1.0 / width), "valid")
    steps = np.arange(len(h) // 3, len(means))
    steps = steps[means[steps] > 0.0]
    if len(steps) < 2:
        return 0.0
    return float(np.exp(np.polyfit(steps, np.log(means[steps]), 1)[0]))


def strengths(scenario: Scenario) -> tuple[float, tuple[float, float]]:
    """White wind, and standard deviations of the noise, for which the error is computed."""
    sensor = scenario.sensor
    noises = (sensor.position_noise_m, sensor.velocity_noise_mps)
    alone = not any(noises) and scenario.vehicle.wind == 0.0
    return WIND_ALONE if alone else scenario.vehicle.wind, noises


def responses(scenario: Scenario, loop: Loop, given: Sequence[Timing], pushes: int) -> Responses:
    """Responses to pushes along each timing, simulated a number per source at once."""
    dt = scenario.control.dt
    begin, window = round(SETTLE_S / dt), max(round(FOLLOWED_S / dt), 2)
    each = []
    for timing in given:
        window = max(2, min(window, (len(timing.in_force) - begin) // 2))
        squares, counts = respond(scenario, loop, timing, begin, window, min(pushes, window))
        each.append(squares / np.maximum(counts, 1))
    return Responses(np.array(each))
