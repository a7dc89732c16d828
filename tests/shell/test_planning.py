"""Planners in threads: one that hangs is not waited for, and nobody else's plan is lost."""

import threading
import time
from queue import Full
from threading import Event
from typing import Any

from skytether.shell.planning import HANGING_MAX, Planners

LIMIT_S = 30.0
"""Never reached by a planner that answers, however busy the machine is."""


def test_answers_are_in_the_order_of_the_calls() -> None:
    planners = Planners(LIMIT_S)
    for tick in range(20):
        calls = [(row, lambda row=row, tick=tick: (row, tick)) for row in (3, 1, 2)]
        assert planners(calls) == [(3, tick), (1, tick), (2, tick)]


def test_an_exception_is_an_answer() -> None:
    (answer, other) = Planners(LIMIT_S)([(1, lambda: 1 / 0), (2, lambda: 5)])
    assert isinstance(answer, ZeroDivisionError)
    assert other == 5


def test_a_planner_that_hangs_is_waited_for_once() -> None:
    """Its vehicle gets no plan until it is back, and then a new one; the late plan is dropped."""
    planners, goes_on, asked = Planners(0.2), Event(), []

    def hangs() -> str:
        goes_on.wait()
        return "late"

    def quick(what: str) -> Any:
        asked.append(what)
        return what

    late, _ = planners([(1, hangs), (2, lambda: quick("a"))])
    assert isinstance(late, TimeoutError)
    planners._limit_s = LIMIT_S
    while planners([(2, lambda: quick("a"))]) != ["a"]:  # a busy machine may make it late too
        pass
    began_s = time.monotonic()
    for _ in range(5):
        late, other = planners([(1, lambda: quick("not asked")), (2, lambda: quick("b"))])
        assert isinstance(late, TimeoutError)
        assert other == "b"
    assert time.monotonic() - began_s < LIMIT_S
    goes_on.set()
    answers: list[Any] = [late]
    while isinstance(answers[0], TimeoutError):
        answers = planners([(1, lambda: "new")])
    assert answers == ["new"]
    assert "not asked" not in asked


def test_too_many_that_hang_stop_all_until_one_returns() -> None:
    planners, goes_on = Planners(0.1), Event()
    before = threading.active_count()
    planners([(each, goes_on.wait) for each in range(HANGING_MAX)])
    assert threading.active_count() - before == HANGING_MAX
    planners._limit_s = LIMIT_S
    late, refused = planners([(0, goes_on.wait), (HANGING_MAX, lambda: "not called")])
    assert isinstance(late, TimeoutError)
    assert isinstance(refused, Full)
    assert f"{HANGING_MAX} calls of planners hang" in str(refused)
    goes_on.set()
    answer: Any = refused
    while isinstance(answer, Full):
        (answer,) = planners([(HANGING_MAX, lambda: "called")])
    assert answer == "called"
    assert threading.active_count() - before <= HANGING_MAX
