"""Shared budget: priorities and amounts."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.crowd import judge
from skytether.client.vehicles import apart_ns
from skytether.server import budget as budgets
from skytether.server.budget import BURST_S, GUESS_BYTES, WAIT_S, SharedBudget
from skytether.shared.base.units import HEADER_BYTES, MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.scenario.whole import Scenario
from skytether.sim.batch import fly_batch
from skytether.sim.flight import fly

DT_NS = 50 * MILLISECOND_NS
DT_S = DT_NS / SECOND_NS


class Crowd:
    """Vehicles that share a budget and ask at every tick; a packet has as many bytes as its row."""

    def __init__(self, bytes_per_s: float, sizes: list[int]) -> None:
        n = len(sizes)
        self.rows, self.sizes = np.arange(n), np.array(sizes)
        self.budget = SharedBudget(bytes_per_s, n)
        self.since_s = np.zeros(n)
        self.now_ns = 0

    def tick(self, worth: Array, owed: list[int] | None = None, blocks: int = 1) -> list[int]:
        """Vehicles that are sent a packet at the next tick, if all ask."""
        self.now_ns += DT_NS
        self.since_s += DT_S
        self.budget.fill(self.now_ns)
        must = np.isin(self.rows, owed or [])
        sent: list[int] = []
        for block in np.array_split(self.rows, blocks):
            asks = np.ones(len(block), dtype=np.bool_)
            of_block = worth[block], self.since_s[block]
            goes = block[self.budget.choose(block, asks, must[block], *of_block)]
            for row in goes.tolist():
                packet = Datagram(bytes(self.sizes[row] - HEADER_BYTES), ("vehicle", 0))
                self.budget.charge(row, [packet], is_plan=True)
            sent += goes.tolist()
        self.since_s[sent] = 0.0
        return sent


@settings(max_examples=6)
@given(
    st.lists(st.integers(40, 400), min_size=1, max_size=12),
    st.floats(200.0, 20_000.0),
    st.integers(1, 3),
    st.integers(0, 2**32 - 1),
)
def test_no_more_goes_than_the_rate(sizes: list[int], rate: float, blocks: int, seed: int) -> None:
    """In any window of T at most r (T + BURST_S), plus the excess of a packet's size."""
    crowd, rng = Crowd(rate, sizes), np.random.default_rng(seed)
    spent = [
        sum(sizes[row] for row in crowd.tick(rng.random(len(sizes)), blocks=blocks))
        for _ in range(100)
    ]
    total = np.concatenate([[0], np.cumsum(spent)])
    for begin in range(0, 100, 7):
        for end in range(begin + 1, 101, 9):
            window_s = (end - begin) * DT_S
            grown = sum(sizes)  # sizes are guessed at first
            assert total[end] - total[begin] <= rate * (window_s + BURST_S) + grown


def test_a_rate_that_is_enough_holds_nobody_back() -> None:
    crowd = Crowd(1e6, [100] * 8)
    assert [len(crowd.tick(np.ones(8))) for _ in range(20)] == [8] * 20
    assert crowd.budget.deferred == 0


def test_who_gains_most_a_byte_goes_first() -> None:
    crowd = Crowd(2 * GUESS_BYTES / DT_S, [100, 100, 200, 100])
    crowd.tick(np.zeros(4), owed=[0, 1, 2, 3])  # from here on sizes are known
    for _ in range(8):  # the others pay for the obligatory packets
        crowd.tick(np.full(4, np.nan))
    crowd.since_s[:] = 0.0
    assert crowd.tick(np.array([1.0, 3.0, 5.0, 4.0])) == [1, 3]


def test_what_is_owed_goes_in_any_case_and_the_others_pay() -> None:
    """At a rate of one packet a tick, four obligatory packets use up the others' share."""
    crowd = Crowd(GUESS_BYTES / DT_S, [100] * 8)
    assert sorted(crowd.tick(np.arange(8.0), owed=[0, 1, 2, 3]))[:4] == [0, 1, 2, 3]
    after = [len(crowd.tick(np.arange(8.0))) for _ in range(4)]
    assert after[0] == 0
    assert sum(after) <= 3


def test_debts_are_bounded() -> None:
    crowd = Crowd(GUESS_BYTES / DT_S, [100] * 50)
    crowd.tick(np.ones(50), owed=list(range(49)))
    waited = 0
    while not crowd.tick(np.ones(50)):
        waited += 1
    assert waited * DT_S <= 2 * BURST_S


def longest_wait_s() -> float:
    """Longest time that one vehicle with low priority waits beside greedy ones."""
    crowd = Crowd(2 * GUESS_BYTES / DT_S, [100] * 12)
    worth, longest_s = np.full(12, 100.0), 0.0
    worth[0] = 1.0
    for _ in range(400):
        crowd.tick(worth)
        longest_s = max(longest_s, crowd.since_s[0])
    return longest_s


