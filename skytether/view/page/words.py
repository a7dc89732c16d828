"""Texts of a flight's status on a page, as HTML."""

from collections.abc import Iterable, Sequence
from html import escape
from itertools import cycle, groupby
from typing import Any

import numpy as np

from skytether.figures.colours import css
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.telemetry.record import UPLINK
from skytether.shared.telemetry.summary import PLUGINS
from skytether.view.page.scene import FENCE_RGB, FLIGHT_RGB, GOAL_RGB
from skytether.view.page.state import LOSS_S, Heard, State, Word, figure, group

CSS = {
    "grey": "var(--mantine-color-gray-6)",
    "green": "var(--mantine-color-green-8)",
    "amber": "var(--mantine-color-orange-8)",
    "red": "var(--mantine-color-red-8)",
    "blue": "var(--mantine-color-blue-7)",
    "violet": "var(--mantine-color-violet-7)",
}
NEWEST = 3
"""Number of events shown beside a vehicle's state."""
SAID_SHOWN = 50

FATES = ("packets", "lost", "dropped", "reordered", "duplicated", "corrupted")
"""Counters of netem for a direction, and their titles."""

SILENT = 0.5
"""Probability of loss above which a path counts as silent."""
PATH = (
    "",
    "state",
    "fails up, down [%]",
    "round trip [ms]",
    "lost up, down [%]",
    "packets up, down",
    "first copies up, down",
)
"""Names of the rows that are shown for each path."""

FLOWN_S = "data-flown-s"
"""HTML attribute with the time of flight [s], for programs."""

_BODY = "font-size:0.85em;line-height:1.45;padding:0 0.6em;color:var(--mantine-color-text)"
_DIM = "color:var(--mantine-color-dimmed)"
_LINE = "white-space:nowrap;overflow:hidden;text-overflow:ellipsis"
_GAP = ' style="padding-left:1.2em"'


def badge(word: Word) -> str:
    chip = (
        f"background:{CSS[word.colour]};color:#fff;border-radius:0.25em;padding:0.05em 0.5em;"
        "font-weight:600;margin-right:0.5em;display:inline-block"
    )
    return f'<span style="{chip}">{escape(word.word)}</span>{escape(word.text)}'


def number(value: float, form: str, unit: str = "") -> str:
    """Number as text, or a dash for NaN."""
    return "–" if np.isnan(value) else f"{value:{form}}{unit}"


def status(state: State, vehicle: int, now_ns: int, title: str = "") -> str:
    """Figures for an operator's decisions: state, link, error, losses and the newest events."""
    if not state.name:
        return f'<div style="{_BODY}">{escape(title)} No flight yet.</div>'
    if not state.flies:
        return _carried(state, now_ns, title)
    track = state.vehicles.get(vehicle)
    head = f'<div style="{_LINE}"><b>{escape(title or state.title)}</b></div>'
    if track is None:
        return f'<div style="{_BODY}">{head}No data of vehicle {vehicle} yet.</div>'
    rows = [
        ("time of flight", f"{track.time_s:.0f} s of {state.duration_s:g} s"),
        ("error, last 10 s", number(track.error_m(10.0), ".3f", " m")),
        *_apart(state, vehicle),
        (f"lost, last {LOSS_S:.0f} s", _lost(state, now_ns)),
    ]
    return (
        f'<div style="{_BODY}" class="skytether-status" {FLOWN_S}="{track.time_s:.0f}">{head}'
        f"<div>{badge(track.does)}</div>"
        f'<div style="margin:0.3em 0">{badge(_link(state, vehicle, now_ns))}</div>'
        f"{_gone(state)}{_table(rows)}"
        f'<div style="{_DIM};margin-top:0.3em">{_newest(state)}</div></div>'
    )


