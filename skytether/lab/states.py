"""Diagram of the failsafe's states, drawn from its table (docs/failsafe.svg).

`print(svg(), end='')`, redirected to that file, updates it.
"""

from collections.abc import Iterator, Mapping
from html import escape
from itertools import groupby

from skytether.client.failsafe import BROKEN, TABLE, Table
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.protocol import Mode

WIDTH, HEIGHT = 1120, 660
BOX = 104, 44
"""Width and height of a state."""
AT: Mapping[Mode, tuple[int, int]] = {
    Mode.INIT: (80, 110),
    Mode.SYNC: (310, 110),
    Mode.READY: (540, 110),
    Mode.TRACK: (770, 110),
    Mode.COAST: (1030, 110),
    Mode.BRAKE: (900, 380),
    Mode.HOVER: (540, 380),
    Mode.LAND: (310, 380),
    Mode.FAULT: (80, 380),
    Mode.MANUAL: (770, 540),
    Mode.RETURN: (425, 540),
}
"""Centre of each state."""
BEND: Mapping[tuple[Mode, Mode], int] = {
    (Mode.READY, Mode.SYNC): 60,
    (Mode.SYNC, Mode.READY): 0,
    (Mode.TRACK, Mode.COAST): 0,
    (Mode.COAST, Mode.TRACK): 60,
    (Mode.TRACK, Mode.BRAKE): 20,
    (Mode.BRAKE, Mode.TRACK): 80,
    (Mode.COAST, Mode.BRAKE): -30,
}
"""Distance by which an arrow's middle is bent to the left; 0 for those not listed."""
BELOW = {Mode.BRAKE, Mode.HOVER, Mode.LAND, Mode.FAULT, Mode.MANUAL, Mode.RETURN}
"""States whose self-loop is drawn below them."""
ANYWHERE: Mapping[Mode, tuple[str, tuple[int, int], tuple[int, int]]] = {
    Mode.FAULT: ("from every state:", (0, -90), (0, -96)),
    Mode.MANUAL: ("from all but INIT, LAND, RETURN, FAULT:", (-110, 0), (-240, -4)),
}
"""States that the same causes reach from everywhere: label, start of the single arrow, and position
of its label, relative to the state's centre."""
LOST = "lost link ¹"
"""Common label of all causes in `BROKEN`."""
TIP = (
    '<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" '
    'markerHeight="7" orient="auto"><path d="M0 0L10 5L0 10z" '
    'style="fill:#567;stroke:none;marker-end:none"/></marker></defs>'
)
STYLE = (
    "text{font:14px sans-serif;text-anchor:middle;fill:#222}"
    ".label{font-size:12px;stroke:#fff;stroke-width:4px;paint-order:stroke}"
    "rect{fill:#eef3f8;stroke:#345;stroke-width:1.5}"
    "path{fill:none;stroke:#567;stroke-width:1.5;marker-end:url(#tip)}"
)


