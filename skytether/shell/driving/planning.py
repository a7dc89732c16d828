"""Planners of plug-ins in real time: each call in a thread, with a time limit.

A planner that takes too long is not waited for: its plan is dropped when it is ready, and until
then it is not called again. So one that hangs delays the plans of other vehicles once, by the
limit, and costs them no tick. Threads cannot be ended; they end with the process. So once
HANGING_MAX calls hang, whether or not their vehicles are still there, none is begun.
"""

import time
from collections.abc import Callable, Sequence
from queue import Empty, Full, SimpleQueue
from threading import Thread
from typing import Any

SHARE = 0.5
"""Share of a step for which a tick waits for planners, so that the next tick is in time."""
HANGING_MAX = 64
"""Number of calls of earlier ticks that may be under way while others are begun."""

Call = Callable[[], Any]
Calls = SimpleQueue[tuple[int, int, Call]]
"""Calls for a thread: each with its planner and the number of its tick."""


class Planners:
    """Calls planners, at most `limit_s` for all vehicles together at a tick."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._idle: list[Calls] = []
        """Threads without a call."""
        self._busy: dict[int, Calls] = {}
        """Threads by the planners that are called there."""
        self._answers: SimpleQueue[tuple[int, int, Any]] = SimpleQueue()
        """Planner, number of the tick, and what the planner returned or raised."""
        self._tick = 0

    def __call__(self, calls: Sequence[tuple[int, Call]]) -> list[Any]:
        """See `server.planning.scheme.Planning`."""
        self._tick += 1
        until_s = time.monotonic() + self._limit_s
        while not self._answers.empty():  # of planners that took too long
            self._finish()
        late: Exception = TimeoutError(f"got no plan after {self._limit_s:g} s, half a step")
        answers: dict[int, Any] = {planner: late for planner, _ in calls}
        started = [(planner, call) for planner, call in calls if planner not in self._busy]
        if len(self._busy) >= HANGING_MAX:
            full = Full(f"{HANGING_MAX} calls of planners hang, so no other is begun")
            return [answers[planner] if planner in self._busy else full for planner, _ in calls]
        for planner, call in started:
            self._start(planner, call)
        left = len(started)
        while left and (left_s := until_s - time.monotonic()) > 0.0:
            try:
                planner, tick, answer = self._finish(left_s)
            except Empty:
                break
            if tick == self._tick:
                answers[planner] = answer
                left -= 1
        return [answers[planner] for planner, _ in calls]

    def _start(self, planner: int, call: Call) -> None:
        if not self._idle:
            queue = Calls()
            Thread(target=self._work, args=(queue,), daemon=True).start()
            self._idle.append(queue)
        queue = self._busy[planner] = self._idle.pop()
        queue.put((planner, self._tick, call))

    def _finish(self, timeout_s: float | None = None) -> tuple[int, int, Any]:
        """Wait for an answer, and note that its thread is idle; raises Empty at the time-out."""
        answer = self._answers.get(timeout=timeout_s)
        self._idle.append(self._busy.pop(answer[0]))
        return answer

    def _work(self, queue: Calls) -> None:
        while True:
            planner, tick, call = queue.get()
            try:
                answer = call()
            except Exception as error:
                answer = error
            except BaseException as error:  # a thread that ends would count as late for ever
                answer = RuntimeError(f"got {type(error).__name__}: {error}")
            self._answers.put((planner, tick, answer))
