"""Stability margins: whether a loop is stable over a network, and how far the vehicle may differ
from the model.

The loop is flown in virtual time: vehicle, server and network of a scenario, hovering. There are
two kinds of flights.
    push   only a weak wind for PUSH_S; h(n): mean of p² over seeds and axes, n steps after the wind
           growth = lim h(n+1) / h(n), of the mean square; below 1 the loop is stable
    wind   only the scenario's white wind and noise: root mean square of p and u

The growth is that of the linear loop, so three influences are removed from the deviation p of the
position. Bounds: only steps before an input u reaches SMALL of its bound are used. Noise: the
flight is repeated without the push, and p is the difference of both flights. Thresholds: after a
weak push a trigger that uses the state would never send, so a periodic trigger of the same rate
replaces it. Flights in wind use the scenario's own trigger.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec.structs import replace

from skytether.lab.engine.intervals import interval, jackknife
from skytether.shared.law.model import Array
from skytether.shared.scenario.grammar import leaves
from skytether.shared.scenario.registry import PERIOD_MAX, TRIGGERS
from skytether.shared.scenario.schema import (
    NetworkConfig,
    PathConfig,
    ReferenceConfig,
    SensorConfig,
)
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import AT_BOUND
from skytether.sim.batch import fly_batch

PUSH_S, FOLLOWED_S = 0.25, 24.0
"""Length of a push, and time for which its response is evaluated, six time constants of a typical
disturbance observer [s].
"""
PUSH = 1e-4
"""White acceleration of the push [m/s per √s]: too weak to reach a bound or threshold, and well
above the rounding errors of messages with a noise of some centimetres.
"""
FLOOR = 1e-9
"""A mean square counts as rounding error below this share of the largest mean square."""
SETTLE_S, ROUND_TRIPS = 5.0, 4.0
"""Time before a push: this many seconds, plus this many mean round trips. When the push begins,
sessions are open and the delay bound is stationary.
"""
WIND_S, WIND_BUILDS_S = 60.0, 10.0
"""Time for which the response to wind is evaluated, and build-up time before it [s]."""
SMALL = 0.05
"""A response is evaluated until an input reaches this share of its bound: no bound is active."""
STEPS_MIN = 10
"""Smallest number of steps from which a growth can be estimated."""
WIND_ALONE = 0.1
"""Wind used if the scenario has neither wind nor noise [m/s per √s]."""
CLOCK_ONLY = ("always", "periodic", "silence", "budget")
"""Triggers that do not use the state."""
RATE_RUNS, LIMIT_RUNS = 4, 4
"""Number of seeds for measuring a trigger's rate, and largest number of seeds for a bisection."""
HALVINGS = 7


T = TypeVar("T", NetworkConfig, PathConfig)


def impaired(scenario: Scenario, change: Callable[[str], str]) -> Scenario:
    """Scenario with the impairments of each direction changed, on every path."""

    def changed(each: T) -> T:
        return replace(each, uplink=change(each.uplink), downlink=change(each.downlink))

    network = scenario.network
    several = replace(changed(network), paths=tuple(map(changed, network.paths)))
    return replace(scenario, network=several)


class Differing(NamedTuple):
    tau: float = 1.0
    """Time constants relative to those of the model."""
    gain: float = 1.0
    """Gains of the velocity loop relative to those of the model."""
    dead_time_s: float = 0.0
    """Dead time minus that of the model [s]."""
    delay_s: float = 0.0
    """Delay added to the network's delay in each direction [s]."""

    def is_of(self, scenario: Scenario) -> bool:
        """Whether the vehicle can be simulated: its dead time must not be negative."""
        return min(scenario.terms().dead_time_s) + self.dead_time_s >= 0.0

    def of(self, scenario: Scenario) -> Scenario:
        terms = scenario.terms()
        vehicle = replace(
            scenario.vehicle,
            tau_s=tuple(self.tau * tau_s for tau_s in scenario.model.tau_s),
            gain=tuple(self.gain * gain for gain in terms.gain),
            dead_time_s=tuple(self.dead_time_s + late_s for late_s in terms.dead_time_s),
        )
        if self.delay_s:
            later = f"constant({self.delay_s!r})"
            scenario = impaired(scenario, lambda each: " & ".join(filter(None, (each, later))))
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
"""Vehicles that are flown besides the scenario's own, if they can be simulated."""
LIMITS: dict[str, tuple[str, float, float]] = {
    "time constant, least": ("tau", 1.0, 0.1),
    "time constant, most": ("tau", 1.0, 10.0),
    "gain, least": ("gain", 1.0, 0.1),
    "gain, most": ("gain", 1.0, 10.0),
    "dead time, more [s]": ("dead_time_s", 0.0, 2.0),
    "delay each way, more [s]": ("delay_s", 0.0, 2.0),
}
"""Quantities whose limit is searched for: field of `Differing`, first and last value tried."""


