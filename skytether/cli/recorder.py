"""Recorders of flights; a flight over UDP is recorded from the feeds of its processes."""

import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import msgspec

from skytether.shared.base import files, toml
from skytether.shared.events.flight import RecordIncomplete
from skytether.shared.scenario.reading import check as checked
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.feed import Frame, Opened, Rows
from skytether.shared.telemetry.record import RECORDING, Record
from skytether.shared.telemetry.summary import Summary
from skytether.shell.commandline import command, plugins
from skytether.shell.commandline.command import CommandError
from skytether.shell.driving.feed import Subscriber
from skytether.shell.processes.recorder_process import RecorderOrder
from skytether.view.frames import of_flight
from skytether.view.recordings.recording import About, Recording

FLUSH_S = 0.25
"""Interval at which new frames are written [s]. A killed process loses the last interval."""
PATIENCE_S = 3.0
"""Longest time to wait at the end for the rest of the feeds [s]."""


def check(path: Path, flag: str = "--record") -> None:
    """Refuse a file name without the suffix of a recording, before the flight begins."""
    if path.suffix != RECORDING:
        message = f"{flag}: got {path}, expected a file that ends in {RECORDING}"
        raise CommandError(message, command.CONFIGURATION)


def write(path: Path, scenario: Scenario, name: str, flown: Record, summary: Summary) -> str | None:
    """Record a flight in virtual time after its end; returns why the recording failed, or None."""
    about = _about(scenario, name, began=None, offset_ns=0, secure=summary.secure)
    try:
        with files.replacing(path) as file:
            recording = Recording(file, scenario, about)
            for _, process, frame in of_flight(scenario, name, flown):
                recording.add(process, frame)
            recording.finish(summary)
    except OSError as error:
        return f"{path}: cannot be written: {error.strerror}"
    return None


def _about(
    scenario: Scenario, name: str, *, began: datetime | None, offset_ns: int, secure: bool
) -> About:
    return About(
        scenario=name,
        seed=scenario.seed,
        version=metadata.version("skytether"),
        began=began.isoformat(timespec="seconds") if began else "",
        offset_ns=offset_ns,
        secure=secure,
    )


def beside() -> int:
    """Record a process's feed, as the `RecorderOrder` on stdin says, until stdin ends."""
    order = msgspec.json.decode(sys.stdin.buffer.readline(), type=RecorderOrder)
    plugins.load(order.plugins)
    scenario = checked(toml.loads(order.scenario), any_network=True)
    path, feeds = Path(order.path), {order.process: Path(order.feed)}
    live = Live(path, feeds, scenario, order.name, secure=order.secure, tell=lambda _: None)
    print("it reads", flush=True)
    sys.stdin.buffer.read()
    fault = live.finish()
    if fault:
        print(fault, file=sys.stderr)
    return 1 if fault else 0


@dataclass(slots=True)
class _Source:
    begun: bool = False
    ended: bool = False
    """Whether the feed has ended and has not been opened again since."""
    resumed: bool = False
    """Whether the next frames may repeat earlier ones."""
    last_ns: int = 0
    newest: list[Frame] = field(default_factory=list)

    def is_new(self, frame: Frame) -> bool:
        """Whether a frame is new; a feed that is opened again repeats its last frames."""
        if frame.time_ns < self.last_ns or frame in self.newest:
            return False
        if frame.time_ns > self.last_ns:
            self.last_ns = frame.time_ns
            self.newest.clear()
        self.newest.append(frame)
        return True


