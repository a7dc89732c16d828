"""Flight on a page: its state, and requests to change it."""

import contextlib
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from skytether.shared.core.change import Answer
from skytether.shared.core.events import Changed
from skytether.shared.telemetry.feed import Frame, Opened, Said
from skytether.view import controls
from skytether.view.browser.play import PROCESSES, Operator
from skytether.view.state import LED, State


class PageFlight:
    """Flight on a page.

    Args:
        title: empty for a single flight.
        folder: folder of the control sockets; None if nothing can be changed.
    """

    def __init__(self, title: str = "", folder: Path | None = None) -> None:
        self.title = title
        self.state = State()
        self.lock = threading.Lock()
        self.values: dict[str, dict[str, Any]] = {}
        """Keys that may change and their known values, by process."""
        self.answer = ""
        self.refused = False
        self._before: dict[str, Any] = {}
        """Values to restore when the link is healed."""
        self.operator = Operator(folder, self._answered) if folder else None

    def take(self, process: str, frame: Frame) -> None:
        """Apply a frame to the state; a malformed frame is dropped."""
        with self.lock, contextlib.suppress(ValueError):
            self.state.take(process, frame)
        changed = (
            isinstance(frame, Said) and isinstance(frame.event, Changed) and frame.event.key != LED
        )
        if process in PROCESSES and (changed or isinstance(frame, Opened)):
            self.ask(process, {})

    def lose(self, process: str) -> None:
        with self.lock:
            self.state.lose(process)

    # -- changes -----------------------------------------------------------------------------

    def ask(self, process: str, values: Mapping[str, Any]) -> None:
        if self.operator:
            self.operator.ask(process, values)

    def _answered(self, process: str, asked: Mapping[str, Any], answer: Answer | None) -> None:
        if answer and answer.values:
            self.values[process] = answer.values
        elif answer and (answer.refused or LED not in asked):
            self.refused = bool(answer.refused)
            self.answer = answer.refused or "; ".join(map(str, answer.changed))
        elif asked and not answer:
            self.refused = True
            self.answer = f"{process} does not answer: the flight is over, or accepts no changes"

    @property
    def is_cut(self) -> bool:
        return controls.is_cut(self.values.get("netem", {}))

    def cut(self) -> None:
        values = self.values.get("netem")
        if values and not self.is_cut:
            changed = controls.cut(values)
            self._before = {key: values[key] for key in changed}
            self.ask("netem", changed)

    def heal(self) -> None:
        """Restore the loss from before the link was cut, or no loss if that is unknown."""
        if self.is_cut:
            self.ask("netem", self._before or controls.healed(self.values["netem"]))

    def close(self) -> None:
        if self.operator:
            self.operator.close()
