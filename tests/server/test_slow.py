"""Networks that are slow, or become slower in flight: flown as long as possible, then hovered
through.

Delays are functions of the time since the first packet. Safeguards are switched off one by one to
show that the vehicle then leaves the figure.
"""

from collections.abc import Callable, Sequence
from functools import cache
from itertools import product
from typing import Any

import msgspec
import numpy as np
import pytest

import skytether.netem.emulator
from skytether.client.compensator import Compensator
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import Impairments
from skytether.netem.impairments.draws import SLOT_NS, Fate
from skytether.server.planning.clock import ClockMap, Contradiction
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import (
    Finished,
    ModeChanged,
    NotFlown,
    PlanningResumed,
    PlanningStopped,
)
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire.protocol import Idle
from skytether.sim.batch import fly_batch
from skytether.sim.flight import fly

Delay = Callable[[float], float]
"""Delay of a packet [s], by the time since the first packet [s]."""

TIGHT = {"feedback": False, "input_weight": 0.01, "input_reference": False}
"""Keys for committed inputs without feedback, at tight weights."""
OUTSIDE_M = 3.2
"""Largest allowed distance from the centre of the figure eight of 2 m [m]."""


def scenario(
    uplink_s: float = 0.05, downlink_s: float = 0.05, *, duration: float = 40.0, **sections: Any
) -> Scenario:
    table = reading.to_table(reading.load("demo-committed")) | {"duration": duration}
    table["control"] |= TIGHT
    table["vehicle"] |= {"wind": 0.0, "report": "always"}
    for direction, delay_s in (("uplink", uplink_s), ("downlink", downlink_s)):
        table["network"][direction] = f"constant({delay_s}) & loss(0.1)"
    for section, values in sections.items():
        table[section] |= values
    return reading.check(table, "test")


def fly_over(flown: Scenario, delays: Sequence[tuple[Delay, Delay]]) -> list[Record]:
    """Flight over each pair of delays, up and down, that change with time, without loss."""

    class Clocked(Fates):
        """Fates as functions of the time, by the seed of the flight."""

        def __init__(
            self, direction: Impairments, seed: int, name: str, flow: int, **how: bool
        ) -> None:
            super().__init__(direction, seed, name, flow, **how)
            self._delay = delays[seed][name != "uplink"]

        def at(self, slot: int, rank: int = 0) -> Fate:  # noqa: ARG002
            return Fate(delay_ns=round(self._delay(slot * SLOT_NS / SECOND_NS) * SECOND_NS))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(skytether.netem.emulator, "Fates", Clocked)
        return fly_batch(flown, range(len(delays)))


def far_m(flight: Record) -> float:
    return float(np.linalg.norm(flight.client["state"][:, :, 0], axis=1).max())


# -- constant delays -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("uplink_s", "downlink_s", "error_m"), [(0.05, 1.5, 0.3), (1.5, 0.05, 0.3)]
)
def test_a_round_trip_much_longer_than_the_horizon_is_flown(
    uplink_s: float, downlink_s: float, error_m: float
) -> None:
    """1.55 s with a horizon of 0.4 s, one packet in ten lost, in wind: 42 m off without d > H."""
    control = {"dt": 0.02, "horizon": 20}
    flown = scenario(uplink_s, downlink_s, control=control, vehicle={"wind": 0.05})
    # Flown after a second of good link, a heartbeat's delay, and a round trip.
    flown = msgspec.structs.replace(flown, settle=10.0, duration=15.0)
    flight = fly(flown)
    assert flight.failure is None
    error = summarise(flown, "test", flight.client).error_max
    assert error < error_m


# -- growing delays --------------------------------------------------------------------------------


def short(_: float) -> float:
    return 0.05


GROWING: dict[str, Delay] = {
    "slowly": lambda t: 0.05 + max(0.0, t - 4.0) * 0.1,
    "fast": lambda t: 0.05 + max(0.0, t - 4.0) * 0.3,
    "to 1.4 s": lambda t: 0.05 if t < 8.0 else 1.4,
    "to 2.8 s": lambda t: 0.05 if t < 8.0 else 2.8,
    "to 6 s": lambda t: 0.05 if t < 8.0 else 6.0,
}
"""Delays that grow from 0.05 s."""


def ways(side: str, delay: Delay) -> tuple[Delay, Delay]:
    """Delays of uplink and downlink, of which one or both grow."""
    return delay if side != "downlink" else short, delay if side != "uplink" else short


SIDES = ("uplink", "downlink", "both")
FIRM = {"feedback": True, "input_weight": 1.0, "input_reference": True}


@cache
def growing_flights(dt: float, horizon: int, *, feedback: bool) -> dict[tuple[str, str], Record]:
    flown = scenario(control={**(FIRM if feedback else TIGHT), "dt": dt, "horizon": horizon})
    names = list(product(GROWING, SIDES))
    flights = fly_over(flown, [ways(side, GROWING[growing]) for growing, side in names])
    return dict(zip(names, flights, strict=True))