class Live:
    """Recorder of a flight over UDP, in its own threads, so that the flight never waits for it.

    A slow disk blocks only these threads: processes then drop feeds that are not read in time, and
    the recording is reported as incomplete.

    Args:
        path: file of the recording.
        feeds: socket of each process's feed, by process name.
        name: name of the scenario.
        secure: whether the link is encrypted.
        tell: called once, in any thread, when the recording becomes incomplete.
    """

    def __init__(
        self,
        path: Path,
        feeds: Mapping[str, Path],
        scenario: Scenario,
        name: str,
        *,
        secure: bool,
        tell: Callable[[RecordIncomplete], None],
    ) -> None:
        self._path = path
        self._tell = tell
        self._fault: str | None = None
        """First fault of the recording."""
        self._growing: files.Growing | None = None
        self._recording: Recording | None = None
        """Recording being written; None once its file has failed."""
        self._rows: dict[str, int] = {}
        """Bytes of rows received so far, by part."""
        self._sources = {process: _Source() for process in feeds}
        self._changed = threading.Condition()
        self._closed = threading.Event()
        self._flusher = threading.Thread(target=self._flush, daemon=True)
        began, offset_ns = datetime.now(UTC), time.time_ns() - time.monotonic_ns()
        about = _about(scenario, name, began=began, offset_ns=offset_ns, secure=secure)
        try:
            self._growing = files.Growing(path)
            self._path = self._growing.at
            self._recording = Recording(self._growing.file, scenario, about)
        except OSError as error:
            self._miss(error.strerror or str(error))
        self._flusher.start()
        self._subscriber = Subscriber(feeds, self._take, self._lost)

    def finish(self, summary: Summary | None = None, flown: Record | None = None) -> str | None:
        """Complete the file after the end of the processes; returns why it is incomplete, or None.

        Further calls return the same text.

        Args:
            summary: summary of the flight, if there is one.
            flown: record of the flight, to compare the recording with.
        """
        if not self._closed.is_set():
            with self._changed:
                self._changed.wait_for(self._all_ended, PATIENCE_S)
            self._subscriber.close()
            self._closed.set()
            self._flusher.join()
            if flown is not None:
                self._compare(flown)
            self._write(lambda recording: recording.finish(summary))
            if self._growing:
                try:
                    self._growing.end(empty=not self._rows, whole=self._fault is None)
                except OSError as error:
                    self._miss(error.strerror or str(error))
        return f"{self._path}: {self._fault}" if self._fault else None

    def _all_ended(self) -> bool:
        return all(source.ended or not source.begun for source in self._sources.values())

    def _compare(self, flown: Record) -> None:
        for part, rows in (
            ("client", flown.client),
            ("server", flown.server),
            ("netem", flown.netem),
        ):
            count = self._rows.get(part, 0) // rows.dtype.itemsize
            if count < len(rows):
                self._miss(f"{count} of {len(rows)} rows of {part} are recorded")

    def _take(self, process: str, frame: Frame) -> None:
        source = self._sources[process]
        if isinstance(frame, Opened):
            source.ended, source.resumed = False, source.begun
            if source.begun:
                return
            source.begun = True
        else:
            if source.resumed and frame.time_ns > source.last_ns:
                self._miss(f"the recorder could not keep up with {process}")
            source.resumed = False
            if not source.is_new(frame):
                return
        if isinstance(frame, Rows):
            self._rows[frame.part] = self._rows.get(frame.part, 0) + len(frame.rows)
        self._write(lambda recording: recording.add(process, frame))

    def _lost(self, process: str) -> None:
        with self._changed:
            self._sources[process].ended = True
            self._changed.notify()

    def _flush(self) -> None:
        while not self._closed.wait(FLUSH_S):
            self._write(Recording.flush)

    def _write(self, action: Callable[[Recording], None]) -> None:
        """Call a method of the recording, unless its file has failed already."""
        with self._changed:
            if self._recording is None:
                return
            try:
                action(self._recording)
            except OSError as error:
                self._recording = None
                self._miss(error.strerror or str(error))
            # The process sent rows that do not match the columns that it announced.
            except ValueError as error:
                self._miss(str(error))

    def _miss(self, reason: str) -> None:
        """Keep the first fault, and report it once."""
        if self._fault is None:
            self._fault = reason
            self._tell(RecordIncomplete(file=str(self._path), reason=reason))


if __name__ == "__main__":
    sys.exit(beside())
