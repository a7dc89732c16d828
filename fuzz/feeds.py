"""Targets for feeds: decoding a process's feed, and showing it on a page."""

import io
from collections.abc import Sequence
from contextlib import suppress
from random import Random
from types import ModuleType

from fuzz.mutators import bytes_changed
from fuzz.target import SCENARIO, flown
from fuzz.texts import Text
from skytether.shared.telemetry import feed
from skytether.shared.telemetry.feed import FeedError, Frame, Opened, Reader
from skytether.shared.telemetry.record import DOWNLINK, UPLINK
from skytether.view import rows
from skytether.view.frames import of_flight
from skytether.view.page import state
from skytether.view.page.state import State
from skytether.view.recordings import recording
from skytether.view.recordings.recording import About, Recording

PIECES = 3
"""Number of pieces into which a feed is split."""
EACH = 12
"""Number of frames of each process and kind among the seeds."""
LIFE = 300
"""Number of feeds after which the page starts again."""
ABOUT = About(scenario="demo", seed=1, version="1", began="", offset_ns=0, secure=False)
POINTS = 50


class FeedTarget(Text):
    """Target for a process's feed in pieces: a feed raises `FeedError`, or its frames can be
    encoded again.
    """

    code: Sequence[ModuleType] = (feed,)

    def __init__(self) -> None:
        kinds: dict[tuple[str, str, str], list[Frame]] = {}
        for _, process, frame in of_flight(SCENARIO, "demo", flown()):
            kind = process, type(frame).__name__, getattr(frame, "part", "")
            kinds.setdefault(kind, []).append(frame)
        self.frames = {kind: frames[-EACH:] for kind, frames in kinds.items()}
        """Frames of a flight by process, type and part."""
        each = [feed.encode(frame) for frames in self.frames.values() for frame in frames]
        super().__init__([*each, b"".join(each[:5])])

    def mutated(self, rng: Random, payload: bytes) -> bytes:
        """Feed with changed bytes or words; the length of its first frame is often corrected."""
        if rng.random() < 0.5:
            changed = bytes_changed(rng, payload, self.largest)
        else:
            changed = super().mutated(rng, payload)
        if rng.random() < 0.7:
            body = changed[feed.LENGTH_BYTES :]
            changed = len(body).to_bytes(feed.LENGTH_BYTES, "big") + body
        return changed

    def __call__(self, payload: bytes) -> None:
        whole, size = read(payload), len(payload) // PIECES + 1
        pieces = [payload[size * i : size * (i + 1)] for i in range(PIECES)]
        # Compared as texts, because figures may be NaN, which is not equal to itself.
        assert repr(read(*pieces)) == repr(whole), payload.hex()
        for frame in whole or ():
            assert read(feed.encode(frame)) is not None, payload.hex()
            for described in frame.parts.values() if isinstance(frame, Opened) else ():
                with suppress(FeedError):
                    feed.table(payload, feed.columns_of(described))


class PageTarget(FeedTarget):
    """Target for page and recording: frames of a feed are refused, or shown and recorded."""

    code = (recording, rows, state)

    def __init__(self) -> None:
        super().__init__()
        self._heard = LIFE

    def __call__(self, payload: bytes) -> None:
        """Process a feed's frames, as if from each process; show the state, and record it."""
        if self._heard == LIFE:
            self._begin()
        self._heard += 1
        for frame in read(payload) or ():
            for process in ("client", "server", "netem"):
                with suppress(ValueError):
                    self._state.take(process, frame)
                with suppress(ValueError):
                    self._recording.add(process, frame)
        self._show()

    def _begin(self) -> None:
        self._heard, self._state = 0, State()
        self._recording = Recording(io.BytesIO(), SCENARIO, ABOUT)
        for (process, *_), frames in self.frames.items():
            for frame in frames:
                self._state.take(process, frame)
                self._recording.add(process, frame)

    def _show(self) -> None:
        shown, now_ns = self._state, self._state.newest_ns
        assert shown.title is not None
        assert len(shown.vehicles) <= state.VEHICLES_MAX
        for number, track in shown.vehicles.items():
            assert len(track.curves(POINTS).time_s) == POINTS
            assert track.ahead().shape[1] == track.trail().shape[1]
            assert track.does.text
            assert shown.link(number, now_ns).text
        for direction in (UPLINK, DOWNLINK):
            shown.network.traffic(direction, 1.0, now_ns)
            shown.network.histogram(direction, now_ns)
            shown.network.delays_s(direction, now_ns)


def read(*pieces: bytes) -> list[Frame] | None:
    """Frames of a feed; None if the bytes are not a feed."""
    reader = Reader()
    try:
        return [frame for piece in pieces for frame in reader.read(piece)]
    except FeedError:
        return None
