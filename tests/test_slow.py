"""Networks that are slow, or get slower in flight: flown while they can be, hovered through then.

Delays are given by hand, as functions of the time since the first packet. Safeguards are switched
off one after the other to show that the flight leaves without them.
"""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

import netem.proxy
from client.compensator import Compensator
from netem.fate import SLOT_NS, Fate, Fates
from server.clock import ClockMap
from shared import config
from shared.config import DirectionConfig, Scenario
from shared.endpoint import SECOND_NS
from shared.events import (
    Finished,
    ModeChanged,
    NotFlown,
    PlanningResumed,
    PlanningStopped,
)
from shared.protocol import IDLE_TEXTS, Idle
from shared.summary import summarise
from sim.flight import Flight, fly

Delay = Callable[[float], float]
"""Delay of a packet [s], by the time since the first [s]."""

TIGHT = {"feedback": False, "input_weight": 0.01, "input_reference": False}
"""Keys of committed inputs alone, at weights that answer all at once."""
OUTSIDE_M = 3.2
"""How far from the centre of the figure eight, of 2 m, a vehicle may get."""


def scenario(
    uplink_s: float = 0.05, downlink_s: float = 0.05, *, duration: float = 60.0, **sections: Any
) -> Scenario:
    """A figure eight in calm air at TIGHT weights over constant delays; sections are laid over."""
    table = config.to_table(config.load("demo")) | {"duration": duration}
    table["control"] |= TIGHT
    table["vehicle"]["wind"] = 0.0
    for direction, delay_s in (("uplink", uplink_s), ("downlink", downlink_s)):
        table["network"][direction] |= {"delay": "constant", "minimum_s": delay_s}
    for section, values in sections.items():
        table[section] |= values
    return config.check(table, "test")


def fly_over(
    monkeypatch: pytest.MonkeyPatch, flown: Scenario, uplink: Delay, downlink: Delay
) -> Flight:
    """A flight over delays that change with time, without loss."""

    class Clocked(Fates):
        """Fates that are functions of the time."""

        def __init__(self, direction: DirectionConfig, seed: int, name: str, flow: int) -> None:
            super().__init__(direction, seed, name, flow)
            self._delay = uplink if name == "uplink" else downlink

        def at(self, slot: int, rank: int = 0) -> Fate:  # noqa: ARG002
            """See `Fates`."""
            return Fate(round(self._delay(slot * SLOT_NS / SECOND_NS) * SECOND_NS), False)

    monkeypatch.setattr(netem.proxy, "Fates", Clocked)
    return fly(flown)


def far_m(flight: Flight) -> float:
    """Largest distance from the centre of the figure eight [m]."""
    return float(np.linalg.norm(flight.client["state"][:, :, 0], axis=1).max())


# -- delays that are known before ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("uplink_s", "downlink_s", "error_m"), [(0.05, 1.5, 0.3), (1.5, 0.05, 0.3)]
)
def test_a_round_trip_much_longer_than_the_horizon_is_flown(
    uplink_s: float, downlink_s: float, error_m: float
) -> None:
    """1.55 s with a horizon of 0.4 s, one packet in ten lost, in wind: 42 m off without d > H."""
    control = {"dt": 0.02, "horizon": 20}
    flown = scenario(uplink_s, downlink_s, duration=40.0, control=control, vehicle={"wind": 0.05})
    # It is flown after a second of good link, a heartbeat's trip later, and then a round trip.
    flown = msgspec.structs.replace(flown, settle=10.0)
    flight = fly(flown)
    assert flight.failure is None
    error = summarise(flown, "test", flight.client).error_max
    assert error is not None
    assert error < error_m


# -- delays that grow in flight --------------------------------------------------------------------


def short(_: float) -> float:
    """A delay that stays."""
    return 0.05


GROWING: dict[str, Delay] = {
    "slowly": lambda t: 0.05 + max(0.0, t - 10.0) * 0.1,
    "fast": lambda t: 0.05 + max(0.0, t - 10.0) * 0.3,
    "to 1.4 s": lambda t: 0.05 if t < 15.0 else 1.4,
    "to 2.8 s": lambda t: 0.05 if t < 15.0 else 2.8,
    "to 6 s": lambda t: 0.05 if t < 15.0 else 6.0,
}
"""Delays that grow from 0.05 s."""


def ways(side: str, delay: Delay) -> tuple[Delay, Delay]:
    """Delay of the uplink and of the downlink, of which one or both grow."""
    return delay if side != "downlink" else short, delay if side != "uplink" else short


