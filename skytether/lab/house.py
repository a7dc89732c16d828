"""Pictures of the code, drawn from the code: docs/rooms.svg and docs/packet.svg.

`python -m skytether.lab.house docs` (`make pictures`) writes both. Rooms and their arrows are read
from the imports of every module. Of a packet's way each function is looked up in the source, and a
function drawn inside another must be called there; otherwise nothing is written.
"""

import ast
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from html import escape
from pathlib import Path
from typing import NamedTuple

Names = tuple[str, ...]
"""Names of a module or a room behind `skytether`."""
PACKAGE = Path(__file__).parents[1]
"""Folder of the package."""
ENTRIES = frozenset({"__init__", "__main__"})
"""Modules that are no room: they name others as text, and import them when they are called."""
SHARED = "shared"
"""Room whose own rooms are drawn inside it."""
STYLE = (
    "text{font:14px sans-serif;text-anchor:middle;fill:#222}"
    ".small{font-size:11px;fill:#456}"
    ".left{text-anchor:start}"
    ".code{font-family:monospace;font-size:12px;text-anchor:start}"
    "rect{fill:#eef3f8;stroke:#345;stroke-width:1.5}"
    ".frame{fill:#fff}"
    "path{fill:none;stroke:#567;stroke-width:1.5;marker-end:url(#tip)}"
    ".packet{stroke:#b40;stroke-width:2;stroke-dasharray:7 4}"
)
TIP = (
    '<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" '
    'markerHeight="7" orient="auto"><path d="M0 0L10 5L0 10z" '
    'style="fill:#567;stroke:none;marker-end:none"/></marker></defs>'
)


# -- rooms -----------------------------------------------------------------------------------------

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
    "lab": Room(380, 120, "studies, benchmarks"),
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
    for node in ast.walk(_tree(file)):
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
    lines = _head(*ROOMS_SIZE)
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


def _head(width: int, height: int) -> list[str]:
    """First lines of a picture, with a white ground."""
    return [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">',
        f"<style>{STYLE}</style>",
        TIP,
        f'<rect width="{width}" height="{height}" style="fill:#fff;stroke:none"/>',
    ]


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


# -- a packet's way --------------------------------------------------------------------------------


class DrawnCall(NamedTuple):
    """A function on a packet's way, and those that it calls there."""

    where: str
    """File and name, as docs/design.md writes them."""
    about: str
    """Purpose, in a few words."""
    calls: tuple["DrawnCall", ...] = ()
    """Functions that it calls, by itself or through others of its class, in their order."""


class DrawnPart(NamedTuple):
    """One frame of the picture: what one process does at one time."""

    title: str
    x: int
    """Left edge."""
    y: int
    """Upper edge."""
    calls: tuple[DrawnCall, ...]


