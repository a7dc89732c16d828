"""Recordings of a robot end as MCAP files, which Foxglove and Lichtblick can show.

    /answers       kind, waiting time, age of the chunk, remaining rows, and the actions
    /observation   numbers and texts of the observation, and its small arrays
    /images/KEY    each image as it was sent to the policy: foxglove.CompressedImage or RawImage
    /events        log events: foxglove.Log

The time of a message is the time of day. A thread encodes and writes the messages, so that no
answer waits for the disk.
"""

import queue
import threading
import time
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from mcap.writer import Writer

from skytether.policy.images import JPEG, is_image
from skytether.policy.robot import AnsweredCall
from skytether.shared.base import files
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import Event

VALUES_MAX = 256
"""Largest number of elements of an array in `/observation`; of a larger one the shape is given."""
ACTIONS_MAX = 16_384
"""Largest number of elements of the actions in `/answers`."""
WAITING_MAX = 64
"""Largest number of messages that wait for the disk; further ones are not recorded."""
FLUSH_S, CHUNK_BYTES = 0.25, 16 * 1024
"""Interval at which complete chunks are written [s], and size of a chunk [B]. A killed process
loses the last chunk."""
CLOSING_S = 5.0
"""Longest time to wait for the disk at the end [s]."""
INFO = 2
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_BYTES = {"type": "string", "contentEncoding": "base64"}
_SCHEMAS: dict[str, dict[str, Any]] = {
    "foxglove.CompressedImage": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "data": _BYTES,
        "format": {"type": "string"},
    },
    "foxglove.RawImage": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "width": {"type": "integer"},
        "height": {"type": "integer"},
        "encoding": {"type": "string"},
        "step": {"type": "integer"},
        "data": _BYTES,
    },
    "foxglove.Log": {
        "timestamp": _TIME,
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer"},
    },
    "skytether.Answer": {
        "call": {"type": "integer"},
        "kind": {"type": "string"},
        "waited_s": {"type": "number"},
        "chunk_age_s": {"type": "number"},
        "left": {"type": "integer"},
    },
    "skytether.Observation": {},
}


class CallRecording:
    """MCAP file of the calls of a robot program.

    Args:
        path: name of the file; an older file is replaced when the new one is complete.
        key: key of the actions in the policy's reply.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path, key: str) -> None:
        self._growing, self._key = files.Growing(path), key
        self._writer = Writer(self._growing.file, chunk_size=CHUNK_BYTES, enable_data_crcs=True)
        self._writer.start(profile="", library="skytether")
        self._channels: dict[tuple[str, str], int] = {}
        self._waiting: queue.Queue[Callable[[], None] | None] = queue.Queue(WAITING_MAX)
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._now_ns = 0
        self._missed = 0
        self._fault = ""
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def note(self, call: AnsweredCall) -> None:
        """Record a call of the robot program and its answer."""
        self._put(partial(self._add_call, call))

    def hear(self, event: Event) -> None:
        """Record a log event."""
        self._put(partial(self._add_event, time.monotonic_ns(), str(event)))

    def close(self) -> str:
        """Complete the file; returns why the recording is incomplete, or an empty text."""
        with suppress(queue.Full):  # then the thread does not end in time
            self._waiting.put(None, timeout=CLOSING_S)
        self._thread.join(CLOSING_S)
        if self._thread.is_alive():
            return f"{self._growing.at}: the disk has not taken the end within {CLOSING_S:g} s"
        try:
            self._growing.end(empty=not self._channels, whole=not self._fault)
        except OSError as error:
            self._fault = f"cannot be completed: {error.strerror}"
        if self._missed and not self._fault:
            self._fault = f"{self._missed} messages are missing: slow disk, or a value has no JSON"
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
            self._writer.finish()
        except Exception as error:  # whatever it is, `close` must not wait for this thread
            self._fault = f"cannot be written: {error}"
            for _ in actions:
                pass

    def _add_call(self, call: AnsweredCall) -> None:
        self._now_ns = call.time_ns - call.waited_ns + self._offset_ns
        numbers = dict[str, Any]()
        for name, value in _leaves(call.sent, ""):
            if image := _image(value):
                schema, content = image
                self._add_drawn(f"/images/{name}", schema, {"frame_id": name, **content})
            else:
                numbers[name] = _small(value)
        if call.sent is not None:
            self._add("/observation", "skytether.Observation", numbers | {"call": call.number})
        self._now_ns = call.time_ns + self._offset_ns
        rows = call.reply.get(self._key) if isinstance(call.reply, dict) else None
        answer = {
            "call": call.number,
            "kind": call.kind,
            "waited_s": call.waited_ns / SECOND_NS,
            "chunk_age_s": None if call.chunk_age_ns < 0 else call.chunk_age_ns / SECOND_NS,
            "left": call.left,
            "actions": _small(rows, ACTIONS_MAX),
        }
        self._add("/answers", "skytether.Answer", answer)

    def _add_event(self, now_ns: int, sentence: str) -> None:
        self._now_ns = now_ns + self._offset_ns
        log = {"level": INFO, "message": sentence, "name": "policy join", "file": "", "line": 0}
        self._add_drawn("/events", "foxglove.Log", log)

    def _add_drawn(self, topic: str, schema: str, content: Mapping[str, Any]) -> None:
        sec, nsec = divmod(self._now_ns, SECOND_NS)
        self._add(topic, schema, {"timestamp": {"sec": sec, "nsec": nsec}, **content})

    def _add(self, topic: str, schema: str, content: Mapping[str, Any]) -> None:
        if (topic, schema) not in self._channels:
            table = {"title": schema, "type": "object", "properties": _SCHEMAS[schema]}
            number = self._writer.register_schema(schema, "jsonschema", msgspec.json.encode(table))
            channel = self._writer.register_channel(topic, "json", number)
            self._channels[topic, schema] = channel
        data = msgspec.json.encode(content)
        self._writer.add_message(self._channels[topic, schema], self._now_ns, data, self._now_ns)


def _leaves(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Keys and values of an observation, as `images` names them; a JPEG image is one value."""
    if isinstance(value, dict) and JPEG not in value:
        for name, each in value.items():
            yield from _leaves(each, f"{key}/{name}" if key else str(name))
    elif isinstance(value, list) and len(value) <= VALUES_MAX:
        for i, each in enumerate(value):
            yield from _leaves(each, f"{key}/{i}")
    elif value is not None:
        yield key, value


def _image(value: Any) -> tuple[str, dict[str, Any]] | None:
    """Schema and content of an image's message; None if the value is not an image."""
    if isinstance(value, dict):
        data = b64encode(value[JPEG]).decode()
        return "foxglove.CompressedImage", {"data": data, "format": "jpeg"}
    if not is_image(value):
        return None
    pixels = value if value.shape[2] == 3 else value.transpose(1, 2, 0)
    height, width = pixels.shape[:2]
    return "foxglove.RawImage", {
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
