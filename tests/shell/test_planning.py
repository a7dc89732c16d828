"""Planners in threads: one that hangs is not waited for, and nobody else's plan is lost.

All but one test are in virtual time: a planner answers as soon as it is called, or hangs.
"""

import threading
import time
from contextlib import suppress
from queue import Empty, Full, SimpleQueue
from threading import Event
from typing import Any

import pytest

from skytether.shell.driving import planning
from skytether.shell.driving.planning import HANGING_MAX, Planners

LIMIT_S = 30.0
"""Never reached by a planner that answers, however busy the machine is."""


class Answers(SimpleQueue):  # type: ignore[type-arg]
    """Queue of answers, for which the clock jumps to the end of the time-out."""

    now_s = 1000.0

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        if timeout is not None and self.empty():
            Answers.now_s += timeout
            raise Empty
        return super().get(block, timeout)


class NothingLeft(Exception):
    """The queue of a thread is empty."""


class Work:
    """Queue of a thread, whose work ends with the queue."""

    def __init__(self, calls: Any) -> None:
        self._calls = calls

    def get(self) -> Any:
        if self._calls.empty():
            raise NothingLeft
        return self._calls.get()


class ByHand(Planners):
    """Planners whose calls answer at once, except those of a planner that hangs."""

    def __init__(self) -> None:
        super().__init__(0.025)
        self._answers = Answers()
        self.hanging: set[int] = set()

    def _start(self, planner: int, call: Any) -> None:
        super()._start(planner, call)
        if planner not in self.hanging:
            self.goes_on(planner)

    def goes_on(self, planner: int) -> None:
        self.hanging.discard(planner)
        with suppress(NothingLeft):
            self._work(Work(self._busy[planner]))  # type: ignore[arg-type]


class Threads:
    """Stand-in for `Thread` that counts."""

    begun = 0

    def __init__(self, **_: object) -> None:
        Threads.begun += 1

    def start(self) -> None:
        """Begin nothing."""


@pytest.fixture
def planners(monkeypatch: pytest.MonkeyPatch) -> ByHand:
    monkeypatch.setattr(planning.time, "monotonic", lambda: Answers.now_s)
    monkeypatch.setattr(planning, "Thread", Threads)
    monkeypatch.setattr(Threads, "begun", 0)
    return ByHand()


@pytest.mark.parametrize("raised", [SystemExit, KeyboardInterrupt, RuntimeError])
def test_whatever_a_planner_raises_is_its_answer_and_its_thread_goes_on(
    raised: type[BaseException],
) -> None:
    def fails() -> None:
        raise raised("no")

    planners = ByHand()
    for _ in range(2):
        wrong, right = planners([(1, fails), (2, lambda: "a plan")])
        assert isinstance(wrong, RuntimeError)
        assert right == "a plan"


def test_answers_are_in_the_order_of_the_calls(planners: ByHand) -> None:
    for tick in range(3):
        calls = [(row, lambda row=row, tick=tick: (row, tick)) for row in (3, 1, 2)]
        assert planners(calls) == [(3, tick), (1, tick), (2, tick)]
    assert Threads.begun <= 3


def test_an_exception_is_an_answer(planners: ByHand) -> None:
    (answer, other) = planners([(1, lambda: 1 / 0), (2, lambda: 5)])
    assert isinstance(answer, ZeroDivisionError)
    assert other == 5


def test_a_planner_that_hangs_is_waited_for_once(planners: ByHand) -> None:
    """Its vehicle gets no plan until it is back, and then a new one; the late plan is dropped."""
    planners.hanging.add(1)
    began_s = Answers.now_s
    late, other = planners([(1, lambda: "late"), (2, lambda: "a")])
    assert isinstance(late, TimeoutError)
    assert other == "a"
    assert Answers.now_s - began_s == pytest.approx(0.025)
    for _ in range(5):
        late, other = planners([(1, lambda: pytest.fail("asked")), (2, lambda: "b")])
        assert isinstance(late, TimeoutError)
        assert other == "b"
    assert Answers.now_s - began_s == pytest.approx(0.025)
    planners.goes_on(1)
    assert planners([(1, lambda: "new")]) == ["new"]


def test_an_answer_that_comes_in_a_later_tick_is_not_that_tick_s(planners: ByHand) -> None:
    planners.hanging.add(1)
    planners([(1, lambda: "late")])

    def meanwhile() -> str:
        planners.goes_on(1)
        return "b"

    late, other = planners([(1, lambda: "not begun"), (2, meanwhile)])
    assert isinstance(late, TimeoutError)
    assert other == "b"


def test_too_many_that_hang_stop_all_until_one_returns(planners: ByHand) -> None:
    planners.hanging |= set(range(HANGING_MAX))
    calls = [(each, lambda: "late") for each in range(HANGING_MAX)]
    planners(calls[:-1])
    assert planners([(HANGING_MAX, lambda: "called")]) == ["called"]
    planners(calls[-1:])
    late, refused = planners([(0, lambda: "late"), (HANGING_MAX, lambda: pytest.fail("called"))])
    assert isinstance(late, TimeoutError)
    assert isinstance(refused, Full)
    assert f"{HANGING_MAX} calls of planners hang" in str(refused)
    assert Threads.begun == HANGING_MAX
    planners.goes_on(7)
    assert planners([(HANGING_MAX, lambda: "called")]) == ["called"]


@pytest.mark.realtime
def test_planners_are_threads_that_are_used_again() -> None:
    """One hangs and returns."""
    planners, goes_on, before = Planners(LIMIT_S), Event(), threading.active_count()
    assert planners([(1, lambda: "a"), (2, lambda: 5)]) == ["a", 5]
    planners._limit_s = 0.1
    (late,) = planners([(1, goes_on.wait)])
    assert isinstance(late, TimeoutError)
    planners._limit_s = LIMIT_S
    assert planners([(2, lambda: "b")]) == ["b"]
    goes_on.set()
    answer: Any = late
    while isinstance(answer, TimeoutError):
        (answer,) = planners([(1, lambda: "new")])
        time.sleep(0.001)
    assert answer == "new"
    assert threading.active_count() - before == 2
