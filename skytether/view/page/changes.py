"""Descriptions of changes in flight, such as "Loss 10 → 30 %".

A process reports a change as a key's values before and after (`Changed`); for impairments and
triggers, these are whole texts. Descriptions have only the difference, in the sliders' units.
"""

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

import msgspec

from skytether.shared.events.flight import Changed
from skytether.shared.scenario.grammar import GrammarError, calls
from skytether.shared.scenario.rooms import TEXTS
from skytether.view.page.controls import LOST, THRESHOLDS, WAYS, applied, knobs

KNOBS = (*knobs(3), *THRESHOLDS)
DIRECTIONS = dict(zip(WAYS, ("up", "down"), strict=True))
NOTHING = "nothing"


class Mark(Enum):
    """Effect of a change on the link, as marked in plots."""

    CUT = "link cut"
    HEALED = "link healed"
    CHANGED = "change"


def mark(event: Changed) -> Mark:
    if event.key in WAYS:
        was, now = (_text(value).endswith(LOST) for value in (event.before, event.after))
        if was != now:
            return Mark.CUT if now else Mark.HEALED
    return Mark.CHANGED


def together(changed: Mapping[tuple[str, str], Changed], netems: int) -> str:
    """Description of changes made at once, such as those of both directions.

    Args:
        changed: changes by process and key.
        netems: number of netems of the flight, one for each path.
    """
    at: dict[str, list[tuple[str, Changed]]] = {}
    for place, event in changed.items():
        at.setdefault(in_words(event), []).append((place[0], event))
    return "; ".join(text + _where(places, netems) for text, places in at.items())


def _where(changes: Sequence[tuple[str, Changed]], netems: int) -> str:
    """Direction and path of changes of the network; empty if they apply to all paths both ways."""
    ways = {
        event.name.replace("_", " ") or DIRECTIONS[event.key]
        for _, event in changes
        if event.key in DIRECTIONS
    }
    paths = {process.partition(" ")[2] or "1" for process, _ in changes} if ways else set()
    where = [*ways] if len(ways) == 1 else []
    if 0 < len(paths) < netems:
        where.append(f"path {', '.join(sorted(paths))}")
    return f" ({', '.join(where)})" if where else ""


def in_words(event: Changed) -> str:
    """Sentence about a change, without direction and path."""
    if (found := mark(event)) is not Mark.CHANGED:
        return found.value.capitalize()
    before, after = _value(event.before), _value(event.after)
    if turned := _turned(event.key, before, after):
        return turned
    if isinstance(before, str) and isinstance(after, str):
        before, after = _differing(before, after)
    return f"{event.name or event.key} {_shown(before)} → {_shown(after)}"


def _turned(key: str, before: Any, after: Any) -> str:
    """Change in terms of sliders, as text; empty if sliders do not describe all of it."""
    said, values = [], {key: before}
    try:
        for knob in KNOBS:
            was, now = knob.read({key: before}), knob.read({key: after})
            if was is not None and now is not None and was != now:
                said.append(f"{knob.name} {was:.6g} → {now:.6g} {knob.unit}".rstrip())
                values = applied(values, knob.write(values, now))
        is_all = key not in TEXTS or TEXTS[key].parse(values[key]) == TEXTS[key].parse(after)
    except (GrammarError, LookupError, TypeError, ValueError):  # a value of another version
        return ""
    return ", ".join(said) if is_all else ""


def _differing(before: str, after: str) -> tuple[str, str]:
    """Calls that only one of the texts has; the whole texts if their calls are not joined by &."""
    try:
        was, now = ([each.text for each in calls(text, "")] for text in (before, after))
    except GrammarError:
        return before, after
    gone = " & ".join(each for each in was if each not in now)
    new = " & ".join(each for each in now if each not in was)
    return (gone, new) if gone or new else (before, after)


def _shown(value: Any) -> str:
    if isinstance(value, str):
        return value or NOTHING
    return msgspec.json.encode(value).decode()


def _value(text: str) -> Any:
    try:
        return msgspec.json.decode(text)
    except msgspec.DecodeError:  # a feed of another version
        return text


def _text(text: str) -> str:
    value = _value(text)
    return value if isinstance(value, str) else ""
