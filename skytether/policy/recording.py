"""Recordings of a robot end as MCAP files, which Foxglove and Lichtblick can show.

    /answers       kind, waiting time, age of the chunk, remaining rows, and the actions
    /observation   numbers and texts of the observation, and its small arrays
    /images/KEY    each image as it was sent to the policy: foxglove.CompressedImage or RawImage
    /events        log events: foxglove.Log
    /link          observations sent, reports and chunks received, see `robot.LinkStep`
    /options       options of the robot end, when a program connects

The time of a message is the time of day. A thread encodes and writes the messages, so that no
answer waits for the disk.
"""

import queue
import threading
import time
from base64 import b64encode
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.policy.images import JPEG, VALUES_MAX, is_image, leaves
from skytether.policy.players import PLAYERS
from skytether.policy.robot import AnsweredCall, LinkStep, RobotOptions
from skytether.shared.base import files
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import Event
from skytether.shared.formats import foxglove

ACTIONS_MAX = 16_384
"""Largest number of elements of the actions in `/answers`."""
WAITING_MAX = 192
"""Largest number of messages that wait for the disk; further ones are not recorded."""
FLUSH_S, CHUNK_BYTES = 0.25, 16 * 1024
"""Interval at which complete chunks are written [s], and size of a chunk [B]. A killed process
loses the last chunk."""
CLOSING_S = 5.0
"""Longest time to wait for the disk at the end [s]."""
_ANSWER = {"call": "integer", "kind": "string", "waited_s": "number"}
_ANSWER |= {"chunk_age_s": "number", "left": "integer"}
_LINK = {"kind": "string", "call": "integer", "message": "integer", "parts": "integer"}
_LINK |= {"needed": "integer", "rows": "integer", "fault": "string"}
_OPTIONS = {"actions": "string", "deadline_ns": "integer", "hold_ns": "integer", "rows": "integer"}
_FIELDS = {"Answer": _ANSWER, "Link": _LINK, "Observation": {}, "Options": _OPTIONS}
SCHEMAS = {
    f"skytether.{name}": {
        "type": "object",
        "properties": {key: {"type": each} for key, each in fields.items()},
    }
    for name, fields in _FIELDS.items()
}


class CallRecording:
    """MCAP file of the calls of a robot program.

    Args:
        path: name of the file; an older file is replaced when the new one is complete.
        options: options of the robot end.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path, options: RobotOptions) -> None:
        self._growing, self._options = files.Growing(path), options
        self._channels = foxglove.Channels(self._growing.file, "skytether", CHUNK_BYTES)
        self._waiting: queue.Queue[Callable[[], None] | None] = queue.Queue(WAITING_MAX)
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._missed = 0
        self._fault = ""
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def note(self, call: AnsweredCall) -> None:
        """Record a call of the robot program and its answer."""
        self._put(partial(self._add_call, call))

    def step(self, now_ns: int, step: LinkStep) -> None:
        """Record an event of the link."""
        self._put(partial(self._add_step, now_ns, step))

    def hear(self, event: Event) -> None:
        """Record a log event."""
        self._put(partial(self._add_event, time.monotonic_ns(), str(event)))

    def close(self) -> str:
        """Complete the file; returns why the recording is incomplete, or an empty text."""
        with suppress(queue.Full):  # then the thread does not end in time
            self._waiting.put(None, timeout=CLOSING_S)
        self._thread.join(CLOSING_S)
        if self._thread.is_alive():
            return f"{self._growing.at}: the end was not written within {CLOSING_S:g} s: slow disk"
        try:
            self._growing.end(empty=not self._channels.numbers, whole=not self._fault)
        except OSError as error:
            self._fault = f"cannot be completed: {error.strerror}"
        if self._missed and not self._fault:
            self._fault = (
                f"{self._missed} messages are missing: slow disk, or values that JSON cannot hold"
            )
        return f"{self._growing.at}: {self._fault}" if self._fault else ""

    def _put(self, action: Callable[[], None]) -> None:
        try:
            self._waiting.put_nowait(action)
        except queue.Full:
            self._missed += 1

    def _work(self) -> None:
        """Write the messages until `close`; after a fault of the file, discard them."""
        actions = iter(self._waiting.get, None)
        try:
            flushed_s = time.monotonic()
            for action in actions:
                try:
                    action()
                except (TypeError, ValueError):
                    self._missed += 1
                if time.monotonic() - flushed_s >= FLUSH_S:
                    self._growing.file.flush()
                    flushed_s = time.monotonic()
            self._channels.writer.finish()
        except Exception as error:  # whatever it is, `close` must not wait for this thread
            self._fault = f"cannot be written: {error}"
            for _ in actions:
                pass

    def _add_call(self, call: AnsweredCall) -> None:
        self._channels.now_ns = call.time_ns - call.waited_ns + self._offset_ns
        numbers = dict[str, Any]()
        for name, value in leaves(call.sent):
            if isinstance(value, dict):
                data = b64encode(value[JPEG]).decode()
                image = {"frame_id": name, "data": data, "format": "jpeg"}
                self._channels.draw(f"/images/{name}", "CompressedImage", image)
            elif is_image(value):
                self._channels.draw(f"/images/{name}", "RawImage", _raw_image(name, value))
            else:
                numbers[name] = _small(value)
        if call.sent is not None:
            self._add("/observation", "Observation", numbers | {"call": call.number})
        self._channels.now_ns = call.time_ns + self._offset_ns
        rows = call.reply.get(self._options.key) if isinstance(call.reply, dict) else None
        answer = {
            "call": call.number,
            "kind": call.kind,
            "waited_s": call.waited_ns / SECOND_NS,
            "chunk_age_s": None if call.chunk_age_ns < 0 else call.chunk_age_ns / SECOND_NS,
            "left": call.left,
            "actions": _small(rows, ACTIONS_MAX),
        }
        self._add("/answers", "Answer", answer)

    def _add_step(self, now_ns: int, step: LinkStep) -> None:
        self._channels.now_ns = now_ns + self._offset_ns
        if step.kind == "program":
            named = {each: name for name, each in PLAYERS.items()}
            options = asdict(self._options) | {"player": named[self._options.player]}
            self._add("/options", "Options", options)
        self._add("/link", "Link", step)

    def _add_event(self, now_ns: int, sentence: str) -> None:
        self._channels.now_ns = now_ns + self._offset_ns
        log = foxglove.log("policy join", sentence, foxglove.INFO)
        self._channels.draw("/events", "Log", log)

    def _add(self, topic: str, kind: str, message: Any) -> None:
        name = f"skytether.{kind}"
        self._channels.put(topic, name, SCHEMAS[name], message)


def _raw_image(name: str, value: NDArray[Any]) -> dict[str, Any]:
    pixels = value if value.shape[2] == 3 else value.transpose(1, 2, 0)
    height, width = pixels.shape[:2]
    return {
        "frame_id": name,
        "width": width,
        "height": height,
        "encoding": "rgb8",
        "step": 3 * width,
        "data": b64encode(pixels.tobytes()).decode(),
    }


def _small(value: Any, most: int = VALUES_MAX) -> Any:
    """Value for JSON: an array of up to `most` elements as lists, other data by type and shape."""
    if isinstance(value, np.ndarray | np.generic):
        if value.size <= most and value.dtype.kind in "biuf":
            return value.tolist()
        return f"{value.dtype} {value.shape}"
    if isinstance(value, bool | int | float | str) or value is None:
        return value
    return type(value).__name__