LINE, INDENT, FRAME = 36, 16, 320
"""Height of a function, indentation of one that is called, and width of a part."""
NETEM = (
    DrawnCall(
        "netem/proxy.py: Proxy.receive", "", (DrawnCall("netem/link.py: Link.take", "fate drawn"),)
    ),
    DrawnCall(
        "netem/proxy.py: Proxy.wake",
        "",
        (DrawnCall("netem/link.py: Link.give", "let out when due"),),
    ),
)
SCHEME = "server/control/scheme.py: Scheme"
WAY: tuple[DrawnPart, ...] = (
    DrawnPart(
        "1 vehicle: a step begins",
        10,
        40,
        (
            DrawnCall(
                "client/endpoint.py: Client.wake",
                "",
                (
                    DrawnCall(
                        "client/pilot.py: Pilot.fly",
                        "",
                        (
                            DrawnCall(
                                "client/vehicle.py: Vehicle.measurements", "what was measured"
                            ),
                            DrawnCall("client/navigation.py: Navigation.advance", "filtered"),
                        ),
                    ),
                    DrawnCall("client/pilot.py: Pilot.observation", "OBSERVATION, if one is due"),
                    DrawnCall(
                        "client/session.py: ServerSession.send",
                        "",
                        (DrawnCall("client/secure.py: SecureLink.seal", "with keys"),),
                    ),
                ),
            ),
        ),
    ),
    DrawnPart("2 netem: downlink", 370, 40, NETEM),
    DrawnPart(
        "3 server: a datagram arrives",
        730,
        40,
        (
            DrawnCall(
                "server/reception.py: Reception.hear",
                "",
                (
                    DrawnCall("server/secure.py: SecureGate.open", "with keys"),
                    DrawnCall("shared/wire/protocol.py: decode", "checked"),
                    DrawnCall("server/plausibility.py: Plausibility.judge", "believed?"),
                    DrawnCall("server/control/clock.py: ClockMap.observe", "clocks compared"),
                    DrawnCall(
                        "server/control/controller.py: Controller.observe",
                        "",
                        (DrawnCall(f"{SCHEME}.observe", "kept if it is the newest"),),
                    ),
                ),
            ),
        ),
    ),
    DrawnPart(
        "4 server: a tick is due",
        730,
        370,
        (
            DrawnCall(
                "server/tick.py: Ticker.tick",
                "",
                (
                    DrawnCall("server/control/clock.py: ClockMap.steps", "step aboard"),
                    DrawnCall(
                        "server/control/controller.py: Controller.decide",
                        "",
                        (
                            DrawnCall(f"{SCHEME}.foresee", "x̂(k), x̂(k+d), eq. (13)"),
                            DrawnCall("server/control/planner.py: Planner.plan", "(14), (15)"),
                            DrawnCall("shared/scenario/triggers.py: Trigger.test", "event? (16)"),
                            DrawnCall(f"{SCHEME}.remember", "(12)"),
                        ),
                    ),
                    DrawnCall("shared/wire/protocol.py: encode_horizon", "HORIZON"),
                    DrawnCall("server/sessions.py: Session.sealed", "with keys"),
                ),
            ),
        ),
    ),
    DrawnPart("5 netem: uplink", 370, 480, NETEM),
    DrawnPart(
        "6 vehicle: a datagram arrives",
        10,
        370,
        (
            DrawnCall(
                "client/endpoint.py: Client.receive",
                "",
                (
                    DrawnCall(
                        "client/session.py: ServerSession.hear",
                        "",
                        (DrawnCall("client/link.py: ClientLink.open", "with keys"),),
                    ),
                    DrawnCall(
                        "client/pilot.py: Pilot.offer",
                        "",
                        (
                            DrawnCall("client/failsafe.py: Failsafe.horizon_arrived", "too late?"),
                            DrawnCall("client/compensator.py: Compensator.offer", "newest is kept"),
                        ),
                    ),
                ),
            ),
        ),
    ),
    DrawnPart(
        "7 vehicle: the next step begins",
        10,
        690,
        (
            DrawnCall(
                "client/pilot.py: Pilot.fly",
                "",
                (
                    DrawnCall("client/failsafe.py: Failsafe.step", "what is flown at all"),
                    DrawnCall(
                        "client/compensator.py: Compensator.choose",
                        "input, (11)",
                        (DrawnCall("shared/law/rule.py: step", "rule of flight"),),
                    ),
                    DrawnCall("client/clamp.py: clamped", "last bounds"),
                    DrawnCall("client/vehicle.py: Vehicle.fly", "flown for a step"),
                ),
            ),
        ),
    ),
)
"""A packet's way, as docs/design.md tells it."""
PACKETS = ((0, 1), (1, 2), (3, 4), (4, 5))
"""Parts between which a packet travels."""
AFTER = ((2, 3), (5, 6))
"""Parts of one process, of which the later reads what the earlier has kept."""
PACKET_SIZE = 1060, 960


def functions(calls: tuple[DrawnCall, ...] | None = None) -> Iterator[DrawnCall]:
    """Every function of the way, or those of some calls and below."""
    if calls is None:
        for part in WAY:
            yield from functions(part.calls)
        return
    for call in calls:
        yield call
        yield from functions(call.calls)


def find(where: str) -> ast.ClassDef | ast.FunctionDef:
    """Definition of `path/file.py: Name` or `path/file.py: Class.method`.

    Raises:
        LookupError: there is none.
    """
    path, _, name = where.partition(": ")
    file = PACKAGE / path
    if not file.is_file():
        raise LookupError(f"{path} is no file of the package")
    body: list[ast.stmt] = _tree(file).body
    found: ast.ClassDef | ast.FunctionDef | None = None
    for part in name.split("."):
        found = next(
            (
                each
                for each in body
                if isinstance(each, ast.ClassDef | ast.FunctionDef) and each.name == part
            ),
            None,
        )
        if found is None:
            raise LookupError(f"{path} has no {name}")
        body = found.body
    assert found is not None
    return found


