"""ULog of PX4 (`.ulg`): the track of one vehicle.

Places are taken from `vehicle_global_position`, with altitudes above the sea; home is the first
`home_position`, or else the first place. In a log without global positions, places are taken from
`vehicle_local_position`, in metres from the estimator's start.
"""

import contextlib
import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base import extras
from skytether.shared.formats import Tracks
from skytether.shared.formats.geographic import Origin, above_sea
from skytether.shared.formats.timing import Line, together
from skytether.shared.law.model import Array

GLOBAL, LOCAL, HOME = "vehicle_global_position", "vehicle_local_position", "home_position"
READS_MAX, READS_LEAST, MESSAGE_BYTES = 4_000_000, 1000, 8
"""Largest and smallest limit of the number of reads of a log, and size of the smallest message [B].
A message takes two reads. The limit ends pyulog's endless loop in some damaged logs."""


class _Content(io.BytesIO):
    """Content of a log with a limited number of reads."""

    def __init__(self, content: bytes) -> None:
        super().__init__(content)
        self._left = min(READS_MAX, READS_LEAST + 2 * len(content) // MESSAGE_BYTES)

    def read(self, size: int | None = -1, /) -> bytes:
        self._left -= 1
        if self._left < 0:
            raise EOFError
        return super().read(size)


def tracks(content: bytes, axes: int, origin: Origin | None, speed_mps: float) -> Tracks:
    found = _messages(content)
    if GLOBAL in found:
        placed, times_ns = _global(found, axes, origin)
    elif LOCAL in found:
        own = found[LOCAL]
        ned = np.stack([own["x"], own["y"], own["z"]], axis=1).astype(np.float64)
        placed, times_ns = (ned * [1.0, 1.0, -1.0])[:, :axes], _times_ns(own)
    else:
        raise ValueError(f"expected a ULog with {GLOBAL} or {LOCAL}")
    return together([Line("the log", placed, times_ns)], speed_mps)


def axes_of(_: bytes) -> int:
    return 3


def _global(
    found: dict[str, Any], axes: int, origin: Origin | None
) -> tuple[Array, NDArray[np.int64]]:
    at = found[GLOBAL]
    places = np.stack([at["lon"], at["lat"], at["alt"]], axis=1).astype(np.float64)
    home_message = found.get(HOME, at)
    home = tuple(float(home_message[each][0]) for each in ("lat", "lon", "alt"))
    return above_sea(places, axes, origin, home), _times_ns(at)


def _times_ns(message: Any) -> NDArray[np.int64]:
    return 1000 * message["timestamp"].astype(np.int64)


def _messages(content: bytes) -> dict[str, Any]:
    """Fields of the wanted messages of a log, by the message's name; each field is an array."""
    with extras.named():
        from pyulog import ULog
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # pyulog prints skipped data
            log = ULog(_Content(content), [GLOBAL, LOCAL, HOME])
    except EOFError:
        most = f"of at most {READS_MAX // 2} messages"
        raise ValueError(f"expected a ULog {most}, or one without damage") from None
    except Exception as error:  # pyulog raises many kinds
        raise ValueError(f"expected a ULog ({type(error).__name__}: {error})") from None
    return {
        each.name: each.data
        for each in log.data_list
        if each.multi_id == 0 and len(each.data["timestamp"])
    }