@pytest.mark.parametrize("side", ["uplink", "downlink", "both"])
@pytest.mark.parametrize("growing", GROWING)
@pytest.mark.parametrize(("dt", "horizon"), [(0.02, 20), (0.05, 40)])
@pytest.mark.parametrize("feedback", [False, True])
def test_a_delay_that_grows_in_flight_ends_in_hover_or_is_flown(
    dt: float,
    horizon: int,
    growing: str,
    side: str,
    monkeypatch: pytest.MonkeyPatch,
    *,
    feedback: bool,
) -> None:
    """Nothing flies away; where a flight ends without a plan, both ends have said why."""
    keys = {"feedback": True, "input_weight": 1.0, "input_reference": True} if feedback else TIGHT
    flown = scenario(control={**keys, "dt": dt, "horizon": horizon})
    flight = fly_over(monkeypatch, flown, *ways(side, GROWING[growing]))
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
    assert flight.failure.why in (IDLE_TEXTS[Idle.DELAY], IDLE_TEXTS[Idle.OBSERVATION], SILENT)
    assert isinstance(there[-1], PlanningStopped)
    assert there[-1].why in (IDLE_TEXTS[Idle.DELAY], IDLE_TEXTS[Idle.OBSERVATION])


SILENT = "the server is silent"


def test_a_delay_that_comes_and_goes_is_flown_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six seconds for ten: hover, then the plan goes on, and the flight is one to the end."""
    flown = scenario(control={"dt": 0.02, "horizon": 20})
    flight = fly_over(monkeypatch, flown, short, lambda t: 6.0 if 15.0 < t < 25.0 else 0.05)
    assert flight.failure is None
    said = [event for _, _, event in flight.events]
    changes = [event.after for event in said if isinstance(event, ModeChanged)]
    assert changes[:5] == ["sync", "ready", "track", "brake", "hover"]
    assert changes[-1] == "track"
    assert {PlanningStopped, PlanningResumed} <= {type(event) for event in said}
    assert far_m(flight) < OUTSIDE_M
    assert summarise(flown, "test", flight.client).steps == 3000
    assert flight.client["covered"][-500:].all()


# -- without its safeguards ------------------------------------------------------------------------


def forget_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ablation: a horizon is taken however late it comes."""
    monkeypatch.setattr(Compensator, "_comes_too_late", lambda *_: False)


def forget_echoes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ablation: what every packet takes just now is not known: no `at_least`, no `Idle.DELAY`."""
    observe = ClockMap.observe

    def deaf(
        self: ClockMap, row: int, forward_ns: int, backward_ns: int, *, echo_ns: int, now_ns: int
    ) -> None:
        observe(self, row, forward_ns, backward_ns, echo_ns=0 * echo_ns, now_ns=now_ns)

    monkeypatch.setattr(ClockMap, "observe", deaf)


@pytest.mark.parametrize(("growing", "side"), [("slowly", "uplink"), ("slowly", "both")])
def test_without_a_bound_on_lateness_it_flies_away(
    growing: str, side: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Horizons that come after other inputs were flown make the plans swing."""
    forget_late(monkeypatch)
    flown = scenario(control={"dt": 0.02, "horizon": 20})
    assert far_m(fly_over(monkeypatch, flown, *ways(side, GROWING[growing]))) > 2 * OUTSIDE_M


@pytest.mark.parametrize("growing", ["to 1.4 s", "to 2.8 s"])
@pytest.mark.parametrize("side", ["uplink", "downlink"])
def test_without_echoes_a_longer_delay_is_never_flown_again(
    growing: str, side: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All horizons are too late then, and so nothing is acknowledged that could raise d."""
    covered = []
    for without in (False, True):
        if without:
            forget_echoes(monkeypatch)
        flown = scenario(control={"dt": 0.02, "horizon": 20})
        flight = fly_over(monkeypatch, flown, *ways(side, GROWING[growing]))
        covered.append(flight.client["covered"].mean())
    assert covered[0] > covered[1] + 0.25
    assert flight.failure is not None


@pytest.mark.parametrize(("growing", "side"), [("slowly", "downlink"), ("slowly", "both")])
def test_without_echoes_and_bound_on_lateness_it_flies_away(
    growing: str, side: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where only observations are delayed."""
    forget_late(monkeypatch)
    forget_echoes(monkeypatch)
    flown = scenario(control={"dt": 0.02, "horizon": 20})
    assert far_m(fly_over(monkeypatch, flown, *ways(side, GROWING[growing]))) > 2 * OUTSIDE_M
