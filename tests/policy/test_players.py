"""`policy.players`: the row to execute at each control step."""

from copy import copy

import numpy as np
import pytest

from skytether.policy.players import HELD_MAX, Clocked, Freshest, Held, Newest, Player, Queue
from skytether.shared.base.errors import ConfigError


def held(generation: int, first: int, *rows: float) -> Held:
    return Held(generation, first, np.array(rows)[:, None])


def played(player: Player, steps: range) -> list[float | None]:
    rows = [player.row(step) for step in steps]
    return [None if row is None else float(row[0]) for row in rows]


def test_the_row_of_the_present_step_is_played_whenever_the_chunk_arrives() -> None:
    player = Clocked()
    player.accept(held(1, 2, 20.0, 21.0, 22.0), 3)
    assert played(player, range(3, 6)) == [21.0, 22.0, None]
    assert player.last is not None
    assert player.last[0] == 22.0


def test_an_older_chunk_is_executed_until_the_newest_begins_and_not_after_its_end() -> None:
    player = Clocked()
    player.accept(held(3, 2, 32.0), 0)
    player.accept(held(2, 0, 20.0, 21.0, 22.0, 23.0), 0)
    assert played(player, range(5)) == [20.0, 21.0, 32.0, None, None]
    player.accept(held(4, 6, 46.0), 4)
    assert played(player, range(4, 8)) == [None, None, 46.0, None]


def test_a_single_action_that_comes_late_is_the_row_to_hold() -> None:
    player = Clocked()
    player.accept(held(1, 0, 5.0), 4)
    assert played(player, range(4, 5)) == [None]
    assert player.last is not None
    assert player.last[0] == 5.0


def test_a_player_holds_a_bounded_number_of_chunks_and_each_once() -> None:
    player = Clocked()
    for generation in range(3 * HELD_MAX):
        for _ in range(2):
            player.accept(held(generation, 1000, 1.0), 0)
    assert [each.generation for each in player.held] == [
        *range(3 * HELD_MAX - 1, 2 * HELD_MAX - 1, -1)
    ]


def test_a_copy_is_a_snapshot() -> None:
    player = Queue()
    player.accept(held(1, 0, 1.0, 2.0, 3.0), 0)
    snapshot = copy(player)
    assert played(player, range(2)) == [1.0, 2.0]
    assert played(snapshot, range(4)) == [1.0, 2.0, 3.0, None]


def test_the_newest_action_is_held_and_an_overtaken_one_is_ignored() -> None:
    player = Newest()
    assert played(player, range(1)) == [None]
    player.accept(held(2, 0, 2.0), 1)
    player.accept(held(1, 0, 1.0), 1)
    assert played(player, range(1, 4)) == [2.0, 2.0, 2.0]


def test_a_queue_counts_the_rows_that_it_has_played_and_stands_still_when_empty() -> None:
    """After a pause its rows are executed late, by the length of the pause."""
    player = Queue()
    player.accept(held(1, 0, 0.0, 1.0), 0)
    assert played(player, range(4)) == [0.0, 1.0, None, None]
    assert player.number(4) == 2
    player.accept(held(2, 2, 2.0, 3.0), 4)
    assert played(player, range(4, 6)) == [2.0, 3.0]


def test_a_queue_skips_what_it_has_played_and_drops_what_the_new_chunk_lacks() -> None:
    player = Queue()
    player.accept(held(1, 0, 0.0, 1.0, 2.0, 3.0, 4.0), 0)
    assert played(player, range(2)) == [0.0, 1.0]
    player.accept(held(2, 1, 11.0, 12.0, 13.0), 2)
    assert played(player, range(2, 5)) == [12.0, 13.0, None]


def test_a_queue_averages_where_both_have_a_row() -> None:
    player = Queue("average")
    player.accept(held(1, 0, 0.0, 1.0, 2.0), 0)
    player.accept(held(2, 1, 11.0, 12.0, 13.0), 0)
    assert played(player, range(1)) == [pytest.approx(0.3 * 1.0 + 0.7 * 11.0)]
    assert played(player, range(1, 3)) == [pytest.approx(0.3 * 2.0 + 0.7 * 12.0), 13.0]


def test_a_queue_refuses_to_average_what_is_no_real_number() -> None:
    with pytest.raises(ConfigError, match="player: got rows of int64"):
        Queue("average").accept(Held(1, 0, np.array([1, 2])), 0)


def test_of_each_step_the_freshest_row_is_played_and_the_rest_of_an_older_chunk_stays() -> None:
    player = Freshest()
    player.accept(held(1, 0, 10.0, 11.0, 12.0, 13.0, 14.0), 0)
    assert played(player, range(2)) == [10.0, 11.0]
    player.accept(held(2, 1, 21.0, 22.0, 23.0), 2)
    assert player.number(2) == 2
    assert played(player, range(2, 6)) == [22.0, 23.0, 14.0, None]
    assert player.number(6) == 5


def test_a_chunk_that_was_overtaken_is_ignored_whole() -> None:
    player = Freshest()
    player.accept(held(2, 0, 20.0), 0)
    player.accept(held(1, 0, 10.0, 11.0), 0)
    assert played(player, range(2)) == [20.0, None]
