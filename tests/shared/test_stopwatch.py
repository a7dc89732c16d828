"""Laps of a stopwatch on a given clock."""

from skytether.shared.endpoints.stopwatch import Stopwatch


def test_laps_follow_each_other_and_add_up_by_name() -> None:
    times = iter([100, 130, 135, 1000, 1007])
    watch = Stopwatch(lambda: next(times))
    watch.start()
    assert watch.lap("decode") == 30
    assert watch.lap("plan") == 5
    watch.start()
    assert watch.lap("decode") == 7
    assert watch.spent_ns == {"decode": 37, "plan": 5}
    assert watch.runs


def test_without_a_clock_nothing_takes_time() -> None:
    watch = Stopwatch()
    watch.start()
    assert watch.lap("plan") == 0
    assert not watch.runs
