"""Check for contradictions in scenarios whose scheme sends horizons of inputs."""

import math
from collections.abc import Iterator

from skytether.shared.law.terms import COMMITTING, INDEXED
from skytether.shared.scenario.schema import Contradiction, Scenario
from skytether.shared.wire.protocol import INPUTS_MAX

TINY = 1e-9
"""Rounding tolerance of a product such as 40 · 0.011."""
LOSSY = 0.3
"""Loss ratio of the uplink above which horizons must be longer."""


def ahead_s(scenario: Scenario) -> float:
    """Time until a new plan is in force [s]: the larger of mean uplink delay and delay bound."""
    control, mean_s = scenario.control, scenario.uplink.mean_s
    if control.properties.flown_as in COMMITTING and control.delay_bound != "auto":
        return max(control.delay_bound, mean_s)
    return mean_s


def too_late(scenario: Scenario) -> Iterator[Contradiction]:
    """Contradictions between the network's delays or losses and horizon, delay bound or step."""
    yield from _too_slow(scenario)
    if scenario.control.properties.flown_as in INDEXED and scenario.vehicle.exhausted == "brake":
        yield from _too_short(scenario)


def _too_slow(scenario: Scenario) -> Iterator[Contradiction]:
    control, axes = scenario.control, scenario.model.axes
    up, down = scenario.uplink, scenario.downlink
    # The server's estimate of the delay: its clock map takes half of the smallest round trip.
    delay_s = up.mean_s - up.least_s + (up.least_s + down.least_s) / 2
    seen = f"the delay of {delay_s:g} s (half of the smallest round trip, and the uplink's jitter)"
    H, dt, bound_s = control.horizon, control.dt, control.delay_bound
    if control.properties.flown_as in COMMITTING:
        if bound_s != "auto" and bound_s < delay_s - TINY:
            yield "control.delay_bound", bound_s, f"at least {seen}"
        steps = max(1, math.ceil((delay_s if bound_s == "auto" else bound_s) / dt - TINY))
        most = INPUTS_MAX // axes - steps
        if most < 1:
            yield "control.dt", dt, f"more, for {seen} to take fewer than {steps} steps"
        if most < H:
            fit = f"at most {most} beside {steps} committed steps with {axes} axes"
            yield "control.horizon", H, f"{fit}, to fit one datagram"
    elif control.properties.flown_as in INDEXED and H * dt < delay_s - TINY:
        yield "control.horizon", H, f"horizon · dt (now {H * dt:g} s) to cover {seen}"


def _too_short(scenario: Scenario) -> Iterator[Contradiction]:
    """Contradiction of a scenario whose horizon is too short for the vehicle to brake."""
    control, vehicle, u_max = scenario.control, scenario.vehicle, max(scenario.model.u_max)
    covered_s, lossy = control.horizon * control.dt, scenario.uplink.loss > LOSSY
    least_s = u_max / vehicle.brake_mps2 * (1.0 if lossy else 0.5)
    if covered_s < least_s - TINY:
        what = "what" if lossy else "half of what"
        lost = f", with over {LOSSY:.0%} of the packets to the vehicle lost" if lossy else ""
        least = f"at least {least_s:g} s, {what} braking from u_max takes{lost}"
        yield (
            "control.horizon",
            control.horizon,
            f"horizon · dt (now {covered_s:g} s) to be {least}",
        )