def svg(table: Table = TABLE) -> str:
    """Diagram of a table as SVG; causes between the same two states share an arrow."""
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}">',
        f"<style>{STYLE}</style>",
        TIP,
        f'<rect width="{WIDTH}" height="{HEIGHT}" style="fill:#fff;stroke:none"/>',
    ]
    arrows = [(before, after, causes) for (before, after), causes in _arrows(table)]
    rest = [arrow for arrow in arrows if arrow[1] not in ANYWHERE]
    led_to = {after: causes for _, after, causes in arrows if after in ANYWHERE}
    for before, after, _ in rest:
        lines.append(f'<path d="{_way(before, after)[0]}"/>')
    for mode in led_to:
        (x, y), (dx, dy) = AT[mode], ANYWHERE[mode][1]
        way = f"M{x + dx} {y + dy}L{x + _sign(dx) * BOX[0] // 2} {y + _sign(dy) * BOX[1] // 2}"
        lines.append(f'<path d="{way}"/>')
    for mode, (x, y) in AT.items():
        left, top = x - BOX[0] // 2, y - BOX[1] // 2
        size = f'width="{BOX[0]}" height="{BOX[1]}" rx="8"'
        lines.append(f'<rect x="{left}" y="{top}" {size}/>')
        lines.append(
            f'<text x="{x}" y="{y + 5}"><tspan font-weight="bold">{mode.name}</tspan></text>'
        )
    for before, after, causes in rest:
        lines += _label(_texts(causes), *_way(before, after)[1])
    for mode, causes in led_to.items():
        (x, y), (said, _, (dx, dy)) = AT[mode], ANYWHERE[mode]
        lines += _label([said, *_texts(causes)], x + dx, y + dy)
    broken = ", ".join(_name(cause) for cause in Reason if cause in BROKEN)
    notes = (
        f"¹ one of: {broken}. They lock, as does late: no horizon is taken before HOVER and good.",
        "Where horizon leads to TRACK, it does so only when armed and not locked.",
    )
    for i, note in enumerate(notes):
        lines.append(f'<text x="{WIDTH // 2}" y="{HEIGHT - 44 + 22 * i}">{escape(note)}</text>')
    return "\n".join([*lines, "</svg>", ""])


def _arrows(table: Table) -> Iterator[tuple[tuple[Mode, Mode], set[Reason]]]:
    """Causes of each pair of states that an arrow joins; transitions to the same state have
    none.
    """
    rows = sorted((before, after, cause) for (before, cause), after in table.items())
    for pair, group in groupby(rows, key=lambda row: row[:2]):
        causes = {cause for *_, cause in group}
        if causes - {Reason.HORIZON} or pair[0] is not pair[1]:
            yield pair, causes


def _sign(number: int) -> int:
    return (number > 0) - (number < 0)


def _texts(causes: set[Reason]) -> list[str]:
    """Names of causes, one per line; most causes in `BROKEN` together get a common name."""
    lost = [LOST] if len(causes & BROKEN) > 1 else []
    rest = causes - BROKEN if lost else causes
    return [_name(cause) for cause in sorted(rest)] + lost


def _name(cause: Reason) -> str:
    return cause.name.lower().replace("_", " ")


def _way(before: Mode, after: Mode) -> tuple[str, tuple[float, float]]:
    """Path from the border of one state to that of another, and the middle of its label."""
    (x0, y0), (x1, y1) = AT[before], AT[after]
    half, side = BOX[0] / 2, BOX[1] / 2
    if before is after:
        way = 1 if before in BELOW else -1
        edge, far = y0 + way * side, y0 + way * (side + 46)
        path = f"M{x0 - 22} {edge:g}C{x0 - 34} {far:g} {x0 + 34} {far:g} {x0 + 22} {edge:g}"
        return path, (x0, y0 + way * (side + 50) + (8 if way > 0 else 0))
    dx, dy = x1 - x0, y1 - y0
    length = (dx * dx + dy * dy) ** 0.5
    bend = BEND.get((before, after), 0)
    mx, my = (x0 + x1) / 2 + bend * dy / length, (y0 + y1) / 2 - bend * dx / length

    def border(x: float, y: float) -> tuple[float, float]:
        """Point where the line from a state's centre towards the bend crosses its border."""
        tx, ty = mx - x, my - y
        scale = min(half / abs(tx) if tx else 9e9, side / abs(ty) if ty else 9e9)
        return x + tx * scale, y + ty * scale

    (ax, ay), (bx, by) = border(x0, y0), border(x1, y1)
    path = f"M{ax:.0f} {ay:.0f}Q{mx:.0f} {my:.0f} {bx:.0f} {by:.0f}"
    return path, (ax / 4 + mx / 2 + bx / 4, ay / 4 + my / 2 + by / 4)


def _label(texts: list[str], x: float, y: float) -> Iterator[str]:
    """Lines of text around a point."""
    top = y - 7 * (len(texts) - 1) + 4
    for i, text in enumerate(texts):
        yield f'<text class="label" x="{x:.0f}" y="{top + 14 * i:.0f}">{escape(text)}</text>'
