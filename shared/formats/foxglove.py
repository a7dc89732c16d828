"""MCAP files for Foxglove and Lichtblick: messages that both programs draw, and their JSON schemas.

All positions are in the frame WORLD: metres, third axis up. The schemas use only objects, lists and
single types, and no nested lists, because both programs support no more. The module needs the extra
`record`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO

import msgspec
from mcap.writer import Writer

from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array

WORLD = "world"
INFO, WARNING = 2, 3

Json = dict[str, Any]


def _object(**properties: Any) -> Json:
    return {"type": "object", "properties": properties}


def _several(items: Json) -> Json:
    return {"type": "array", "items": items}


_NUMBER, _WHOLE = {"type": "number"}, {"type": "integer"}
_TEXT, _FLAG = {"type": "string"}, {"type": "boolean"}
_BYTES = {"type": "string", "contentEncoding": "base64"}
_TIME = _object(sec=_WHOLE, nsec=_WHOLE)
_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_COLOR = _object(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_POSE = _object(position=_VECTOR, orientation=_QUATERNION)
_ARROW = _object(
    pose=_POSE,
    shaft_length=_NUMBER,
    shaft_diameter=_NUMBER,
    head_length=_NUMBER,
    head_diameter=_NUMBER,
    color=_COLOR,
)
_SPHERE = _object(pose=_POSE, size=_VECTOR, color=_COLOR)
_LINE = _object(
    type=_WHOLE,
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_FLAG,
    points=_several(_VECTOR),
    color=_COLOR,
    colors=_several(_COLOR),
    indices=_several(_WHOLE),
)
_TEXT_IN_SPACE = _object(
    pose=_POSE, billboard=_FLAG, font_size=_NUMBER, scale_invariant=_FLAG, color=_COLOR, text=_TEXT
)
_ENTITY = _object(
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_TIME,
    frame_locked=_FLAG,
    metadata=_several(_object(key=_TEXT, value=_TEXT)),
    arrows=_several(_ARROW),
    spheres=_several(_SPHERE),
    lines=_several(_LINE),
    texts=_several(_TEXT_IN_SPACE),
)
_DELETION = _object(timestamp=_TIME, type=_WHOLE, id=_TEXT)

SCHEMAS: Mapping[str, Json] = {
    "foxglove.PoseInFrame": _object(timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
    "foxglove.FrameTransform": _object(
        timestamp=_TIME,
        parent_frame_id=_TEXT,
        child_frame_id=_TEXT,
        translation=_VECTOR,
        rotation=_QUATERNION,
    ),
    "foxglove.SceneUpdate": _object(deletions=_several(_DELETION), entities=_several(_ENTITY)),
    "foxglove.Log": _object(
        timestamp=_TIME, level=_WHOLE, message=_TEXT, name=_TEXT, file=_TEXT, line=_WHOLE
    ),
    "foxglove.CompressedImage": _object(timestamp=_TIME, frame_id=_TEXT, data=_BYTES, format=_TEXT),
    "foxglove.RawImage": _object(
        timestamp=_TIME,
        frame_id=_TEXT,
        width=_WHOLE,
        height=_WHOLE,
        encoding=_TEXT,
        step=_WHOLE,
        data=_BYTES,
    ),
}

VEHICLE_M, POINT_M, LINE_M = 0.12, 0.09, 0.015
"""Sizes of a vehicle and a point, and thickness of a line [m]."""
BLUE, RED, GREY, GREEN = (
    {"r": red, "g": green, "b": blue, "a": 1.0}
    for red, green, blue in ((0.1, 0.5, 0.9), (0.85, 0.2, 0.2), (0.55, 0.55, 0.55), (0.2, 0.7, 0.3))
)
"""Colours of a vehicle, of its desired position, of the trajectory, and of a plan."""


class Channels:
    """Channels of an MCAP file; a channel and its schema are written before its first message.

    Args:
        library: name of the writing library.
        chunk_bytes: size of a chunk [B].
    """

    def __init__(self, file: BinaryIO, library: str, chunk_bytes: int) -> None:
        self.writer = Writer(file, chunk_size=chunk_bytes, enable_data_crcs=True)
        self.writer.start(profile="", library=library)
        self.now_ns = 0
        """Time of the next messages [ns]."""
        self.numbers: dict[tuple[str, str], int] = {}
        """Number of each channel, by topic and name of its schema."""
        self._schemas: dict[bytes, int] = {}

    def draw(self, topic: str, kind: str, message: Mapping[str, Any]) -> None:
        """Add a message foxglove.KIND, with its timestamp."""
        schema = SCHEMAS[f"foxglove.{kind}"]
        if "timestamp" in schema["properties"]:
            message = {"timestamp": _time(self.now_ns), **message}
        self.put(topic, f"foxglove.{kind}", schema, message)

    def put(self, topic: str, name: str, schema: Mapping[str, Any], message: Any) -> None:
        """Add a message as JSON; `name` is the name of its schema."""
        number = 0
        if (topic, name) not in self.numbers:
            encoded = msgspec.json.encode({"title": name, **schema})
            if encoded not in self._schemas:
                number = self.writer.register_schema(name, "jsonschema", encoded)
                self._schemas[encoded] = number
            number = self._schemas[encoded]
        self.add(topic, "json", msgspec.json.encode(message), name, number)

    def add(
        self, topic: str, encoding: str, content: bytes, name: str = "", schema: int = 0
    ) -> None:
        """Add an encoded message; `schema` is the number of its schema, 0 if it has none."""
        if (topic, name) not in self.numbers:
            number = self.writer.register_channel(topic, encoding, schema)
            self.numbers[topic, name] = number
        self.writer.add_message(self.numbers[topic, name], self.now_ns, content, self.now_ns)


def log(process: str, message: str, level: int) -> Json:
    return {"level": level, "message": message, "name": process, "file": "", "line": 0}


def pose_in_frame(state: Array) -> Json:
    """Message foxglove.PoseInFrame: a vehicle, heading in its direction of motion.

    Args:
        state: position [m] and velocity [m/s]; shape (axes, 2).
    """
    return {"frame_id": WORLD, "pose": _pose(state)}


def transform(vehicle: str, state: Array) -> Json:
    """Message foxglove.FrameTransform: the frame of a vehicle, which a 3D view can follow."""
    pose = _pose(state)
    return {
        "parent_frame_id": WORLD,
        "child_frame_id": vehicle,
        "translation": pose["position"],
        "rotation": pose["orientation"],
    }


def vehicle(time_ns: int, name: str, state: Array) -> Json:
    """Message foxglove.SceneUpdate: a vehicle as a sphere, with an arrow of its motion in 1 s."""
    pose, speed = _pose(state), float(math.hypot(*state[:2, 1]))
    arrow = {
        "pose": pose,
        "shaft_length": 0.8 * speed,
        "shaft_diameter": 0.2 * VEHICLE_M,
        "head_length": 0.2 * speed,
        "head_diameter": 0.4 * VEHICLE_M,
        "color": BLUE,
    }
    return _scene(time_ns, name, spheres=[_sphere(pose, VEHICLE_M, BLUE)], arrows=[arrow])


def point(time_ns: int, name: str, state: Array) -> Json:
    return _scene(time_ns, name, spheres=[_sphere(_pose(state), POINT_M, RED)])


def line(time_ns: int, name: str, positions: Array, color: Json) -> Json:
    drawn = {
        "type": 0,
        "pose": {"position": _vector(()), "orientation": _facing(0.0)},
        "thickness": LINE_M,
        "scale_invariant": False,
        "points": [_vector(each) for each in positions.tolist()],
        "color": color,
        "colors": [],
        "indices": [],
    }
    return _scene(time_ns, name, lines=[drawn])


def _scene(time_ns: int, name: str, **primitives: Any) -> Json:
    entity = {
        "timestamp": _time(time_ns),
        "frame_id": WORLD,
        "id": name,
        "lifetime": _time(0),
        "frame_locked": False,
        "metadata": [],
        "arrows": [],
        "spheres": [],
        "lines": [],
        "texts": [],
    }
    return {"deletions": [], "entities": [entity | primitives]}


def _sphere(pose: Json, size_m: float, color: Json) -> Json:
    return {"pose": pose, "size": {"x": size_m, "y": size_m, "z": size_m}, "color": color}


def _pose(state: Array) -> Json:
    (_, v_x), (_, v_y) = state[:2].tolist()
    yaw = math.atan2(v_y, v_x) if v_x or v_y else 0.0
    return {"position": _vector(state[:, 0].tolist()), "orientation": _facing(yaw)}


def _facing(yaw: float) -> Json:
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def _vector(numbers: Sequence[float]) -> Json:
    return dict(zip("xyz", (*numbers, 0.0, 0.0, 0.0), strict=False))


def _time(time_ns: int) -> Json:
    sec, nsec = divmod(time_ns, SECOND_NS)
    return {"sec": sec, "nsec": nsec}
