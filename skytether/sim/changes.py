"""Changes of keys in a flight in virtual time."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.endpoints.change import Running
from skytether.shared.endpoints.endpoint import Endpoint
from skytether.shared.scenario.dotted import text_key
from skytether.shared.scenario.whole import Scenario
from skytether.sim.hosts import Hosts


def plan(
    world: Hosts,
    flown: Mapping[str, tuple[Endpoint, Scenario]],
    changes: Sequence[tuple[float, Mapping[str, Any]]],
) -> None:
    """Schedule each change of a key at all hosts that accept the key. The first host also gets keys
    that no host accepts, and refuses them.
    """
    running = {host: Running(endpoint, scenario) for host, (endpoint, scenario) in flown.items()}
    changeable = frozenset[str]().union(*(each.changeable for each in running.values()))

    def change(values: Mapping[str, Any]) -> None:
        for i, (host, each) in enumerate(running.items()):
            accepted = (
                each.changeable if i else each.changeable | ({*map(text_key, values)} - changeable)
            )
            if own := {key: value for key, value in values.items() if text_key(key) in accepted}:
                with suppress(ConfigError):  # a refusal is reported as an event
                    world.act(host, partial(each.change, own))

    for time_s, values in changes:
        world.at(seconds_to_ns(time_s), partial(change, values))
