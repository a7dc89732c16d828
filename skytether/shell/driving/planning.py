"""Planners of plug-ins in real time: each call in a thread, with a time limit.

If a planner takes too long, the tick continues without its plan. The planner is not called again
before its call ends, and the late plan is dropped. So a planner that hangs delays the other
vehicles' plans once, by the limit, and no tick is missed. Threads cannot be ended: once HANGING_MAX
calls hang, no further call is started. Hanging calls for vehicles that have left count, too.
"""

import time
from collections.abc import Callable, Sequence
from queue import Empty, Full, SimpleQueue
from threading import Thread
from typing import Any

SHARE = 0.5
"""Share of a step for which a tick waits for planners, so that the next tick is in time."""
HANGING_MAX = 64
"""If this many calls of earlier ticks are unfinished, no new call is started."""

Call = Callable[[], Any]
Calls = SimpleQueue[tuple[int, int, Call]]
"""Calls for a thread: number of the planner, number of the tick, and the call."""


class Planners:
    """Runs planners in threads, for at most `limit_s` per tick for all vehicles together."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._idle: list[Calls] = []
        """Queue of calls of each idle thread."""
        self._busy: dict[int, Calls] = {}
        """Queue of calls of each busy thread, by number of the planner that it runs."""
        self._answers: SimpleQueue[tuple[int, int, Any]] = SimpleQueue()
        """Answers of threads: numbers of the planner and the tick, and the result or exception."""
        self._tick = 0

    def __call__(self, calls: Sequence[tuple[int, Call]]) -> list[Any]:
        """Call planners; returns plans or exceptions, see `server.planning.scheme.Planning`."""
        self._tick += 1
        until_s = time.monotonic() + self._limit_s
        while not self._answers.empty():  # drop plans of planners that took too long
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
        """Wait for an answer, and mark its thread as idle; raises Empty at the time-out."""
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
            except BaseException as error:  # an ended thread would count as hanging
                answer = RuntimeError(f"got {type(error).__name__}: {error}")
            self._answers.put((planner, tick, answer))