def figures(state: State, vehicle: int, now_ns: int, title: str = "") -> str:
    """Figures of a vehicle that `status` does not show; empty without a vehicle."""
    track = state.vehicles.get(vehicle) if state.flies else None
    if track is None:
        return ""
    rows = [
        ("age of the observation in use", number(track.age_s, ".2f", " s")),
        ("age of observation at server", number(track.known_s, ".2f", " s")),
    ]
    if track.planned:
        causes = f"{track.sent.above} by the trigger's figure, {track.sent.due} due"
        rows.append(("plans sent", causes))
    rows += _leader(state, vehicle) + _mission(state, vehicle) + _autopilot(state, vehicle)
    rows += [*_rates(state, now_ns), _delays(state, now_ns)]
    curves_ms = track.curves(60).solve_ms
    solved = curves_ms[~np.isnan(curves_ms)]
    deadline_ms = state.scenario.dt_ns / MILLISECOND_NS
    if len(solved):
        p99 = np.quantile(solved, 0.99)
        rows.append(("solving, p99", f"{p99:.2f} of {deadline_ms:g} ms"))
    server = state.figures("server")
    failed = {kind: figure(server, "counts", f"{kind}_errors") for kind in PLUGINS}
    if errors := ", ".join(f"{kind} {count:.0f}" for kind, count in failed.items() if count > 0):
        rows.append(("errors of plug-ins", errors))
    head = f"<b>{escape(title)}</b>" if title else ""
    return (
        f'<div style="{_BODY}" class="skytether-figures">{head}{_table(rows)}'
        f"{_table(_paths(state, vehicle))}</div>"
    )


def _carried(state: State, now_ns: int, title: str) -> str:
    """Counters of netem, if it carries other programs' packets."""
    counted = state.figures("netem")
    rows = [("flows", number(figure(counted, "flows"), ".0f")), *_rates(state, now_ns)]
    rows += [(f"lost, last {LOSS_S:.0f} s", _lost(state, now_ns)), _delays(state, now_ns)]
    for way, name in zip(state.ways, state.directions.values(), strict=True):
        counts = (f"{number(figure(counted, way, each), '.0f')} {each}" for each in FATES)
        rows.append((f"{name}, so far", ", ".join(counts)))
        queue, p99_ms = figure(counted, way, "queue"), figure(counted, way, "queueing_ms_p99")
        queued = f"{number(p99_ms, '.0f')} ms (p99) at the finite rate"
        rows.append((f"{name}, under way", f"{number(queue, '.0f')} packets; {queued}"))
    return (
        f'<div style="{_BODY}" class="skytether-status" {FLOWN_S}="{state.time_s(now_ns):.0f}">'
        f"<b>{escape(title or 'netem')}</b>{_gone(state)}{_table(rows)}"
        f'<div style="{_DIM};margin-top:0.3em">{_newest(state)}</div></div>'
    )


def _table(rows: Sequence[Sequence[str]]) -> str:
    """HTML table whose rows begin with a name; empty without rows."""
    style = f"{_DIM};padding-right:0.8em;vertical-align:top;white-space:nowrap"
    lines = "".join(
        f'<tr><td style="{style}">{escape(name)}</td>'
        + "".join(f"<td{_GAP if i else ''}>{escape(value)}</td>" for i, value in enumerate(values))
        + "</tr>"
        for name, *values in rows
    )
    return f'<table style="border-spacing:0">{lines}</table>' if rows else ""


def _gone(state: State) -> str:
    names = ", ".join((*state.lost, *state.missing))
    return f'<div style="color:{CSS["red"]}">no feed of {escape(names)}</div>' if names else ""


def _newest(state: State) -> str:
    """Newest events, in a box of fixed height, so that the page does not move."""
    lines = "".join(
        f'<div style="{_LINE}" title="{escape(each.text)}">{each.time_s:.1f} s '
        f"{escape(_counted(each))}</div>"
        for each in list(state.said)[: -NEWEST - 1 : -1]
    )
    return f'<div style="height:{1.45 * NEWEST}em">{lines}</div>'


def _counted(heard: Heard) -> str:
    return f"{heard.text} ×{heard.count}" if heard.count > 1 else heard.text


def _link(state: State, vehicle: int, now_ns: int) -> Word:
    word = state.link(vehicle, now_ns)
    return Word(f"link {word.word.lower()}", word.text, word.colour)


