"""Picture of a packet's way round, through the functions that it passes.

Each function is looked up in the source, and a function drawn inside another must be called there;
otherwise nothing is drawn.
"""

import ast
from collections.abc import Iterator
from html import escape
from typing import NamedTuple

from skytether.lab.house.drawing import PACKAGE, head, tree


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
                        "server/controller.py: Controller.observe",
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
                        "server/controller.py: Controller.decide",
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
    body: list[ast.stmt] = tree(file).body
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
    lines = head(*PACKET_SIZE)
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
