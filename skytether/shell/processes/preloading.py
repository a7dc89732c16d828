"""Import of modules that a change in flight may need, before a live process's first packet."""

from collections.abc import Collection
from contextlib import suppress

from skytether.shared.base.errors import NotInstalledError
from skytether.shared.base.hint import hint
from skytether.shared.scenario import rooms
from skytether.shared.scenario.registry import IMPAIRMENTS, TRIGGERS, load


def preload(changeable: Collection[str]) -> None:
    """Before the first packet, import modules that a change of these keys may need: in flight, an
    import would delay a step or a packet.
    """
    modules: list[str] = []
    for key, table, guarded in (
        ("control.trigger", TRIGGERS, "skytether.server.triggers.guarded"),
        ("mission.zones", rooms.ZONES, ""),
        ("network.uplink", IMPAIRMENTS, "skytether.netem.impairments.guarded"),
    ):
        for name in table if key in changeable else ():
            with suppress(NotInstalledError):  # a package that is not installed
                modules += [] if table[name].is_ours else [guarded]
    if "network.uplink" in changeable:
        modules.append("skytether.shared.base.folders")
        with suppress(NotInstalledError):  # the package for queues may be missing
            load("skytether.netem.bottleneck", "a change")
    if "armed" in changeable:
        modules.append("skytether.client.orders")
    if changeable:
        modules += [f"skytether.shared.scenario.{each}" for each in ("forms", "wrong_values")]
        hint("", ())  # imports difflib
    for module in modules:
        load(module, "a change")