class Margin(msgspec.Struct, frozen=True, kw_only=True):
    vehicle: str
    growth: float
    growth_ci95: float | None
    """Half-width of the growth's 95 % interval over seeds; None for a single seed."""
    stable: bool
    """Whether the upper end of the growth's interval is below 1."""
    rms_m: tuple[float, ...] | None
    """RMS deviation of the position on each axis [m]; None if unstable."""
    rms_ci95_m: tuple[float, ...] | None
    """Half-width of the 95 % interval of `rms_m` [m]; None if unstable, or for a single seed."""
    rms_input_mps: tuple[float, ...] | None
    """RMS input on each axis [m/s]; None if unstable."""
    saturated: float | None
    """Share of the steps with an input at its bound on some axis; None if unstable."""


class MarginLimit(msgspec.Struct, frozen=True, kw_only=True):
    """Largest value of a quantity for which the loop is stable; other quantities do not change."""

    quantity: str
    """Name of the quantity in a table."""
    searched: float
    value: float | None
    """The limit; None if the loop is stable at `searched`, the last value of the search."""


def uses_state(scenario: Scenario) -> bool:
    """Whether the trigger uses the state, and so has a threshold."""
    trigger, splines = TRIGGERS.parse(scenario.control.trigger), scenario.terms().splines
    return not splines and any(each.name not in CLOCK_ONLY for each in leaves(trigger))


def clocked_trigger(scenario: Scenario) -> str:
    """Trigger without a threshold: the scenario's own, or `periodic` at its measured rate."""
    if not uses_state(scenario):
        return scenario.control.trigger
    events = np.concatenate([each.server["event"] for each in _flown(scenario, RATE_RUNS)])
    period = max(1, round(1.0 / max(events.mean(), 1.0 / PERIOD_MAX)))
    return f"periodic({period})"


def hovering(scenario: Scenario, duration: float) -> Scenario:
    """Scenario of a simulated vehicle that hovers at the origin without wind for `duration` [s]."""
    origin = (0.0,) * scenario.model.axes
    vehicle = replace(
        scenario.vehicle,
        kind="simulated",
        start_m=(),
        wind=0.0,
        steady_wind_mps=(),
        gust_mps2=0.0,
    )
    return replace(
        scenario,
        reference=ReferenceConfig(shape="hover", points_m=(origin,)),
        vehicle=vehicle,
        duration=duration,
        settle=0.0,
    )


def settled_s(scenario: Scenario) -> float:
    """Time after which a flight is stationary [s], see SETTLE_S."""
    return SETTLE_S + ROUND_TRIPS * (scenario.uplink.mean_s + scenario.downlink.mean_s)


def _flown(scenario: Scenario, runs: int, **keys: Any) -> list[Record]:
    return fly_batch(scenario, range(scenario.seed, scenario.seed + runs), **keys)


def growth_of(scenario: Scenario, trigger: str, runs: int) -> tuple[float, float | None]:
    """Growth of the mean square after a push, and half-width of its 95 % interval (jackknife).

    The growth is infinite if SMALL is reached within STEPS_MIN, or if there is no session.

    `trigger` comes from `clocked_trigger`.
    """
    h = _responses(scenario, trigger, runs)
    if h.shape[1] < STEPS_MIN:
        return math.inf, None

    def growth(h: Array) -> float:
        return _growth(h.mean(axis=0))

    return (growth(h), None) if runs < 2 else jackknife(growth, h)


def _responses(scenario: Scenario, trigger: str, runs: int) -> Array:
    """Mean squared deviation p² at each step after a push [m²]; shape (runs, steps)."""
    dt, begin_s = scenario.control.dt, settled_s(scenario)
    flown = hovering(scenario, begin_s + FOLLOWED_S)
    flown = replace(
        flown,
        vehicle=replace(flown.vehicle, report="always"),
        control=replace(scenario.control, trigger=trigger),
    )
    push = [(begin_s, {"vehicle.wind": PUSH}), (begin_s + PUSH_S, {"vehicle.wind": 0.0})]
    p, u = _positions_and_inputs(_flown(flown, runs, changes=push))
    if flown.sensor != SensorConfig():
        calm_p, calm_u = _positions_and_inputs(_flown(flown, runs))
        p, u = p - calm_p, u - calm_u
    if not p.any(axis=(1, 2)).all():  # a vehicle had no session at the time of the push
        return np.zeros((runs, 0))
    begins = np.argmax(p.any(axis=2), axis=1) + round(PUSH_S / dt)
    steps = min(round((FOLLOWED_S - 2.0) / dt), p.shape[1] - int(begins.max()))
    p, u = (
        np.array([run[begin : begin + steps] for run, begin in zip(each, begins, strict=True)])
        for each in (p, u)
    )
    large = (np.abs(u) >= SMALL * scenario.u_max).any(axis=(0, 2))
    return (p[:, : int(np.argmax(large)) if large.any() else steps] ** 2).mean(axis=2)


