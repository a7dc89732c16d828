"""Flight on a page: its state, and requests to change it."""

import contextlib
import threading
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import msgspec

from skytether.shared.endpoints.change import Answer
from skytether.shared.events.flight import Changed
from skytether.shared.scenario.catalogue import DECISIONS
from skytether.shared.telemetry.feed import Frame, Opened, Said
from skytether.shell.driving.control import NETEMS, PROCESSES
from skytether.shell.host.compiling import progress
from skytether.view.browser.play import Operator
from skytether.view.page import controls
from skytether.view.page.changes import Mark, mark, together
from skytether.view.page.state import LIVE_POINT, State

FINAL = {*DECISIONS, "armed"}
"""Keys whose changes the page cannot undo: decisions (`DECISIONS`), and `armed`, which may end
a flight."""


class PageFlight:
    """Flight on a page: its state, and requests to its processes.

    Args:
        title: empty for a single flight.
        folder: folder of the control sockets; None if nothing can be changed.
    """

    def __init__(self, title: str = "", folder: Path | None = None) -> None:
        self.title, self._folder = title, folder
        self.state = State()
        self.lock = threading.Lock()
        self.values: dict[str, dict[str, Any]] = {}
        """Keys that may change and their newest values, by process."""
        self.answer = ""
        self.refused = False
        self.asked: frozenset[str] = frozenset()
        """Keys that the newest answered request named."""
        self._opened_ns: dict[str, int] = {}
        """Start time of each process on its clock [ns]; a new start time means a new process."""
        self._before: dict[str, dict[str, Any]] = {}
        """Values that the keys changed by a cut had before the cut, by netem and key; `heal`
        restores these values."""
        self.operator = Operator(folder, self._answered) if folder else None

    def take(self, process: str, frame: Frame) -> None:
        """Apply a frame to the state; a malformed frame is dropped."""
        with self.lock, contextlib.suppress(ValueError):
            self.state.take(process, frame)
        changed = (
            isinstance(frame, Said)
            and isinstance(frame.event, Changed)
            and frame.event.key != LIVE_POINT
        )
        if isinstance(frame, Opened) and self._opened_ns.get(process) != frame.time_ns:
            self._opened_ns[process] = frame.time_ns
            # Otherwise `undo` and `heal` would send values of the earlier process to the new one.
            self.values.pop(process, None)
            self._before.pop(process, None)
        is_asked = process in PROCESSES or self.state.role(process) == "client"
        if is_asked and (changed or isinstance(frame, Opened)):
            self.ask(process, {})

    def lose(self, process: str) -> None:
        with self.lock:
            self.state.lose(process)
        self.values.pop(process, None)

    @property
    def waits(self) -> str:
        """Text that says what a flight waits for before it begins."""
        return progress(self._folder) or f"{self.title} No process of the flight has sent data yet."

    # -- changes -----------------------------------------------------------------------------

    def ask(self, process: str, values: Mapping[str, Any]) -> None:
        if self.operator:
            self.operator.ask(process, values)

    def _answered(self, process: str, asked: Mapping[str, Any], answer: Answer | None) -> None:
        if answer and answer.values:
            self.values[process] = answer.values
        elif answer and (answer.refused or LIVE_POINT not in asked):
            changed = {(process, each.key): each for each in answer.changed}
            self._say(asked, answer.refused or together(changed, 1), refused=bool(answer.refused))
        elif asked and not answer:
            silent = f"{process} does not answer: the flight is over, or accepts no changes"
            self._say(asked, silent, refused=True)

    def _say(self, asked: Collection[str], answer: str, *, refused: bool) -> None:
        self.asked, self.answer, self.refused = frozenset(asked), answer, refused

    @property
    def undoable(self) -> dict[tuple[str, str], Changed]:
        """Newest change, by process and key, if this page can undo it."""
        changed = {
            place: event
            for place, event in self.state.changed.items()
            if place[0] in self.values and event.key not in FINAL
        }
        return changed if len(changed) == len(self.state.changed) else {}

    @property
    def undo_cuts(self) -> bool:
        """Whether `undo` would make a netem lose every packet."""
        return any(mark(event) is Mark.HEALED for event in self.undoable.values())

    def undo(self) -> None:
        """Request the values from before the newest change."""
        before: dict[str, dict[str, Any]] = {}
        for (process, key), event in self.undoable.items():
            before.setdefault(process, {})[key] = msgspec.json.decode(event.before)
        for process, values in before.items():
            self.ask(process, values)

    def processes(self, role: str) -> list[str]:
        """Processes of a role that have answered; the role's name if none has."""
        return [each for each in list(self.values) if self._role(each) == role] or [role]

    def of_role(self, role: str) -> dict[str, Any]:
        """Values of the first process of a role; empty if none has answered."""
        return self.values.get(self.processes(role)[0], {})

    def client(self, vehicle: int) -> str:
        """Name of the client process that flies a vehicle."""
        track = self.state.vehicles.get(vehicle)
        return (track.client if track else "") or self.processes("client")[0]

    def _role(self, process: str) -> str:
        return self.state.role(process) or process.partition(" ")[0]

    @property
    def netems(self) -> list[str]:
        """Netems that have answered: one for each path."""
        return [each for each in NETEMS if each in self.values]

    @property
    def cuts(self) -> list[str]:
        """Names of the netems that lose every packet."""
        return [each for each in self.netems if controls.is_cut(self.values[each])]

    def cut(self, netems: Collection[str] = NETEMS) -> None:
        for netem in self.netems:
            if netem in netems and netem not in self.cuts:
                values = self.values[netem]
                changed = controls.cut(values)
                self._before[netem] = {key: values[key] for key in changed}
                self.ask(netem, changed)

    def heal(self, netems: Collection[str] = NETEMS) -> None:
        """Restore a cut link's earlier loss; if the earlier loss is unknown, set no loss."""
        for netem in self.cuts:
            if netem in netems:
                self.ask(netem, self._before.get(netem) or controls.healed(self.values[netem]))

    def close(self) -> None:
        if self.operator:
            self.operator.close()
