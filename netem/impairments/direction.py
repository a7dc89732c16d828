"""Impairments of one direction of the network, from a text such as `constant(0.05) & loss(0.1)`.

Every packet first passes the queue of `rate` or `deliveries`, if there is one. Then the other
impairments act on the packet: their delays add up, and one impairment suffices to lose the packet.
Their random numbers are those of the time at which the packet entered.
"""

from functools import lru_cache
from typing import TYPE_CHECKING, Any

from skytether.netem.impairments.impairment import Impairment
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import reading
from skytether.shared.scenario.grammar import Call, GrammarError
from skytether.shared.scenario.registry import IMPAIRMENTS, Entry, Files

if TYPE_CHECKING:
    from skytether.netem.impairments.queues import Queued

PARTS_MAX = 16


class Impairments:
    """Impairments of one direction, made from parsed calls and the files that the calls name.

    Raises:
        GrammarError: an impairment refuses its arguments, or there are two queues.
    """

    def __init__(self, calls: tuple[Call, ...] = (), files: Files = ()) -> None:
        made = [_make(call, files) for call in calls]
        self.parts: tuple[tuple[str, Impairment], ...] = tuple(
            (call.name, each)
            for call, each in zip(calls, made, strict=True)
            if not (each.is_ordered or each.is_queue)
        )
        self.is_ordered = any(each.is_ordered for each in made)
        finite: list[Any] = [each for each in made if each.is_queue]
        if len(finite) > 1:
            raise GrammarError(
                " & ".join(each.text for each in calls), "one rate or deliveries in a direction"
            )
        self.queue: Queued | None = finite[0] if finite else None
        self.least_s = sum(each.least_s for each in made)
        self.mean_s = sum(each.mean_s for each in made)
        self.loss = 0.0
        for each in made:
            self.loss += each.loss * (1.0 - self.loss)
        """Mean share of packets that are lost, without the losses of the queue."""


def impairments(text: str, files: Files = ()) -> Impairments:
    """Parse the impairments of a direction, joined by &; an empty text means no impairments.

    Args:
        files: files that the text names, with their contents.

    Raises:
        GrammarError: a part of the text is invalid.
    """
    calls = tuple(IMPAIRMENTS.calls(text))
    if len(calls) > PARTS_MAX:
        raise GrammarError(text, f"at most {PARTS_MAX} impairments")
    named = IMPAIRMENTS.files(text)
    own = tuple(file for file in files if file.name in named)
    return _made(calls, own, tuple(IMPAIRMENTS[call.name] for call in calls))


def impairments_of(argument: str, text: str) -> Impairments:
    """Impairments that the argument of a Python function describes, with the files it names.

    Raises:
        ConfigError: the text is invalid, or a file cannot be read.
    """
    if not isinstance(text, str):
        raise ConfigError(f"{argument}: got {text!r}, expected impairments such as 'loss(10%)'")
    try:
        return impairments(text, reading.files_of("network.uplink", text, argument))
    except GrammarError as error:
        raise ConfigError(f"{argument}: {error}") from None


@lru_cache(maxsize=256)
def _made(calls: tuple[Call, ...], files: Files, _: tuple[Entry, ...]) -> Impairments:
    return Impairments(calls, files)


def _make(call: Call, files: Files) -> Impairment:
    try:
        impairment: Impairment = IMPAIRMENTS.make(call, files)
    except ValueError as error:
        raise GrammarError(call.text, str(error)) from None
    return impairment
