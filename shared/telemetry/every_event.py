"""Union of all kinds of events, into which readers of logs, feeds and recordings decode.

Events of packages that are not installed are missing.
"""

from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Union

from skytether.shared.base.errors import ConfigError
from skytether.shared.events import processes  # noqa: F401 - defines events
from skytether.shared.events.flight import Event
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.rooms import EVENTS

for module in EVENTS:
    with suppress(ConfigError):
        load(module, "events")


def kinds(base: type[Event] = Event) -> Iterator[type[Event]]:
    """Classes of events that are defined so far and have no subclasses."""
    for kind in base.__subclasses__():
        if kind.__subclasses__():
            yield from kinds(kind)
        else:
            yield kind


# The classes are found by a search, so that no list has to be kept. For mypy the union is `Event`.
if TYPE_CHECKING:
    EveryEvent = Event
else:
    EveryEvent = Union[tuple(kinds())]  # noqa: UP007 - its classes are not known here