def _leader(state: State, vehicle: int) -> list[tuple[str, str]]:
    """Row with the server that leads, if there is a standby server."""
    leadership = group(state.of_vehicle("client", vehicle), "leadership")
    if not leadership:
        return []
    number_ = number(figure(leadership, "number"), ".0f")
    return [("led by", f"{leadership.get('server', '–')}, leadership {number_}")]


def _apart(state: State, vehicle: int) -> list[tuple[str, str]]:
    if not state.scenario.is_mission:
        return []
    required = f"at least {state.scenario.mission.separation_m:g} m"
    nearest = number(float(state.nearest_m(vehicle)[-1]), ".2f", " m")
    return [("nearest other vehicle", f"{nearest}, {required}")]


def _mission(state: State, vehicle: int) -> list[tuple[str, str]]:
    if not state.scenario.is_mission:
        return []
    bound_ms, clock_m = state.clock(vehicle)
    return [
        ("waits for", state.waits(vehicle) or "–"),
        (
            "clock and position, known to ±",
            f"{number(bound_ms, '.0f', ' ms')}, {number(clock_m, '.2f', ' m')}",
        ),
    ]


def _autopilot(state: State, vehicle: int) -> list[tuple[str, str]]:
    says = group(state.of_vehicle("client", vehicle), "autopilot")
    if "mode" not in says:  # without modes, these figures do not exist
        return []
    armed = "armed" if says.get("armed") else "disarmed"
    charge, volts = 100.0 * figure(says, "battery"), figure(says, "voltage_v")
    places = (figure(says, "home", f"{each}_deg") for each in ("latitude", "longitude"))
    home = (number(place, ".6f", "°") for place in places)
    return [
        ("autopilot", f"{says.get('mode', '–')}, {armed}"),
        ("battery", f"{number(charge, '.0f', ' %')}, {number(volts, '.1f', ' V')}"),
        ("home", ", ".join(home)),
    ]


def _paths(state: State, vehicle: int) -> list[tuple[str, ...]]:
    """Rows with a column for each path, if there are several."""
    columns = [_path(*each) for each in enumerate(state.paths(vehicle), start=1)]
    return list(zip(PATH, *columns, strict=True)) if columns else []


def _path(path: int, ends: tuple[dict[str, Any], dict[str, Any]]) -> tuple[str, ...]:
    """Texts of a path's column, in the order of PATH, from figures of server and vehicle."""
    fails_up, fails_down = (figure(end, "failure") for end in ends)
    silent = [way for way, fails in (("up", fails_up), ("down", fails_down)) if fails > SILENT]
    is_known = not np.isnan([fails_up, fails_down]).all()

    def both(name: str, ends: Iterable[dict[str, Any]] = ends, scale: float = 1.0) -> str:
        return ", ".join(number(scale * figure(end, name), ".0f") for end in ends)

    return (
        f"path {path}",
        f"silent {' and '.join(silent)}" if silent else "alive" if is_known else "–",
        both("failure", scale=100.0),
        number(float(np.fmin.reduce([figure(end, "delay_ms") for end in ends])), ".0f"),
        both("loss", scale=100.0),
        both("packets"),
        both("first", ends[::-1]),
    )


def _rates(state: State, now_ns: int) -> list[tuple[str, str]]:
    rows = []
    for direction, name in state.directions.items():
        traffic = state.network.traffic(direction, LOSS_S, now_ns)
        rates = f"{traffic.packets_per_s:.1f} packets/s, {traffic.bytes_per_s / 1e3:.2f} kB/s"
        rows.append((name, rates))
        size = state.network.horizon_bytes(now_ns)
        if direction == UPLINK and state.flies and not np.isnan(size):
            rate = state.every_step
            every = f"{rate:.0f} packets/s, {rate * size / 1e3:.2f} kB/s"
            rows.append(("up, at every step", every))
    return rows


