"""Sender of changes from the page to the flight's processes.

A dragged slider makes many requests per second, and processes may answer slowly, so only the newest
waiting request for a key is sent. Requests go through the control sockets
(`shell.driving.control`), where they are checked like a scenario.
"""

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from skytether.shared.endpoints.change import Answer
from skytether.shell.driving.control import Caller, ControlError

Answered = Callable[[str, Mapping[str, Any], Answer | None], None]


class Operator:
    """Sender of changes to a flight's processes, in its own thread.

    Args:
        folder: folder of the processes' control sockets.
        answered: called in the thread with a process's name, the requested values, and the answer,
            or None without an answer.
    """

    def __init__(self, folder: Path, answered: Answered) -> None:
        self._folder = folder
        self._answered = answered
        self._callers: dict[str, Caller] = {}
        self._wanted: dict[str, dict[str, Any]] = {}
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def ask(self, process: str, values: Mapping[str, Any]) -> None:
        """Queue a request to change values; without values, a request for the present values."""
        with self._changed:
            self._wanted.setdefault(process, {}).update(values)
            self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted or self._closed)
                if self._closed:
                    break
                process, values = self._wanted.popitem()
            self._answered(process, values, self._ask(process, values))
        for caller in self._callers.values():
            caller.close()

    def _ask(self, process: str, values: Mapping[str, Any]) -> Answer | None:
        try:
            caller = self._callers.pop(process, None) or Caller(self._folder / process)
            try:
                answer = caller.ask(values)
            except ControlError:
                caller.close()  # a late answer must not be taken for the answer to the next request
                raise
        except ControlError:
            return None
        self._callers[process] = caller
        return answer
