"""Direction of the network as a scenario writes it: `constant(0.05) & loss(0.1)`.

`shared.scenario.grammar` has the grammar. Every packet goes through the queue of `rate` or
`deliveries` first, where there is one, and all else acts on it with the time at which it has
entered: delays add up, and what one impairment loses is lost.
"""

from functools import lru_cache

from skytether.shared.scenario.air import delays, losses, queues, traces  # noqa: F401 - the table
from skytether.shared.scenario.air.impairment import Impairment
from skytether.shared.scenario.air.queues import Ordered, Queued
from skytether.shared.scenario.grammar import Call, GrammarError
from skytether.shared.scenario.registry import IMPAIRMENTS, Entry, Files

TEXT_MAX = 1000
"""Largest number of characters of a direction."""
PARTS_MAX = 16
"""Largest number of impairments of a direction."""


class Path:
    """Impairments of one direction.

    Args:
        calls: its impairments.
        files: those that they name.

    Raises:
        GrammarError: an impairment cannot have these arguments, or there are two queues.
    """

    def __init__(self, calls: tuple[Call, ...] = (), files: Files = ()) -> None:
        made = [_made(call, files) for call in calls]
        self.impairments: tuple[tuple[str, Impairment], ...] = tuple(
            (call.name, each)
            for call, each in zip(calls, made, strict=True)
            if not isinstance(each, Ordered | Queued)
        )
        """Impairments that act on packets one by one, with their names."""
        self.is_ordered = any(isinstance(each, Ordered) for each in made)
        """Whether no packet of a flow overtakes another."""
        finite = [each for each in made if isinstance(each, Queued)]
        if len(finite) > 1:
            raise GrammarError(
                " & ".join(each.text for each in calls), "one rate or deliveries in a direction"
            )
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


def path(text: str, files: Files = ()) -> Path:
    """The direction that a text describes; an empty one changes nothing.

    Args:
        text: impairments.
        files: those that it names, with their contents.

    Raises:
        GrammarError: with the part of the text that is wrong.
    """
    calls = tuple(IMPAIRMENTS.calls(text))
    if len(calls) > PARTS_MAX:
        raise GrammarError(text, f"at most {PARTS_MAX} impairments")
    named = IMPAIRMENTS.files(text)
    own = tuple(file for file in files if file.name in named)
    return _path(calls, own, tuple(IMPAIRMENTS[call.name] for call in calls))


@lru_cache(maxsize=256)
def _path(calls: tuple[Call, ...], files: Files, _: tuple[Entry, ...]) -> Path:
    return Path(calls, files)


def _made(call: Call, files: Files) -> Impairment:
    try:
        made: Impairment = IMPAIRMENTS.made(call, files)
    except ValueError as error:
        raise GrammarError(call.text, str(error)) from None
    return made