def _lost(state: State, now_ns: int) -> str:
    traffic = {
        name: state.network.traffic(way, LOSS_S, now_ns) for way, name in state.directions.items()
    }
    return ", ".join(f"{number(100 * t.loss, '.0f')} % {name}" for name, t in traffic.items())


def _delays(state: State, now_ns: int) -> tuple[str, str]:
    delays = []
    for direction, name in state.directions.items():
        traffic = state.network.traffic(direction, LOSS_S, now_ns)
        p50, p99 = number(traffic.delay_ms_p50, ".0f"), number(traffic.delay_ms_p99, ".0f")
        delays.append(f"{p50}, {p99} {name}")
    return "delay p50, p99 [ms]", "; ".join(delays)


def said(states: Sequence[tuple[str, State]]) -> str:
    events = [
        (each.time_s, f"{title} {_counted(each)}".strip())
        for title, state in states
        for each in state.said
    ]
    events.sort(key=lambda each: each[0], reverse=True)
    lines = "".join(
        f'<div><span style="{_DIM}">{time_s:.1f} s</span> {escape(text)}</div>'
        for time_s, text in events[:SAID_SHOWN]
    )
    return f'<div style="{_BODY};max-height:45vh;overflow-y:auto">{lines or "Nothing yet."}</div>'


def note(text: str) -> str:
    return f'<div style="{_BODY};{_DIM}">{escape(text)}</div>'


def refused(why: str) -> str:
    return f'<div style="{_BODY};color:{CSS["red"]};margin:-0.4em 0 0.4em">{escape(why)}</div>'


def explained(text: str, following: str, refused_: str, command: str) -> str:
    """HTML of the explanation of a brake event, so far as it is known.

    Args:
        text: explanation as plain text; indented lines are tables.
        following: phase in progress; empty if the explanation is complete.
        refused_: reason why there is no explanation.
        command: command that makes the same explanation.
    """
    lines = ""
    for is_table, some in groupby(text.splitlines(), _is_tabular):
        if is_table:
            table = escape("\n".join(some))
            lines += f'<pre style="margin:0.2em 0;overflow-x:auto;font-size:0.85em">{table}</pre>'
        else:
            lines += "".join(f"<div>{escape(each) or '&nbsp;'}</div>" for each in some)
    waits = note(f"Flying it again: {following} …") if following and not refused_ else ""
    return (
        f'<div class="skytether-explained"><div style="{_BODY}">{lines}</div>{waits}'
        f'{refused(refused_) if refused_ else ""}<div style="{_BODY};{_DIM}">'
        f'<code style="user-select:all">{escape(command)}</code></div></div>'
    )


def _is_tabular(line: str) -> bool:
    return line.startswith("  ") and not line.startswith("  →")


def answers(given: Sequence[tuple[str, bool]]) -> str:
    """HTML of the answers to the newest request; an answer of one line does not move the page.

    Args:
        given: each flight's answer, and whether it is a refusal.
    """
    lines = "".join(
        f'<div style="color:{CSS["red" if refused else "green"]}">{escape(text)}</div>'
        for text, refused in dict.fromkeys(given)
    )
    box = "min-height:1.45em;max-height:4.35em;overflow-y:auto"
    return f'<div style="{_BODY};{box}">{lines}</div>'


def legend(titles: Sequence[str], *, has_zones: bool, mission: bool) -> str:
    marks = [("+", "goal", GOAL_RGB)] if mission else [("─", "reference", GOAL_RGB)]
    if not mission:
        marks.append(("+", "start", GOAL_RGB))
    for title, rgb in zip(titles, cycle(FLIGHT_RGB), strict=False):
        marks += [("─", f"{title} flown".strip(), rgb), ("━", f"{title} plan".strip(), rgb)]
    if has_zones:
        marks.append(("□", "fence, zones", FENCE_RGB))
    items = "".join(
        f'<span style="margin-right:0.9em;white-space:nowrap"><b style="color:{css(rgb)}">{mark}'
        f"</b> {escape(what)}</span>"
        for mark, what, rgb in marks
    )
    return f'<div style="{_BODY};{_DIM}">On the map: {items}</div>'