def test_nobody_starves(monkeypatch: pytest.MonkeyPatch) -> None:
    """After WAIT_S without a packet it goes first; without that rule it starves."""
    assert longest_wait_s() <= WAIT_S + 3 * DT_S
    monkeypatch.setattr(budgets, "WAIT_S", np.inf)
    assert longest_wait_s() == pytest.approx(400 * DT_S)


def test_blocks_share_one_ranking() -> None:
    worth = np.array([1.0, 2.0, 3.0, 40.0, 50.0, 60.0])
    sent = []
    for blocks in (1, 2, 3):
        crowd = Crowd(3 * GUESS_BYTES / DT_S, [100] * 6)
        crowd.tick(worth, blocks=blocks)
        crowd.tick(worth, blocks=blocks)
        crowd.since_s[:] = 0.0
        sent.append(sorted(crowd.tick(worth, blocks=blocks)))
    assert sent == [[3, 4, 5]] * 3


def test_who_no_longer_asks_holds_nobody_back() -> None:
    crowd = Crowd(GUESS_BYTES / DT_S, [100, 100])
    for _ in range(4):
        crowd.tick(np.array([1.0, 9.0]), owed=[0])
    crowd.rows = np.array([0])
    crowd.tick(np.array([1.0]))
    crowd.tick(np.array([1.0]))
    assert crowd.tick(np.array([1.0])) == [0]


# -- flights ---------------------------------------------------------------------------------

AIR = "paper(0.4, 0.02, 2) & rate(3000, queue=5000)"


def crowd(keys: Mapping[str, Any], network: str = AIR) -> Scenario:
    table = reading.to_table(reading.load("crowd"))
    table["network"] = {"uplink": network, "downlink": network}
    set_keys({"duration": 25.0, "settle": 12.0, **keys}, table)
    return reading.check(table, "test")


def flown(keys: Mapping[str, Any], vehicles: int, network: str = AIR) -> tuple[bool, float]:
    """Whether this number of vehicles flies, and the error of all of them [m]."""
    scenario = crowd(keys, network)
    record = fly(scenario, vehicles=vehicles)
    point = judge(scenario, "budget", vehicles, record.client, record.figures["netem"])
    return point.flies(1.0), np.inf if point.rmse_m is None else point.rmse_m


BUDGET = {"control.shared_bytes_per_s": 2700.0}


@pytest.mark.long
def test_a_budget_flies_where_thresholds_fill_the_queue() -> None:
    """More vehicles than the network carries with thresholds alone; the error is much smaller."""
    vehicles = 19
    flies, _ = flown({}, vehicles)
    assert not flies
    flies, rmse_m = flown(BUDGET, vehicles)
    assert flies
    assert rmse_m < 0.8


def test_a_run_with_a_budget_equals_the_same_run_alone() -> None:
    scenario = crowd({**BUDGET, "duration": 4.0, "settle": 1.0})
    for seed, together in zip((1, 2), fly_batch(scenario, (1, 2)), strict=True):
        alone = fly(crowd({**BUDGET, "duration": 4.0, "settle": 1.0, "seed": seed}))
        assert (together.client == alone.client).all()


def test_a_budget_is_told_among_the_figures() -> None:
    record = fly(crowd({**BUDGET, "duration": 3.0, "settle": 1.0}), vehicles=2)
    assert record.figures["server"]["budget"] == {"bytes_per_s": 2700.0, "deferred": 0}
    record = fly(crowd({"duration": 1.0, "settle": 0.5}))
    assert "budget" not in record.figures["server"]


def test_each_vehicle_of_a_fleet_has_a_target_of_its_own() -> None:
    """The first has the scenario's; the record's error is from the vehicle's own."""
    scenario = crowd({"duration": 3.0, "settle": 1.0})
    times_s = np.arange(100.0)
    own = [scenario.make_reference(vehicle)(times_s) for vehicle in (1, 2, 3)]
    np.testing.assert_array_equal(own[0], scenario.make_reference()(times_s))
    assert np.abs(own[1] - own[2]).max() > 1.0
    record = fly(scenario, vehicles=3)
    for row in record.server[:: len(record.server) // 9]:
        wanted = scenario.make_reference(int(row["vehicle"]))(np.array(row["step"] * DT_S))
        np.testing.assert_allclose(row["reference"], wanted, atol=1e-9)


def test_vehicles_of_a_fleet_start_one_after_the_other() -> None:
    record = fly(crowd({"duration": 2.0, "settle": 1.0}), vehicles=3)
    netem = record.netem[np.unique(record.netem["flow"], return_index=True)[1]]
    assert np.diff(netem["arrived_ns"]).tolist() == [DT_NS, DT_NS]
    assert apart_ns(1000, DT_NS) * 1000 == 5 * SECOND_NS
