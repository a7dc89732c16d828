"""Planners of plug-ins in real time: each vehicle's in a thread of its own, with a time limit.

A planner that takes too long is not waited for: its plan is dropped when it is ready, and until
then its vehicle gets none. So one that hangs delays the plans of other vehicles once, by the limit,
and costs them no tick. Threads cannot be ended; they end with the process.
"""

import time
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any

SHARE = 0.5
"""Share of a step for which a tick waits for planners, so that the next tick is in time."""

Call = Callable[[], Any]


class Planners:
    """Calls planners, at most `limit_s` for all vehicles together at a tick."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._threads: dict[int, SimpleQueue[tuple[int, Call]]] = {}
        """Calls for the thread of each row of a vehicle."""
        self._answers: SimpleQueue[tuple[int, int, Any]] = SimpleQueue()
        """Row, number of the tick, and what the planner returned or raised."""
        self._busy: set[int] = set()
        self._tick = 0

    def __call__(self, calls: Sequence[tuple[int, Call]]) -> list[Any]:
        """See `server.common.scheme.Planning`."""
        self._tick += 1
        until_s = time.monotonic() + self._limit_s
        while not self._answers.empty():  # of planners that took too long
            self._busy.discard(self._answers.get()[0])
        started = [(row, call) for row, call in calls if row not in self._busy]
        for row, call in started:
            self._busy.add(row)
            self._thread(row).put((self._tick, call))
        answers: dict[int, Any] = {}
        while len(answers) < len(started) and (left_s := until_s - time.monotonic()) > 0.0:
            try:
                row, tick, answer = self._answers.get(timeout=left_s)
            except Empty:
                break
            self._busy.discard(row)
            if tick == self._tick:
                answers[row] = answer
        late = TimeoutError(f"got no plan after {self._limit_s:g} s, half a step")
        return [answers.get(row, late) for row, _ in calls]

    def _thread(self, row: int) -> "SimpleQueue[tuple[int, Call]]":
        if row not in self._threads:
            queue = self._threads[row] = SimpleQueue[tuple[int, Call]]()
            Thread(target=self._work, args=(row, queue), daemon=True).start()
        return self._threads[row]

    def _work(self, row: int, queue: "SimpleQueue[tuple[int, Call]]") -> None:
        while True:
            tick, call = queue.get()
            try:
                answer = call()
            except Exception as error:
                answer = error
            self._answers.put((row, tick, answer))
