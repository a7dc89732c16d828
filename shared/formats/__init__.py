"""Files of other programs: tracks, zones, recorded links, and recordings for Foxglove.

    skyc, kml, tables, plan, waypoints, ulog, dataflash, gpx  tracks of vehicles, one module each
    tracks, timing         tracks for a scenario: one clock, or a speed where a file has no times
    shapes                 `csv`, `mission` and `show`, in the table REFERENCES
    zones                  `geojson`, `kml` and `plan`, in the table ZONES; `zone_files`, `plans`
    recorded, pings        recorded links, for `trace` of netem and for the probe
    foxglove               MCAP files with messages that Foxglove draws
    bounded, geographic    files read within bounds; coordinates of the globe

Each module for a format of tracks is a `Format`. It is imported when a file of that format is read.
The package imports `shared.missions`, `shared.scenario`, `shared.law` and `shared.base`; ULog needs
the extra `ulog`, and `foxglove` the extra `record`.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any, Protocol

from skytether.shared.formats import bounded
from skytether.shared.formats.geographic import Origin
from skytether.shared.law.model import Array

Tracks = dict[int, tuple[Array, Array]]
"""By number of the vehicle: rising times from 0 [s; shape (n,)], points [m; shape (n, axes)]."""
BOM = b"\xef\xbb\xbf"
HEAD_BYTES = 4096
"""Size of a file's beginning from which its format is recognised [B]."""


class Format(Protocol):
    """Module that reads a file format."""

    def tracks(
        self, content: bytes, axes: int, origin: Origin | None, speed_mps: float, /
    ) -> Tracks:
        """Tracks in a file.

        Args:
            axes: number of axes of the points.
            origin: origin of the scenario; (): use the file's origin, if any; None: none is needed.
            speed_mps: speed between places, for a file without times [m/s].

        Raises:
            ValueError: the file is invalid; the message names the fault and its place.
        """

    def axes_of(self, content: bytes, /) -> int:
        """3 if the points of a file have heights, otherwise 2; raises ValueError as `tracks`."""


def _has(name: str) -> Callable[[bytes], bool]:
    """Test whether a zip has a file whose name ends in `name`."""
    return lambda content: any(each.lower().endswith(name) for each in bounded.names(content))


def _begins(*heads: bytes) -> Callable[[bytes], bool]:
    return lambda content: content[:HEAD_BYTES].removeprefix(BOM).lstrip().startswith(heads)


def _root(tag: bytes) -> Callable[[bytes], bool]:
    """Test whether an XML text, in UTF-8 or UTF-16, begins with the element `tag`."""
    return lambda content: tag in content[:HEAD_BYTES].replace(b"\0", b"")


FORMATS: tuple[tuple[str, tuple[str, ...], Callable[[bytes], bool]], ...] = (
    ("skyc", (".skyc",), _has("show.json")),
    ("kml", (".kmz",), _has(".kml")),
    ("tables", (".zip",), bounded.is_zip),
    ("plan", (".plan",), _begins(b"{")),
    ("waypoints", (".waypoints",), _begins(b"QGC WPL")),
    ("ulog", (".ulg",), _begins(b"ULog")),
    ("dataflash", (".bin",), _begins(b"\xa3\x95")),
    ("kml", (".kml",), _root(b"<kml")),
    ("gpx", (".gpx",), _root(b"<gpx")),
    ("gpx", (), _begins(b"<")),
    ("tables", (".csv",), lambda _: True),
)
"""Module of each format, suffixes of its files' names, and a test of a file's content. A file has
the first format whose test succeeds."""
SUFFIXES = tuple(suffix for _, suffixes, _ in FORMATS for suffix in suffixes)
"""Suffixes of the names of files with tracks."""


def of(content: bytes) -> Format:
    """Module of the format of a file's content."""
    module = next(module for module, _, fits in FORMATS if fits(content))
    found: Any = import_module(f"{__name__}.{module}")
    return found
