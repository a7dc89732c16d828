"""What a live process imports before its first packet, because a change in flight may name it."""

from collections.abc import Collection
from contextlib import suppress

from skytether.shared.base.errors import ConfigError
from skytether.shared.base.hint import hint
from skytether.shared.scenario import rooms
from skytether.shared.scenario.registry import IMPAIRMENTS, TRIGGERS, load


def preload(changeable: Collection[str]) -> None:
    """Import what a change of these keys in flight may name, before the first packet: a step or a
    packet would have to wait for it.
    """
    modules: list[str] = []
    for key, table, guarded in (
        ("control.trigger", TRIGGERS, "skytether.server.triggers.guarded"),
        ("mission.zones", rooms.ZONES, ""),
        ("network.uplink", IMPAIRMENTS, "skytether.netem.impairments.guarded"),
    ):
        for name in table if key in changeable else ():
            with suppress(ConfigError):  # a room that is not installed
                modules += [] if table[name].is_ours else [guarded]
    if "network.uplink" in changeable:
        modules += ["skytether.netem.bottleneck", "skytether.shared.base.folders"]
    if "armed" in changeable:
        modules.append("skytether.client.orders")
    if changeable:
        modules += [f"skytether.shared.scenario.{each}" for each in ("forms", "wrong_values")]
        hint("", ())  # imports difflib
    for module in modules:
        with suppress(ConfigError):
            load(module, "a change")