@pytest.mark.long
@pytest.mark.parametrize(("dt", "horizon", "feedback"), [(0.02, 20, False), (0.05, 40, True)])
def test_a_delay_that_grows_in_flight_ends_in_hover_or_is_flown(
    dt: float, horizon: int, *, feedback: bool
) -> None:
    for flight in growing_flights(dt, horizon, feedback=feedback).values():
        assert_hovers_or_flies(flight)


def test_a_delay_that_grows_fast_or_at_once_ends_in_hover_or_is_flown() -> None:
    flown = scenario(control={"dt": 0.02, "horizon": 20}, duration=30.0)
    for flight in fly_over(flown, [ways("both", GROWING[name]) for name in ("fast", "to 6 s")]):
        assert_hovers_or_flies(flight)
        assert flight.failure is not None


def assert_hovers_or_flies(flight: Record) -> None:
    assert far_m(flight) < OUTSIDE_M
    if flight.failure is None:
        assert isinstance(flight.events[-1].event, Finished)
        return
    assert isinstance(flight.failure, NotFlown)
    assert np.abs(flight.client["state"][-1, :, 1]).max() < 0.01
    said = [(host.split()[0], event) for _, host, event in flight.events]
    here = [event for host, event in said if host == "client" and isinstance(event, ModeChanged)]
    there = [event for host, event in said if host == "server"]
    assert here[-1].after == "hover"
    assert flight.failure.why in (Idle.DELAY.text, Idle.OBSERVATION.text, SILENT)
    assert isinstance(there[-1], PlanningStopped)
    assert there[-1].why in (Idle.DELAY.text, Idle.OBSERVATION.text)


SILENT = "the server is silent"


@pytest.mark.long
def test_a_delay_that_comes_and_goes_is_flown_again() -> None:
    flown = scenario(control={"dt": 0.02, "horizon": 20})
    (flight,) = fly_over(flown, [(short, lambda t: 6.0 if 8.0 < t < 18.0 else 0.05)])
    assert flight.failure is None
    said = [event for _, _, event in flight.events]
    changes = [event.after for event in said if isinstance(event, ModeChanged)]
    assert changes[:5] == ["sync", "ready", "track", "brake", "hover"]
    assert changes[-1] == "track"
    assert {PlanningStopped, PlanningResumed} <= {type(event) for event in said}
    assert far_m(flight) < OUTSIDE_M
    assert summarise(flown, "test", flight.client).steps == 2000
    assert flight.client["covered"][-500:].all()


# -- ablations of safeguards -----------------------------------------------------------------------


def forget_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ablation: a horizon is accepted however late it arrives."""
    monkeypatch.setattr(Compensator, "_comes_too_late", lambda *_: False)


def forget_echoes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ablation: the present delay is unknown: no `raise_to`, no `Idle.DELAY`."""
    observe = ClockMap.observe

    def deaf(self: ClockMap, row: int, *ways_ns: int, heard: int, **told: Any) -> Contradiction:
        return observe(self, row, *ways_ns, heard=0 * heard, **told)

    monkeypatch.setattr(ClockMap, "observe", deaf)


def far_slowly_m(side: str, duration: float) -> float:
    """Largest distance of a flight at TIGHT weights over delays that grow slowly [m]."""
    flown = scenario(duration=duration, control={"dt": 0.02, "horizon": 20})
    (flight,) = fly_over(flown, [ways(side, GROWING["slowly"])])
    return far_m(flight)


def test_without_a_bound_on_lateness_it_flies_away(monkeypatch: pytest.MonkeyPatch) -> None:
    assert far_slowly_m("both", 25.0) < OUTSIDE_M
    forget_late(monkeypatch)
    assert far_slowly_m("both", 25.0) > 2 * OUTSIDE_M


@pytest.mark.long
def test_without_echoes_a_longer_delay_is_never_flown_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All horizons are too late then, so no acknowledgement raises d."""
    known = growing_flights(0.02, 20, feedback=False)
    forget_echoes(monkeypatch)
    flown = scenario(control={"dt": 0.02, "horizon": 20})
    longer = [*product(("to 1.4 s", "to 2.8 s"), ("uplink", "downlink"))]
    deaf = fly_over(flown, [ways(side, GROWING[growing]) for growing, side in longer])
    for name, flight in zip(longer, deaf, strict=True):
        covered, known_covered = (each.client["covered"][-250:] for each in (flight, known[name]))
        assert known_covered.mean() > covered.mean() + 0.9, name
        assert flight.failure is not None, name


@pytest.mark.long
def test_without_echoes_and_bound_on_lateness_it_flies_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    forget_late(monkeypatch)
    forget_echoes(monkeypatch)
    assert far_slowly_m("downlink", 54.0) > 2 * OUTSIDE_M
