"""`bench.players`: what players make of one policy over one network."""

from typing import Any

import numpy as np
import pytest

from bench import push_t
from bench.players import (
    BOUNDS,
    PLAYERS,
    TASKS,
    Cell,
    FlownCell,
    differs,
    fly_cell,
    tables,
)


@pytest.fixture(scope="module")
def flown() -> dict[str, FlownCell]:
    return {player: fly_cell(Cell("pendulum", player, 0.1, 0.1, 1)) for player in PLAYERS}


def test_a_chunk_by_the_clock_scores_more_than_one_of_a_queue(
    flown: dict[str, FlownCell],
) -> None:
    scores = {player: each.score for player, each in flown.items()}
    assert scores["newest"] < scores["replace"] < scores["clocked"]


def test_when_needed_takes_fewer_packets_for_nearly_the_same(
    flown: dict[str, FlownCell],
) -> None:
    assert flown["sparing"].packets_per_s < 0.5 * flown["clocked"].packets_per_s
    assert flown["sparing"].score == pytest.approx(flown["clocked"].score, rel=0.1)


def test_a_flight_is_the_same_each_time(flown: dict[str, FlownCell]) -> None:
    assert fly_cell(flown["sparing"].cell) == flown["sparing"]


def test_a_chunk_differs_by_a_row_beyond_the_tolerance_or_when_rows_run_out() -> None:
    task: Any = TASKS["pendulum"]
    coming = np.zeros((12, 1))
    assert not differs(task, coming + 0.9 * task.tolerance, coming)
    assert differs(task, coming + 1.1 * task.tolerance, coming)
    assert differs(task, coming, coming[:8])


def test_the_table_has_a_row_for_each_network(flown: dict[str, FlownCell]) -> None:
    (table,) = tables(list(flown.values())).values()
    (row,) = table.rows
    assert row[:2] == ["Pendulum-v1", "100 ms, 10%"]
    assert len(row) == 2 + len(PLAYERS)


def test_every_player_lies_between_the_bounds(flown: dict[str, FlownCell]) -> None:
    bounds = {name: fly_cell(Cell("pendulum", name, 0.0, 0.0, 1)) for name in BOUNDS}
    least, most = bounds["nothing"].score, bounds["oracle"].score
    for name in ("freshest", "clocked", "sparing"):
        assert least < flown[name].score < most
    (table,) = tables([*flown.values(), *bounds.values()]).values()
    shown = {row[1]: [bool(cell) for cell in row[2:]] for row in table.rows}
    assert shown == {
        "100 ms, 10%": [True] * 6,
        "nothing sent": [True] + [False] * 5,
        "no network": [True] * 2 + [False] * 4,
    }


def test_a_push_through_the_centre_of_gravity_moves_the_block_and_one_beside_it_turns_it() -> None:
    """The block lies unturned at (200, 200); its bar is 30 px thick, its stem 120 px long."""
    begin = np.array([100.0, 245.0, 200.0, 200.0, 0.0])
    assert push_t.predict(begin, np.array([[170.0, 245.0]])) == pytest.approx(
        [170.0, 245.0, 200.0, 200.0, 0.0]  # at the stem
    )
    assert push_t.predict(begin, np.array([[150.0, 245.0], [182.0, 245.0]])) == pytest.approx(
        [182.0, 245.0, 212.0, 200.0, 0.0]
    )
    beside = push_t.predict(begin, np.array([[150.0, 300.0], [182.0, 300.0]]))
    assert beside[4] < 0.0
    assert beside[2] - 200.0 > 0.0


def test_what_is_committed_to_a_pusher_is_kept_and_gone_on_from() -> None:
    begin = np.array([100.0, 245.0, 200.0, 200.0, 0.0])
    committed = np.array([[110.0, 245.0], [120.0, 250.0], [130.0, 255.0]])
    rows = push_t.plan(begin, committed, 16)
    assert rows.shape == (16, 2)
    np.testing.assert_array_equal(rows[:3], committed)
    assert np.hypot(*(rows[3] - rows[2])) <= push_t.TRAVEL_SPEED + 1.0
    many = np.tile(committed, (6, 1))
    np.testing.assert_array_equal(push_t.plan(begin, many, 16), many[:16])
