"""Direction of the network as a scenario writes it: `constant(0.05) & loss(0.1)`.

    direction  := impairment | impairment & direction
    impairment := name | name(argument, …)
    argument   := value | key=value

A value is a number, a word or the name of a file; in quotes it may have any character. Every packet
goes through the queue of `rate` or `deliveries` first, where there is one, and all else acts on it
with the time at which it has entered: delays add up, and what one impairment loses is lost.
"""

import re
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

from skytether.shared.base.hint import hint
from skytether.shared.scenario.air import delays, losses, queues, traces  # noqa: F401 - the table
from skytether.shared.scenario.air.impairment import Impairment
from skytether.shared.scenario.air.queues import Ordered, Queued
from skytether.shared.scenario.calls import QUOTED, calls
from skytether.shared.scenario.policies import PolicyError
from skytether.shared.scenario.registry import IMPAIRMENTS, Entry

TEXT_MAX = 1000
"""Largest number of characters of a direction."""
PARTS_MAX = 16
"""Largest number of impairments of a direction."""

_ARGUMENT = re.compile(
    rf"\s*(?:([a-z_]\w*)\s*=\s*)?({QUOTED}|[^,=\"]+?)\s*", re.IGNORECASE | re.ASCII
)
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?", re.IGNORECASE | re.ASCII)


class Part(NamedTuple):
    """An impairment of a direction."""

    name: str
    values: tuple[float | str, ...]
    """An argument for each parameter."""


class Path:
    """Impairments of one direction.

    Args:
        parts: its impairments.

    Raises:
        PolicyError: an impairment cannot have these arguments, or there are two queues.
    """

    def __init__(self, parts: tuple[Part, ...]) -> None:
        made = [_made(part) for part in parts]
        self.impairments: tuple[tuple[str, Impairment], ...] = tuple(
            (part.name, each)
            for part, each in zip(parts, made, strict=True)
            if not isinstance(each, Ordered | Queued)
        )
        """Impairments that act on packets one by one, with their names."""
        self.is_ordered = any(isinstance(each, Ordered) for each in made)
        """Whether no packet of a flow overtakes another."""
        finite = [each for each in made if isinstance(each, Queued)]
        if len(finite) > 1:
            raise PolicyError(_text(parts), "one rate or deliveries in a direction")
        self.queue: Queued | None = finite[0] if finite else None
        """Finite rate, with its queue."""
        self.least_s = sum(each.least_s for each in made)
        """Smallest delay, an empty queue's [s]."""
        self.mean_s = sum(each.mean_s for each in made)
        """Mean delay, an empty queue's [s]."""
        self.loss = 0.0
        for each in made:
            self.loss += each.loss * (1.0 - self.loss)
        """Mean share of the packets that are lost, with a queue that loses none."""


def parse(text: str) -> tuple[Part, ...]:
    """Impairments that a text names; none of an empty one.

    Raises:
        PolicyError: with the part of it that is wrong.
    """
    if not text.strip():
        return ()
    if len(text) > TEXT_MAX:
        raise PolicyError(f"{text[:40]}…", f"at most {TEXT_MAX} characters")
    parts = tuple(_part(name, arguments) for name, arguments in calls(text, IMPAIRMENTS.form))
    if len(parts) > PARTS_MAX:
        raise PolicyError(text, f"at most {PARTS_MAX} impairments")
    return parts


def path(text: str) -> Path:
    """The direction that a text describes; files in it are read again where they have changed.

    Raises:
        PolicyError: with the part of it that is wrong.
    """
    parts = parse(text)
    if any(files_of(part) for part in parts):
        return Path(parts)
    return _path(parts, tuple(IMPAIRMENTS[part.name] for part in parts))


def with_files(text: str, change: Callable[[str], str]) -> str:
    """A direction with other names of its files.

    Raises:
        PolicyError: with the part of it that is wrong.
    """
    parts = parse(text)
    return _text(parts, change) if any(files_of(part) for part in parts) else text


def files_of(part: Part) -> list[str]:
    """Files that an impairment reads."""
    taken = zip(IMPAIRMENTS[part.name].parameters, part.values, strict=True)
    return [str(value) for parameter, value in taken if parameter.file and value != ""]


@lru_cache(maxsize=256)
def _path(parts: tuple[Part, ...], _: tuple[Entry, ...]) -> Path:
    return Path(parts)


def _part(name: str, arguments: str | None) -> Part:
    entry = IMPAIRMENTS.get(name)
    written = name if arguments is None else f"{name}({arguments})"
    if entry is None:
        raise PolicyError(written, f"an impairment; {hint(name, IMPAIRMENTS)}")
    if arguments is None and not entry.may_stand_alone:
        raise PolicyError(written, IMPAIRMENTS.written(name))
    given: dict[str, Any] = {}
    names = [parameter.name for parameter in entry.parameters]
    for argument in _arguments(arguments or ""):
        found = _ARGUMENT.fullmatch(argument)
        key = (found[1] or next((each for each in names if each not in given), "")) if found else ""
        if not found or key not in names or key in given:
            raise PolicyError(written, IMPAIRMENTS.written(name))
        given[key] = _value(found[2])
    values: list[Any] = [given.get(each.name, each.default) for each in entry.parameters]
    if not all(each.takes(value) for each, value in zip(entry.parameters, values, strict=True)):
        raise PolicyError(written, IMPAIRMENTS.written(name))
    return Part(name, tuple(values))


def _arguments(text: str) -> list[str]:
    """Arguments between commas that stand in no quotes."""
    return re.findall(rf"(?:{QUOTED}|[^,])+", text) if text.strip() else []


def _value(word: str) -> float | str:
    if _NUMBER.fullmatch(word):
        return float(word) if re.search(r"[.e]", word, re.IGNORECASE) else int(word)
    return word.strip('"')


def _text(parts: tuple[Part, ...], change: Callable[[str], str] = str) -> str:
    """Parts as a text, with every argument written out."""
    texts = []
    for name, values in parts:
        shown = [
            f'"{change(str(value))}"' if parameter.file and value else _exact(value)
            for parameter, value in zip(IMPAIRMENTS[name].parameters, values, strict=True)
        ]
        texts.append(f"{name}({', '.join(shown)})" if shown else name)
    return " & ".join(texts)


def _exact(value: float | str) -> str:
    return value if isinstance(value, str) else repr(value)


def _made(part: Part) -> Impairment:
    entry = IMPAIRMENTS[part.name]
    try:
        made: Impairment = entry.make(*part.values)
    except ValueError as error:
        raise PolicyError(_text((part,)), str(error)) from None
    return made
