"""Picture of the package's rooms and who imports whom, read from the imports of every module."""

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from html import escape
from pathlib import Path
from typing import NamedTuple

from skytether.lab.house.drawing import PACKAGE, head, tree

Names = tuple[str, ...]
"""Names of a module or a room behind `skytether`."""
ENTRIES = frozenset({"__init__", "__main__"})
"""Modules that are no room: they name others as text, and import them when they are called."""
SHARED = "shared"
"""Room whose own rooms are drawn inside it."""
BOX = 150, 46
"""Width and height of a room."""


class Room(NamedTuple):
    """Place of a room in the picture, and what is in it."""

    x: int
    """Middle of its box, from the left."""
    y: int
    """Middle of its box, from the top."""
    about: str
    """Contents, in a few words."""


ROOMS: Mapping[str, Room] = {
    "library": Room(380, 40, "import skytether"),
    "lab": Room(380, 120, "studies"),
    "cli": Room(380, 200, "commands that fly"),
    "view": Room(95, 280, "page, recordings"),
    "sim": Room(610, 280, "virtual time"),
    "figures": Room(95, 360, "plots, reports"),
    "probe": Room(95, 440, "measures a path"),
    "station": Room(520, 440, "set-points, to compare"),
    "autopilot": Room(910, 440, "a simulated autopilot"),
    "plugin": Room(735, 440, "names for plug-ins"),
    "server": Room(95, 550, "plans, decides, sends"),
    "client": Room(475, 550, "flies the vehicle"),
    "netem": Room(285, 550, "delays, loses, reorders"),
    "shell": Room(500, 650, "sockets, timers, files"),
    "quadrotor": Room(740, 650, "rotors and loops"),
    "mavlink": Room(910, 650, "frames of autopilots"),
    SHARED: Room(500, 755, ""),
    "scenarios": Room(500, 850, "TOML files"),
}
"""Rooms of the package."""
INNER: Mapping[str, tuple[int, str]] = {
    "telemetry": (95, "records, feeds"),
    "core": (257, "endpoints, events"),
    "scenario": (419, "keys, triggers"),
    "wire": (581, "messages, keys"),
    "law": (743, "model, rule of flight"),
    "base": (905, "units, errors"),
}
"""Middle of each room within `shared`, from the left, and what is in it."""
ROOMS_SIZE = 1000, 920


def modules() -> Iterator[tuple[Names, Path]]:
    """Every module of the package: its names behind `skytether`, and its file."""
    for name in sorted(each.name for each in PACKAGE.iterdir()):
        room = PACKAGE / name
        files = sorted(room.resolve().rglob("*.py")) if room.is_dir() else [room]
        for file in files:
            if file.suffix == ".py":
                inside = file.relative_to(room.resolve() if room.is_dir() else PACKAGE)
                parts = inside.with_suffix("").parts
                yield ((name, *parts) if room.is_dir() else parts), file


def imported(file: Path) -> Iterator[Names]:
    """Modules of the package that a file imports, by their names behind `skytether`."""
    for node in ast.walk(tree(file)):
        match node:
            case ast.ImportFrom(module="skytether"):
                yield from ((each.name,) for each in node.names)
            case ast.ImportFrom(module=str(module)):
                names = [module]
            case ast.Import():
                names = [each.name for each in node.names]
            case _:
                names = []
        if not isinstance(node, ast.ImportFrom) or node.module != "skytether":
            for name in names:
                root, *rest = name.split(".")
                if root == "skytether" and rest:
                    yield tuple(rest)


def imports() -> dict[Names, set[Names]]:
    """Rooms that each room imports from; rooms of `shared` are ("shared", name)."""
    found: dict[Names, set[Names]] = {}
    for names, file in modules():
        if names[0] in ENTRIES:
            continue
        for depth in (1, 2) if names[0] == SHARED else (1,):
            room = names[:depth]
            if room[-1] in ENTRIES:
                continue
            into = found.setdefault(room, set())
            for target in imported(file):
                is_inner = target[0] == SHARED
                if depth > 1 and not is_inner:
                    continue
                if target[:depth] != room and target[0] not in ENTRIES:
                    into.add(target[:depth])
    return found