def called(where: str) -> set[str]:
    """Names that a function calls, by itself or through other methods of its class."""
    path, _, name = where.partition(": ")
    owner, _, method = name.rpartition(".")
    seen: set[str] = set()
    ahead = [method]
    names: set[str] = set()
    while ahead:
        here = ahead.pop()
        seen.add(here)
        prefix = f"{path}: {owner}." if owner else f"{path}: "
        for node in ast.walk(find(prefix + here)):
            match node:
                case ast.Call(func=ast.Attribute(value=ast.Name(id="self"), attr=attribute)):
                    if owner and attribute not in seen:
                        ahead.append(attribute)
                case ast.Call(func=ast.Attribute(attr=attribute)):
                    names.add(attribute)
                case ast.Call(func=ast.Name(id=function)):
                    names.add(function)
    return names


def check() -> None:
    """Look up every function of the way, and each call between two of them.

    Raises:
        LookupError: a function is gone, or is not called where it is said to be.
    """
    for call in functions():
        find(call.where)
        made = called(call.where) if call.calls else set()
        for inner in call.calls:
            if (name := inner.where.partition(": ")[2].rpartition(".")[2]) not in made:
                raise LookupError(f"{call.where} does not call {name} ({inner.where})")


def packet_svg() -> str:
    """A packet's way round, as an SVG file."""
    check()
    lines = _head(*PACKET_SIZE)
    heights = [LINE * sum(1 for _ in functions(part.calls)) + 14 for part in WAY]
    boxes = [(part.x, part.y, height) for part, height in zip(WAY, heights, strict=True)]
    for one, other in PACKETS + AFTER:
        kind = ' class="packet"' if (one, other) in PACKETS else ""
        lines.append(f'<path{kind} d="{_between(boxes[one], boxes[other])}"/>')
    for part, height in zip(WAY, heights, strict=True):
        size = f'width="{FRAME}" height="{height}" rx="8"'
        lines.append(f'<rect x="{part.x}" y="{part.y}" {size}/>')
        title = f'<tspan font-weight="bold">{escape(part.title)}</tspan>'
        lines.append(f'<text class="left" x="{part.x + 4}" y="{part.y - 8}">{title}</text>')
        y = part.y + 22
        for depth, call in _deep(part.calls):
            path, _, name = call.where.partition(": ")
            about = f"{path} · {call.about}" if call.about else path
            x = part.x + 12 + INDENT * depth
            lines.append(f'<text class="code" x="{x}" y="{y}">{escape(name)}</text>')
            lines.append(f'<text class="small left" x="{x}" y="{y + 13}">{escape(about)}</text>')
            y += LINE
    note = (
        "Indented: called by the function above it. Dashed: a packet travels. "
        "Solid: the later part reads what the earlier one has kept."
    )
    middle = PACKET_SIZE[0] // 2
    lines.append(f'<text class="small" x="{middle}" y="{PACKET_SIZE[1] - 14}">{note}</text>')
    return "\n".join([*lines, "</svg>", ""])


def _deep(calls: tuple[DrawnCall, ...], depth: int = 0) -> Iterator[tuple[int, DrawnCall]]:
    """Functions with their depth, in the order in which they are drawn."""
    for call in calls:
        yield depth, call
        yield from _deep(call.calls, depth + 1)


def _between(one: tuple[int, int, int], other: tuple[int, int, int]) -> str:
    """Path from one frame to another: down within a column, else across."""
    (x0, y0, h0), (x1, y1, h1) = one, other
    if x0 == x1:
        middle = x0 + FRAME // 2
        return f"M{middle} {y0 + h0}L{middle} {y1 - 24}"
    y = (max(y0, y1) + min(y0 + h0, y1 + h1)) // 2
    return f"M{x0 + FRAME} {y}L{x1} {y}" if x0 < x1 else f"M{x0} {y}L{x1 + FRAME} {y}"


@cache
def _tree(file: Path) -> ast.Module:
    """Syntax tree of a file."""
    return ast.parse(file.read_text())


PICTURES = {"rooms.svg": rooms_svg, "packet.svg": packet_svg}
"""Function that draws each file."""


def main(folder: str) -> None:
    """Write every picture into a folder."""
    drawn = {name: draw() for name, draw in PICTURES.items()}
    for name, text in drawn.items():
        (Path(folder) / name).write_text(text)


if __name__ == "__main__":
    main(*sys.argv[1:])
