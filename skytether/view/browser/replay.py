"""Playback of recorded flights: forwards, at any speed, from any time."""

import threading
import time
from bisect import bisect_right
from collections.abc import Callable, Sequence
from heapq import merge
from typing import Any

import viser

from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.telemetry.feed import Frame, Opened
from skytether.view.browser.flight import PageFlight
from skytether.view.browser.panel import assign
from skytether.view.frames import Timed
from skytether.view.page.network import SPAN_S
from skytether.view.page.state import State

TICK_S = 0.04
"""Time between two batches of frames [s]."""
SPEEDS = ("0.25", "0.5", "1", "2", "4", "8", "16")
Placed = tuple[int, int, str, Frame]
"""Time of a frame since the first frame of its flight [ns], index of the flight, name of the
process, and the frame."""


class Player:
    def __init__(self, flights: Sequence[PageFlight], frames: Sequence[Sequence[Timed]]) -> None:
        self._flights = flights
        self._openings: list[Placed] = []
        self._frames: list[Placed] = []
        begin = []
        for flight_frames in frames:
            later = (
                time_ns for time_ns, _, frame in flight_frames if not isinstance(frame, Opened)
            )
            begin.append(next(later, 0))
        placed = (
            [(time_ns - begin[place], place, name, frame) for time_ns, name, frame in flight_frames]
            for place, flight_frames in enumerate(frames)
        )
        for each in merge(*placed, key=lambda item: item[0]):
            (self._openings if isinstance(each[3], Opened) else self._frames).append(each)
        self._begin_ns = begin[0] if begin else 0
        self._times_ns = [each[0] for each in self._frames]
        self.end_ns = self._times_ns[-1] if self._times_ns else 0
        """Time from the first frame to the last [ns]."""
        self._lock = threading.Lock()
        self._at_ns = 0
        self._next = 0
        self.speed = 1.0
        self.plays = True
        self._wanted_ns: int | None = None
        """Time that the user has requested, since the first frame [ns]; None once it is shown."""
        self.seek(0)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    @property
    def at_ns(self) -> int:
        """Time that the playback has reached, since the first frame [ns]."""
        return self._at_ns

    def now_ns(self) -> int:
        """Time that the playback has reached, on the clock of the first flight [ns]."""
        return self._begin_ns + self._at_ns

    def seek(self, at_ns: int) -> None:
        with self._lock:
            for flight in self._flights:
                with flight.lock:
                    flight.state = State()
            for _, place, process, frame in self._openings:
                self._flights[place].take(process, frame)
            self._next = bisect_right(self._times_ns, at_ns - seconds_to_ns(SPAN_S))
            self._go(at_ns)

    def advance(self, passed_ns: int) -> None:
        with self._lock:
            self._go(min(self._at_ns + passed_ns, self.end_ns))

    def _go(self, at_ns: int) -> None:
        until = bisect_right(self._times_ns, at_ns)
        for _, place, process, frame in self._frames[self._next : until]:
            self._flights[place].take(process, frame)
        self._next = max(self._next, until)
        self._at_ns = at_ns  # set last: until the frames are applied, the link would seem cut

    def _work(self) -> None:
        before_s = time.monotonic()
        while not self._closed.wait(TICK_S):
            now_s = time.monotonic()
            wanted_ns, self._wanted_ns = self._wanted_ns, None
            if wanted_ns is not None:
                self.seek(wanted_ns)
            elif self.plays:
                self.advance(round(self.speed * (now_s - before_s) * SECOND_NS))
            before_s = now_s

    def close(self) -> None:
        self._closed.set()
        self._thread.join()

    def controls(self, gui: viser.GuiApi) -> Callable[[], None]:
        """Add slider, speed and pause to a browser; the returned function updates them."""
        end_s = max(self.end_ns / SECOND_NS, 1.0)
        with gui.add_folder("Replay"):
            at = gui.add_slider("Time [s]", 0.0, end_s, 0.1, 0.0)
            speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1")
            pause = gui.add_button("Pause")
        moved_s = 0.0

        @at.on_update
        async def _(event: Any) -> None:
            nonlocal moved_s
            if event.client is not None:
                moved_s = time.monotonic()
                self._wanted_ns = seconds_to_ns(float(at.value))

        @speed.on_update
        def _(_: Any) -> None:
            self.speed = float(speed.value)

        @pause.on_click
        def _(_: Any) -> None:
            self.plays = not self.plays

        def show() -> None:
            pause.label = "Pause" if self.plays else "Go on"
            if time.monotonic() - moved_s > 1.0:
                assign(at, round(min(self._at_ns / SECOND_NS, end_s), 1))

        return show