def reduced(edges: Mapping[Names, set[Names]]) -> set[tuple[Names, Names]]:
    """Arrows that no longer way implies; there is no circle."""

    @cache
    def reached(room: Names) -> frozenset[Names]:
        below = frozenset(edges.get(room, ()))
        return below.union(*(reached(each) for each in below))

    return {
        (room, target)
        for room, targets in edges.items()
        for target in targets
        if not any(target in reached(other) for other in targets)
    }


def rooms_svg() -> str:
    """Rooms of the package and who imports whom, as an SVG file."""
    edges = imports()
    outer = {room for room in edges if len(room) == 1}
    inner = {room for room in edges if len(room) == 2}
    if missing := {room[0] for room in outer | {(SHARED,)}} ^ ROOMS.keys():
        raise LookupError(f"ROOMS and the package differ in {', '.join(sorted(missing))}")
    if missing := {room[1] for room in inner} ^ INNER.keys():
        raise LookupError(f"INNER and shared differ in {', '.join(sorted(missing))}")
    width, half = 1000 - 20, BOX[1] // 2
    y = ROOMS[SHARED].y
    lines = head(*ROOMS_SIZE)
    lines.append(
        f'<rect class="frame" x="10" y="{y - half - 24}" width="{width}" height="{BOX[1] + 34}" '
        'rx="8"/>'
    )
    lines.append(f'<text x="500" y="{y - half - 8}">{SHARED}: what all others stand on</text>')
    lines += [
        f'<path d="{_down(ROOMS[one[0]], ROOMS[other[0]])}"/>'
        for one, other in sorted(reduced({room: edges[room] for room in outer}))
    ]
    lines += [
        f'<path d="{_across(one[1], other[1], y)}"/>'
        for one, other in sorted(reduced({room: edges[room] for room in inner}))
    ]
    for name, room in ROOMS.items():
        if name != SHARED:
            lines += _room(name, room.about, room.x, room.y)
    for name, (x, about) in INNER.items():
        lines += _room(name, about, x, y)
    note = "An arrow: imports from. Imports that follow from a longer way are not drawn."
    lines.append(f'<text class="small" x="500" y="{ROOMS_SIZE[1] - 20}">{note}</text>')
    return "\n".join([*lines, "</svg>", ""])


def _room(name: str, about: str, x: int, y: int) -> Iterator[str]:
    """Box of a room with its name."""
    size = f'width="{BOX[0]}" height="{BOX[1]}" rx="8"'
    yield f'<rect x="{x - BOX[0] // 2}" y="{y - BOX[1] // 2}" {size}/>'
    yield f'<text x="{x}" y="{y - 2}"><tspan font-weight="bold">{name}</tspan></text>'
    yield f'<text class="small" x="{x}" y="{y + 14}">{escape(about)}</text>'


def _down(above: Room, below: Room) -> str:
    """Path from the lower edge of a room to the upper edge of another; `shared` is a wide one."""
    y0, y1 = above.y + BOX[1] // 2, below.y - BOX[1] // 2
    x0, x1 = above.x, below.x
    if above is ROOMS[SHARED]:
        y0 += 10
    if below is ROOMS[SHARED]:
        y1 -= 24
        x1 = x0
    return f"M{x0} {y0}C{x0} {y0 + 30} {x1} {y1 - 34} {x1} {y1}"


def _across(one: str, other: str, y: int) -> str:
    """Path between neighbours within `shared`; around those that lie between."""
    x0, x1 = INNER[one][0] + BOX[0] // 2, INNER[other][0] - BOX[0] // 2
    return f"M{x0} {y}L{x1} {y}"
