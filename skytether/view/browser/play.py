"""Changes that somebody asks for on the page, on their way to the processes that make them.

A slider that is dragged asks many times a second, and a process answers in its own time: of what
waits for a key only the newest is asked for. All of it goes through the control sockets
(`shell.control`), and so through the checks of a scenario.
"""

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from skytether.shared.core.change import Answer
from skytether.shell.control import Caller, ControlError

PROCESSES = ("server", "netem", "client")
"""Names of the processes, and of their sockets in a flight's folder."""

Answered = Callable[[str, Mapping[str, Any], Answer | None], None]


class Operator:
    """Asks the processes of a flight for changes, in a thread of its own.

    Args:
        folder: where their sockets are.
        answered: called in the thread with the name of a process, what it was asked for, and its
            answer, or None where there is none.
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
        """Ask a process for other values, soon; without any, for those that it has."""
        with self._changed:
            self._wanted.setdefault(process, {}).update(values)
            self._changed.notify()

    def close(self) -> None:
        """Ask for nothing more."""
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
                caller.close()  # an answer that comes yet is not that to the next request
                raise
        except ControlError:
            return None
        self._callers[process] = caller
        return answer
