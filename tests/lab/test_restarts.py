"""Restarts in flight: evaluation of a record, and a short flight."""

from dataclasses import replace

import numpy as np
import pytest

from bench import restarts
from bench.restarts import (
    CLOSED,
    KILLED,
    STOPPED,
    ProcessLife,
    ProcessOutage,
    RestartsCounts,
    judge,
)
from skytether.shared.base.units import SECOND_NS
from skytether.shared.wire.protocol import Mode

pytestmark = pytest.mark.long

DT_S = 0.05
TAU_S = 0.84
GONE = ProcessOutage("server", CLOSED, 10 * SECOND_NS, 14 * SECOND_NS)


def life(brakes_s: float = 1.0, flies_s: float = 1.5, brake_mps2: float = 2.0) -> ProcessLife:
    """Flight of 20 s at 1 m/s that brakes some time after 10 s and flies again after 14 s."""
    time_s = np.arange(400) * DT_S
    at, again = 10.0 + brakes_s, 14.0 + flies_s
    gone = (time_s >= at) & (time_s < again)
    commanded = np.where(gone, np.maximum(0.0, 1.0 - brake_mps2 * (time_s - at)), 1.0)
    speed = np.empty_like(commanded)
    speed[0] = 1.0
    for i in range(len(speed) - 1):
        speed[i + 1] = commanded[i] + (speed[i] - commanded[i]) * np.exp(-DT_S / TAU_S)
    return ProcessLife(
        np.round(time_s * SECOND_NS).astype(np.int64),
        commanded,
        speed,
        np.where(gone, 1.0, 0.1),
        np.where(gone, -1, np.arange(400)),
        np.where(gone, Mode.BRAKE, Mode.TRACK).astype(np.uint8),
    )


def verdict(flown: ProcessLife, outage: ProcessOutage = GONE) -> restarts.RestartVerdict:
    return judge(outage, [flown], restarts.scenario())


def test_a_vehicle_that_brakes_in_time_is_inside() -> None:
    """On both curves; each time is counted from the moment at which the action is due."""
    found = verdict(life())
    assert found.is_inside
    assert found.brakes_s == pytest.approx(1.0)
    assert found.over_commanded_mps == pytest.approx(0.0, abs=1e-9)
    assert found.over_true_mps == pytest.approx(0.0, abs=1e-9)
    assert (found.flies_s, found.on_path_s) == pytest.approx((1.5, 1.5))
    assert found.down_s == 4.0


@pytest.mark.parametrize(
    ("flown", "figure"),
    [
        (life(brakes_s=1.4), "brakes_s"),
        (life(brakes_s=1.4), "over_commanded_mps"),
        (life(brake_mps2=1.0), "over_commanded_mps"),
        (life(brake_mps2=1.0), "over_true_mps"),
        (life(flies_s=3.2), "flies_s"),
    ],
)
def test_a_vehicle_that_brakes_late_or_softly_or_never_flies_again_is_outside(
    flown: ProcessLife, figure: str
) -> None:
    found, good = verdict(flown), verdict(life())
    assert not found.is_inside
    assert getattr(found, figure) > getattr(good, figure) + 0.01


def test_a_vehicle_that_moves_on_although_it_is_told_to_stand_is_outside() -> None:
    """The true speed has its own curve."""
    flown = life()
    found = verdict(replace(flown, speed=flown.speed + 0.1 * (flown.time_ns > 12 * SECOND_NS)))
    assert found.over_commanded_mps == pytest.approx(0.0, abs=1e-9)
    assert found.over_true_mps == pytest.approx(0.1)
    assert not found.is_inside


def test_a_process_that_is_back_at_once_leaves_no_curve() -> None:
    flown = replace(life(), mode=np.full(400, Mode.TRACK, np.uint8), in_force=np.arange(400))
    found = verdict(
        flown, ProcessOutage("netem", KILLED, 10 * SECOND_NS, 10 * SECOND_NS + 5 * 10**8)
    )
    assert found.is_inside
    assert (found.brakes_s, found.over_commanded_mps, found.over_true_mps) == (None, None, None)


def test_a_vehicle_that_slept_has_to_brake_when_it_wakes() -> None:
    woken = ProcessOutage("client", STOPPED, 8 * SECOND_NS, 11 * SECOND_NS)
    assert verdict(life(brakes_s=1.0), woken).brakes_s == pytest.approx(0.0)


def test_a_new_life_has_to_stand_until_it_flies() -> None:
    died = ProcessOutage("client", KILLED, 10 * SECOND_NS, 11 * SECOND_NS)
    old, born = life(), life(brakes_s=-10.0, flies_s=-2.0, brake_mps2=1e6)
    old = ProcessLife(*(getattr(old, name)[:200] for name in old.__annotations__))
    later = born.time_ns + 11 * SECOND_NS
    still = np.where(born.commanded > 0.0, born.speed, 0.0)
    born = replace(
        born, time_ns=later, commanded=born.commanded * (born.mode != Mode.BRAKE), speed=still
    )
    found = judge(died, [old, born], restarts.scenario())
    assert (found.over_commanded_mps, found.over_true_mps) == (0.0, 0.0)
    moving = replace(born, speed=still + 0.2)
    assert judge(died, [old, moving], restarts.scenario()).over_true_mps == pytest.approx(
        0.2, abs=0.05
    )


@pytest.mark.realtime
def test_processes_that_are_killed_under_way_come_back() -> None:
    counts = RestartsCounts(kills=1, stops=0, flight_s=0.5, subjects=("server", "client"))
    result = restarts.measure(counts)
    server, client = restarts.verdicts_of(result)
    for each in (server, client):
        assert each.over_commanded_mps <= restarts.ROUNDING_MPS
        assert each.over_true_mps <= restarts.ROUNDING_MPS
        assert np.isfinite(each.flies_s)
    assert server.brakes_s is not None
    assert client.brakes_s is None
    (table,) = restarts.tables(result).values()
    assert [row[0] for row in table.rows] == ["server killed", "client killed"]
