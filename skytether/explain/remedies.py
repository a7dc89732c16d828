"""Remedies: the same flight with other keys over the same network, and flights of other seeds.

The keys depend on the cause: for the network, what is sent, how often and over which paths, the
time-outs and the horizon; for wind, sensors or the model, the observer, the filter or the model. A
remedy may cost packets, or avert a brake but increase the error, so packets and error are shown.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from skytether.explain.cases import Bad, FlightCase, Keys, Setting, Stall, Unit, UsualDelay
from skytether.explain.causes import Cause
from skytether.explain.flying import CaseOutcome, FlyAll
from skytether.explain.moments import Moment, comes_about, error_m
from skytether.explain.units import is_possible
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK
from skytether.shared.telemetry.summary import WORSE
from skytether.shared.wire.protocol import INPUTS_MAX

AS_FLOWN, STANDBY = "as flown", "a standby server"


@dataclass(frozen=True, slots=True)
class Elsewhere:
    """Means over flights of other seeds."""

    flights: int
    brakes: float
    """Number of brakes, landings and faults per flight."""
    error_m: float
    """Largest error of a flight after `settle` [m]."""
    packets_per_s: float


@dataclass(frozen=True, slots=True)
class Remedy:
    """Keys of a remedy, and results of the flight with these keys."""

    name: str
    keys: Keys
    averts: bool
    """Whether the keys avert the moment."""
    brakes: int
    """Number of brakes, landings and faults in the whole flight."""
    error_m: float
    """Largest error during the moment and shortly after it [m]."""
    packets_per_s: float
    """Packet rate of both directions [1/s]."""
    elsewhere: Elsewhere | None = None


def remedies(
    found: Cause, case: FlightCase, moment: Moment, fly_all: FlyAll
) -> tuple[list[Remedy], list[CaseOutcome]]:
    """Fly each remedy; the first result is the explained flight, unchanged."""
    tried = [(AS_FLOWN, Keys()), *possible(found, case)]
    outcomes = fly_all([_with(case, *each) for each in tried])
    flown = [
        Remedy(
            name,
            keys,
            not comes_about(moment, each),
            brakes(each),
            error_m(moment, each),
            each.packets_per_s,
        )
        for (name, keys), each in zip(tried, outcomes, strict=True)
    ]
    return flown, outcomes


def with_others(each: Remedy, case: FlightCase, seeds: Sequence[int], fly_all: FlyAll) -> Remedy:
    """Remedy with its mean number of brakes, mean largest error and mean packet rate over flights
    of the seeds `seeds`, in `elsewhere`.
    """
    scenario, case = case.scenario, _with(case, each.name, each.keys)
    cases = [replace(case, scenario=msgspec.structs.replace(scenario, seed=seed)) for seed in seeds]
    outcomes = fly_all(cases)
    means = (
        float(np.mean([figure(outcome) for outcome in outcomes]))
        for figure in (brakes, lambda one: _largest_m(one, scenario), lambda one: one.packets_per_s)
    )
    return replace(each, elsewhere=Elsewhere(len(outcomes), *means))


def _with(case: FlightCase, name: str, keys: Keys) -> FlightCase:
    """Case of the whole flight with a remedy."""
    return replace(case, keys=keys, standby=case.standby or name == STANDBY, until_s=None)


def brakes(outcome: CaseOutcome) -> int:
    """Number of times that a vehicle began to brake, to land or to stand still."""
    worse = [np.isin(track.mode, WORSE) for track in outcome.tracks]
    return sum(int((each[1:] & ~each[:-1]).sum()) for each in worse)


def _largest_m(outcome: CaseOutcome, scenario: Scenario) -> float:
    errors = [each.error_m[each.step_s >= scenario.settled_s] for each in outcome.tracks]
    return float(max((each.max(initial=0.0) for each in errors), default=np.nan))


def possible(found: Cause, case: FlightCase) -> Iterator[tuple[str, Keys]]:
    """Names and keys of the remedies that change the scenario and can be flown."""
    for name, keys in _listed([part.unit for part in found.parts], case.scenario):
        if case.double and (name == STANDBY or any(key == "network.paths" for key, _ in keys)):
            continue  # a recording has one network only
        if not is_possible(case, keys):
            continue
        if replace(case, keys=keys).flown() != case.scenario or (
            name == STANDBY and not case.standby
        ):
            yield name, keys


def _listed(units: Sequence[Unit], scenario: Scenario) -> Iterator[tuple[str, Keys]]:
    ways = {each.lane[1] for each in units if isinstance(each, Bad)}
    ways |= {each.direction for each in units if isinstance(each, UsualDelay)}
    if not units:  # the cause is the scenario itself
        ways = {UPLINK, DOWNLINK}
    names = [each.name for each in units if isinstance(each, Setting)]
    control, link, paths = scenario.control, scenario.link, scenario.network.paths
    if ways:
        yield _key("link.timeout_s", 2.0 * link.timeout_s)
        yield _key("link.heartbeat_s", round(link.timeout_s / 5.0, 3))
        yield _key("control.horizon", min(INPUTS_MAX, control.horizon * 3 // 2))
        yield from (_key("link.spread", spread) for spread in ("best", "all") if len(paths) > 1)
    if UPLINK in ways:
        yield "every step sent", (("control.trigger", "always"),)
    if DOWNLINK in ways:
        yield "every step reported", (("vehicle.report", "always"),)
    if ways and control.scheme == "trajectory":
        trigger, report = "cost_gap(1.0) | silence(1)", "deviation(0.05) & periodic(4) | silence(1)"
        yield (
            "plans of inputs",
            (
                ("control.scheme", "committed"),
                ("control.trigger", trigger),
                ("vehicle.report", report),
            ),
        )
    if ways and control.scheme != "trajectory":
        trigger = "expected_gap(0.1) | heartbeat"
        keys = ("control.scheme", "trajectory"), ("control.trigger", trigger)
        yield "trajectories", (*keys, ("control.feedback", True))
    if ways and len(paths) < 2:
        network = scenario.paths[0]
        path = {"uplink": network.uplink, "downlink": network.downlink}
        yield "a second link like the first", (("network.paths", [path, path]),)
    if "wind" in names or any("model" in name for name in names):
        yield _key("control.observer_s", 1.0)
        yield _key("control.feedback", value=True)
    if any("sensors" in name for name in names):
        yield _key("sensor.filter", "kalman")
    if any("model" in name for name in names):
        yield "the model identified", _identified(scenario)
    stalled = {each.process for each in units if isinstance(each, Stall)}
    can_stand_by = 3 * (link.fixed_ns or 0) <= seconds_to_ns(link.timeout_s)  # see `client.several`
    if "server" in stalled and can_stand_by:
        yield STANDBY, Keys()
    if stalled:
        yield _key("link.timeout_s", 2.0 * link.timeout_s)


def _key(key: str, value: object) -> tuple[str, Keys]:
    return f"{key} = {value}", ((key, value),)


def _identified(scenario: Scenario) -> Keys:
    """Keys that make the model equal to the vehicle."""
    true = {
        "tau_s": scenario.true_tau_s,
        "gain": scenario.true_gain,
        "dead_time_s": scenario.true_dead_time_s,
    }
    return tuple((f"model.{name}", each.tolist()) for name, each in true.items())