def _positions_and_inputs(flights: Sequence[Record]) -> tuple[Array, Array]:
    steps = min(len(flight.client) for flight in flights)
    return (
        np.array([flight.client["state"][:steps, :, 0] for flight in flights]),
        np.array([flight.client["input"][:steps] for flight in flights]),
    )


def _growth(h: Array) -> float:
    """Growth per step in the later part of a response, by least squares of its logarithm.

    Means over a quarter of the response remove most of slow oscillations.
    """
    (rounded,) = np.nonzero(h < FLOOR * h[:1])
    h = h[: int(rounded[0])] if len(rounded) else h
    width = max(1, len(h) // 4)
    means = np.convolve(h, np.full(width, 1.0 / width), "valid")
    steps = np.arange(len(h) // 3, len(means))
    steps = steps[means[steps] > 0.0]
    if len(steps) < 2:
        return 0.0
    return float(np.exp(np.polyfit(steps, np.log(means[steps]), 1)[0]))


def margin(scenario: Scenario, vehicle: str, trigger: str, runs: int) -> Margin:
    """Margin of a scenario, flown for a number of seeds.

    `trigger` comes from `clocked_trigger`.
    """
    growth, half = growth_of(scenario, trigger, runs)
    if growth + (half or 0.0) >= 1.0:
        none = dict.fromkeys(("rms_m", "rms_ci95_m", "rms_input_mps", "saturated"))
        return Margin(vehicle=vehicle, growth=growth, growth_ci95=half, stable=False, **none)
    # Wind starts at `begin_s`: before its first plan a vehicle would drift far away.
    begin_s = settled_s(scenario)
    wind = [(begin_s, {"vehicle.wind": wind_of(scenario)})]
    flown = hovering(scenario, begin_s + WIND_BUILDS_S + WIND_S)
    counted = round((begin_s + WIND_BUILDS_S) / scenario.control.dt)
    flights = _flown(flown, runs, changes=wind)
    p, u = (each[:, counted:] for each in _positions_and_inputs(flights))
    variances = [interval(axis.tolist()) for axis in (p**2).mean(axis=1).T]
    rms = [math.sqrt(mean or 0.0) for mean, _ in variances]
    halves = [
        0.5 * (half or 0.0) / one if one else 0.0
        for (_, half), one in zip(variances, rms, strict=True)
    ]
    return Margin(
        vehicle=vehicle,
        growth=growth,
        growth_ci95=half,
        stable=True,
        rms_m=tuple(rms),
        rms_ci95_m=tuple(halves) if runs > 1 else None,
        rms_input_mps=tuple(np.sqrt((u**2).mean(axis=(0, 1))).tolist()),
        saturated=float((np.abs(u) >= AT_BOUND * scenario.u_max).any(axis=2).mean()),
    )


def wind_of(scenario: Scenario) -> float:
    noises = scenario.sensor.position_noise_m, scenario.sensor.velocity_noise_mps
    alone = not any(noises) and scenario.vehicle.wind == 0.0
    return WIND_ALONE if alone else scenario.vehicle.wind


def limit(scenario: Scenario, quantity: str, trigger: str, runs: int) -> MarginLimit:
    """Limit of a quantity, by bisection between a stable and an unstable vehicle.

    Args:
        quantity: one of LIMITS.
        trigger: from `clocked_trigger`.
        runs: number of seeds for each value.
    """
    name, near, far = LIMITS[quantity]
    stable_up_to, searched = None, far

    def is_stable(value: float) -> bool:
        differing = Differing(**{name: value}).of(scenario)
        return growth_of(differing, trigger, runs)[0] < 1.0

    if not is_stable(far):
        for _ in range(HALVINGS):
            middle = math.sqrt(near * far) if near else 0.5 * (near + far)
            near, far = (middle, far) if is_stable(middle) else (near, middle)
        stable_up_to = near
    return MarginLimit(quantity=quantity, searched=searched, value=stable_up_to)
