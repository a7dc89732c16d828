"""Flight on a page: its state, and requests to change it."""

import contextlib
import threading
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from skytether.shared.core.change import Answer
from skytether.shared.core.events import Changed
from skytether.shared.telemetry.feed import Frame, Opened, Said
from skytether.view import controls
from skytether.view.browser.play import NETEMS, PROCESSES, Operator
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
        self._before: dict[str, dict[str, Any]] = {}
        """Values to restore when a link is healed, by its netem."""
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
    def netems(self) -> list[str]:
        """Netems that have answered: one for each path."""
        return [each for each in NETEMS if each in self.values]

    @property
    def cuts(self) -> list[str]:
        """Netems that lose every packet."""
        return [each for each in self.netems if controls.is_cut(self.values[each])]

    def cut(self, netems: Collection[str] = NETEMS) -> None:
        for netem in self.netems:
            if netem in netems and netem not in self.cuts:
                values = self.values[netem]
                changed = controls.cut(values)
                self._before[netem] = {key: values[key] for key in changed}
                self.ask(netem, changed)

    def heal(self, netems: Collection[str] = NETEMS) -> None:
        """Restore the loss from before a link was cut, or no loss if that is unknown."""
        for netem in self.cuts:
            if netem in netems:
                self.ask(netem, self._before.get(netem) or controls.healed(self.values[netem]))

    def close(self) -> None:
        if self.operator:
            self.operator.close()
